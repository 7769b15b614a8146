"""Roads that vehicles drive along and map: areas like Shockley's, their field known everywhere (Shockley 2-6).

East is x, north y, z up. Metal buried along the roads makes features of about ten metres in a uniform Earth field;
parked vehicles are others on each drive. A vehicle reads the field in its own axes (forward, left, up), bent by its own
iron, so a map holds for one direction of travel. A repeated drive keeps another lane, sways, and knows its place to
1.5 m.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

from app.geometry import Array
from app.positioning.sections import contiguous_stretches, resample_by_distance, travelled_m
from app.synthetic.noise import ornstein_uhlenbeck
from app.synthetic.steel import Dipoles

__all__ = [
    "EARTH_UT", "Area", "Calibration", "Drive", "RoadSamples", "Roads", "Vehicle", "calibrate", "drive", "make_roads",
    "make_vehicles", "sampled_by_distance", "sampled_by_time",
]  # fmt: skip

Area = Literal["rectangle", "neighbourhood", "large"]

EARTH_UT = np.array([-2.1, 20.0, -49.3])
"""Near AFIT: 200 mG north, -21 mG east, 493 mG down (Shockley, L856)."""

_FINE_M = 0.25
_REACH_M = 60.0  # metal farther away than this is left out: less than a nanotesla each
_BLOCK = 512
_METAL_PER_M = 1.0 / 9.0
_METAL_UT_M3, _METAL_SPREAD = 80.0, 0.8  # median and log-sd of the moments
_ALIKE = 0.8  # share of the variance that streets of a neighbourhood have in common
_PARKED_PER_M, _PARKED_UT_M3 = 0.006, 15.0
_TURN_M, _BRAKE_M_S2, _CREEP_M_S = 3.0, 2.0, 0.5


@dataclass(frozen=True, slots=True, eq=False)
class Roads:
    """Straight roads driven one after the other through `corners_m` (k + 1, 2), at `speed_m_s` (k,) each."""

    corners_m: Array
    speed_m_s: Array
    metal: Dipoles
    earth_uT: Array

    @property
    def length_m(self) -> float:
        return float(np.linalg.norm(np.diff(self.corners_m, axis=0), axis=1).sum())

    def field_uT(self, points_m: Array, parked: Dipoles | None = None) -> Array:
        """The field at points (n, 3), uT (n, 3): the Earth's, and that of metal within 60 m."""
        out = np.tile(self.earth_uT, (len(points_m), 1))
        for first in range(0, len(points_m), _BLOCK):
            block = points_m[first : first + _BLOCK]
            low, high = block.min(axis=0) - _REACH_M, block.max(axis=0) + _REACH_M
            for metal in (self.metal, parked):
                if metal is not None:
                    near = np.all((metal.position_m >= low) & (metal.position_m <= high), axis=1)
                    out[first : first + _BLOCK] += Dipoles(metal.position_m[near], metal.moment_uT_m3[near]).field_uT(
                        block
                    )
        return out


@dataclass(frozen=True, slots=True, eq=False)
class Vehicle:
    """What bends the field where a vehicle has its sensor: reading = soft_iron B + hard_iron_uT + white noise.

    `calibration_error_uT` is the length of the constant offset that its calibration leaves.
    """

    name: str
    height_m: float
    soft_iron: Array
    hard_iron_uT: Array
    noise_uT: float
    calibration_error_uT: float


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """A correction of readings: matrix (reading - offset_uT)."""

    matrix: Array
    offset_uT: Array

    def apply(self, reading_uT: Array) -> Array:
        return np.asarray((reading_uT - self.offset_uT) @ self.matrix.T)


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """A drive as logged: times (n,), true and recorded positions (n, 2), the road's number (n,), readings (n, 3)."""

    t_s: Array
    true_m: Array
    recorded_m: Array
    road: NDArray[np.int64]
    reading_uT: Array


class RoadSamples(NamedTuple):
    """A map or a log of queries: recorded positions (m, 2), field (m, 3), metres travelled (m,), stretches (m,)."""

    position_m: Array
    field_uT: Array
    along_m: Array
    stretch: NDArray[np.int64]


def make_roads(area: Area, rng: np.random.Generator) -> Roads:
    """Draw a benign rectangle of 1.6 km, a neighbourhood of eight parallel streets alike, or 13 km with fast roads."""
    corners, speed = _layout(area)
    legs = np.diff(corners, axis=0)
    length = np.linalg.norm(legs, axis=1)
    common = _buried(rng, float(length.max()))
    position, moment = [], []
    for start, leg, metres in zip(corners, legs, length, strict=False):
        place, strength = _buried(rng, float(metres))
        if area == "neighbourhood" and metres > 100.0:
            place = common[0] + [0.5, 0.2, 0.1] * rng.normal(size=common[0].shape)
            strength = np.sqrt(_ALIKE) * common[1] + np.sqrt(1.0 - _ALIKE) * rng.permutation(common[1])
        ahead = leg / metres
        xy = start + place[:, :1] * ahead + place[:, 1:2] * np.array([-ahead[1], ahead[0]])
        position.append(np.column_stack([xy, place[:, 2]]))
        moment.append(strength)
    return Roads(corners, speed, Dipoles(np.concatenate(position), np.concatenate(moment)), EARTH_UT)


def make_vehicles(rng: np.random.Generator) -> dict[str, Vehicle]:
    """A truck, an SUV and a car; the car's sensor is lowest, and its calibration 1 uT off (Shockley, L1178)."""
    vehicles = {}
    for name, height_m, error_uT in (("truck", 1.2, 0.25), ("suv", 1.1, 0.25), ("car", 0.8, 1.0)):
        bend = 0.04 * rng.normal(size=(3, 3))
        turn = 0.01 * rng.normal(size=(3, 3))
        soft_iron = np.eye(3) + 0.5 * (bend + bend.T) + 0.5 * (turn - turn.T)
        vehicles[name] = Vehicle(name, height_m, soft_iron, rng.uniform(-8.0, 8.0, 3), 0.1, error_uT)
    return vehicles


def calibrate(vehicle: Vehicle, earth_uT: Array, rng: np.random.Generator) -> Calibration:
    """What tight circles on level ground give: the horizontal ellipse, and z by its offset alone (Shockley 3.6).

    In closed form: what a level circle cannot tell (the vertical field in x and y, a rotation, the scale of z) stays
    wrong. To that comes the vehicle's calibration error, in a random direction.
    """
    horizontal = vehicle.soft_iron[:2, :2]
    eigenvalue, vector = np.linalg.eigh(horizontal @ horizontal.T)
    matrix = np.eye(3)
    matrix[:2, :2] = (vector / np.sqrt(eigenvalue)) @ vector.T
    offset = vehicle.soft_iron[:, 2] * earth_uT[2] + vehicle.hard_iron_uT
    offset[2] -= earth_uT[2]
    direction = rng.normal(size=3)
    return Calibration(matrix, offset + vehicle.calibration_error_uT * direction / np.linalg.norm(direction))


def drive(
    roads: Roads,
    vehicle: Vehicle,
    rng: np.random.Generator,
    *,
    rate_hz: float = 50.0,
    backwards: bool = False,
    position_rms_m: float = 1.5,
    across_sd_m: float = 0.3,
    sway_sd_rad: float = 0.0015,
    parked: bool = True,
) -> Drive:
    """Drive all roads once and log at `rate_hz`, slowing down for turns and waiting at some of them.

    `position_rms_m` is of the recorded positions, horizontal; it and the distance from the middle of the lane wander
    over a hundred metres, roll and pitch over a second.
    """
    path_m, s, road = _path(roads)
    if backwards:
        path_m, s, road = path_m[::-1], s[-1] - s[::-1], road[::-1]
    t_s, at = _timetable(s, road, roads.speed_m_s, rng)
    sampled_s = np.arange(0.0, t_s[-1], 1.0 / rate_hz)
    place = np.interp(sampled_s, t_s, at)
    tangent = np.gradient(path_m, axis=0)
    left = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1) / np.linalg.norm(tangent, axis=1, keepdims=True)
    lane_m = path_m + across_sd_m * _wander(rng, len(s), 1) * left
    recorded_m = lane_m + position_rms_m / np.sqrt(2.0) * _wander(rng, len(s), 2)
    heading_rad = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    lane_m, recorded_m = (np.stack([np.interp(place, s, c) for c in p.T], axis=1) for p in (lane_m, recorded_m))
    obstacles = _parked(roads, rng) if parked else None
    B = roads.field_uT(np.column_stack([lane_m, np.full(len(place), vehicle.height_m)]), obstacles)
    B = _in_body(B, np.interp(place, s, heading_rad), ornstein_uhlenbeck(rng, sampled_s, sway_sd_rad, 1.0, 2))
    reading_uT = B @ vehicle.soft_iron.T + vehicle.hard_iron_uT + vehicle.noise_uT * rng.normal(size=B.shape)
    numbers = road[np.searchsorted(s, place, side="right") - 1]
    return Drive(sampled_s, lane_m, recorded_m, numbers, reading_uT)


def sampled_by_time(log: Drive, calibration: Calibration | None, every: int = 1) -> RoadSamples:
    """Every so many-th sample of a drive: 1, 2 and 5 of 50 Hz for 50, 25 and 10 Hz (Shockley 6.1)."""
    field = log.reading_uT if calibration is None else calibration.apply(log.reading_uT)
    along_m, _ = travelled_m(log.t_s, log.recorded_m)
    stretch = contiguous_stretches(log.t_s[::every], np.inf, log.road[::every])
    return RoadSamples(log.recorded_m[::every], field[::every], along_m[::every], stretch)


def sampled_by_distance(log: Drive, calibration: Calibration | None, spacing_m: float) -> RoadSamples:
    """A drive at equal distances, standing left out (Shockley 6.2); each road is a stretch of its own."""
    field = log.reading_uT if calibration is None else calibration.apply(log.reading_uT)
    along_m, moving = travelled_m(log.t_s, log.recorded_m, slowest_m_s=0.2)
    columns = np.column_stack([log.recorded_m, field, log.road])
    found = resample_by_distance(along_m, columns, spacing_m, moving=moving, longest_gap_m=10.0)
    road = np.round(found.columns[:, 5]).astype(np.int64)
    stretch = contiguous_stretches(found.distance_m, 1.5 * spacing_m, road)
    return RoadSamples(found.columns[:, :2], found.columns[:, 2:5], found.distance_m, stretch)


def _layout(area: Area) -> tuple[Array, Array]:
    """Corners (k + 1, 2) and the speed (k,) of each road; up to 30 m/s (Shockley, L1059, L1140)."""
    if area == "rectangle":
        corners = [[0.0, 0.0], [500.0, 0.0], [500.0, 300.0], [0.0, 300.0], [0.0, 6.0]]
        return np.array(corners), np.array([12.0, 10.0, 12.0, 10.0])
    if area == "neighbourhood":
        streets = [[[300.0 * x, 70.0 * k] for x in ((0, 1) if k % 2 == 0 else (1, 0))] for k in range(8)]
        return np.concatenate(streets), np.where(np.arange(15) % 2 == 0, 9.0, 7.0)
    steps = [
        [2500, 0],
        [0, 900],
        [-700, 0],
        [0, 1500],
        [900, 0],
        [0, 700],
        [-3000, 0],
        [0, -800],
        [-600, 0],
        [0, -1400],
    ]
    speeds = [30.0, 15.0, 13.0, 18.0, 13.0, 15.0, 30.0, 15.0, 13.0, 18.0]
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)]).astype(np.float64), np.array(speeds)


def _buried(rng: np.random.Generator, length_m: float) -> tuple[Array, Array]:
    """Metal under a road: places (k, 3) along it, to the left of it and up, and moments (k, 3), mostly induced."""
    count = max(1, int(length_m * _METAL_PER_M))
    place = np.column_stack(
        [rng.uniform(0.0, length_m, count), rng.normal(0.0, 2.5, count), -rng.uniform(1.0, 4.0, count)]
    )
    direction = EARTH_UT / np.linalg.norm(EARTH_UT) + 0.7 * rng.normal(size=(count, 3))
    return place, direction * (_METAL_UT_M3 * np.exp(_METAL_SPREAD * rng.normal(size=(count, 1))))


def _parked(roads: Roads, rng: np.random.Generator) -> Dipoles:
    """Vehicles that stand beside the roads during one drive."""
    path_m, _, _ = _path(roads)
    count = rng.poisson(_PARKED_PER_M * roads.length_m)
    index = rng.integers(1, len(path_m), count)
    step = path_m[index] - path_m[index - 1]
    left = np.stack([-step[:, 1], step[:, 0]], axis=1) / np.linalg.norm(step, axis=1, keepdims=True)
    aside_m = rng.choice([-1.0, 1.0], count) * rng.uniform(2.5, 6.0, count)
    return Dipoles(
        np.column_stack([path_m[index] + aside_m[:, None] * left, np.full(count, 0.6)]),
        _PARKED_UT_M3 * rng.normal(size=(count, 3)),
    )


def _path(roads: Roads) -> tuple[Array, Array, NDArray[np.int64]]:
    """Finely spaced points (n, 2) with rounded turns, the length (n,) along them, and the road (n,) each is on."""
    corner_at = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(roads.corners_m, axis=0), axis=1))])
    at = np.arange(0.0, corner_at[-1], _FINE_M)
    sharp = np.stack([np.interp(at, corner_at, c) for c in roads.corners_m.T], axis=1)
    xy = gaussian_filter1d(sharp, _TURN_M / _FINE_M, axis=0, mode="nearest")
    road = np.searchsorted(corner_at, at, side="right") - 1
    return xy, np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))]), road.astype(np.int64)


def _timetable(s: Array, road: NDArray[np.int64], limit_m_s: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Times and metres along the path: limits kept within a tenth, slow in turns, waiting at half of the joints."""
    pace = limit_m_s[road] * (1.0 + 0.1 * _wander(rng, len(s), 1)[:, 0])
    joints = np.flatnonzero(np.diff(road)) + 1
    waits_s = np.where(rng.random(len(joints)) < 0.5, rng.uniform(5.0, 30.0, len(joints)), 0.0)
    for joint, wait in zip(joints, waits_s, strict=True):
        least = _CREEP_M_S if wait else 5.0
        pace = np.minimum(pace, np.sqrt(least**2 + 2.0 * _BRAKE_M_S2 * np.abs(s - s[joint])))
    t = np.concatenate([[0.0], np.cumsum(2.0 * np.diff(s) / (pace[1:] + pace[:-1]))])
    for joint, wait in zip(joints, waits_s, strict=True):
        t[joint:] += wait
    before = joints[waits_s > 0.0]
    leave = np.insert(t, before, t[before] - waits_s[waits_s > 0.0])  # arrive, wait, go on
    return leave, np.insert(s, before, s[before])


def _wander(rng: np.random.Generator, points: int, columns: int) -> Array:
    """Smooth noise (points, columns) of unit variance along the path, correlated over about a hundred metres."""
    noise = gaussian_filter1d(rng.normal(size=(points + 2000, columns)), 50.0 / _FINE_M, axis=0)[1000:-1000]
    return np.asarray(noise * np.sqrt(2.0 * np.sqrt(np.pi) * 50.0 / _FINE_M))


def _in_body(B_uT: Array, heading_rad: Array, tilt_rad: Array) -> Array:
    """Fields (n, 3) in the axes of a vehicle with that heading, and small roll and pitch (n, 2)."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    level = np.stack([c * B_uT[:, 0] + s * B_uT[:, 1], c * B_uT[:, 1] - s * B_uT[:, 0], B_uT[:, 2]], axis=1)
    return np.asarray(level - np.cross(np.column_stack([tilt_rad, np.zeros(len(c))]), level))
