"""Kuevor's flight room (Kuevor B4): a box of 4 x 3 m flown between 0.5 and 2.25 m, its field known everywhere.

A uniform field and dipoles outside the box, scaled so that the gradient's norm reaches `STEEPEST_UT_PER_M` where the
map is used. A drone flies lawnmowers at several altitudes; each flight may carry an offset of its own (Kuevor B17).
The seed's z points down; here it points up, as everywhere else, so that an altitude is a height.
"""

from dataclasses import dataclass

import numpy as np

from app.field.samples import Samples
from app.geometry import Array
from app.synthetic.steel import Dipoles

__all__ = [
    "EPSILON_SCAN_M",
    "GAMMA_SCAN_M",
    "LOWER_FOUR_M",
    "TAKE_OFF_M",
    "TRAINING_BOX_M",
    "UPPER_FOUR_M",
    "UTILIZATION_BOX_M",
    "SyntheticRoom",
    "box_grid_m",
    "fly",
    "make_room",
]

TRAINING_BOX_M = np.array([[-2.0, -1.5, 0.5], [2.0, 1.5, 2.25]])
"""Lower and upper corner of where surveys fly (Kuevor, L1621)."""
UTILIZATION_BOX_M = np.array([[-1.75, -1.25, 0.75], [1.75, 1.25, 2.0]])
"""Of where the map is used: a quarter of a metre inside (Kuevor, L1571)."""
LOWER_FOUR_M = (0.5, 0.75, 1.0, 1.25)
UPPER_FOUR_M = (1.5, 1.75, 2.0, 2.25)
GAMMA_SCAN_M = (0.5, 1.375, 2.25)
EPSILON_SCAN_M = (0.75, 1.5, 2.0)
"""The altitudes of the flights (Kuevor, L727, L1639)."""
TAKE_OFF_M = np.array([[0.0, 0.0, height] for height in np.linspace(0.0, 0.5, 8)[:-1]])
"""(7, 3) nodes of a compromise map below the box, where drones take off (Kuevor, L762)."""

STEEPEST_UT_PER_M = 20.0
_EARTH_UT = np.array([2.0, -18.0, -50.0])
_DIPOLES = 14
_GAP_M = (1.0, 2.2)  # dipoles lie this far outside the training box
_LANE_M = 0.25
_STRIDE_S, _STEP_S = 4.5, 1.0  # a lane, and all shorter legs: 70 s an altitude, as many samples as the seed's flights


@dataclass(frozen=True, slots=True, eq=False)
class SyntheticRoom:
    """A uniform field `earth_uT` (3,) and the steel around the room; origin at the floor's centre, z up."""

    earth_uT: Array
    steel: Dipoles

    def field_uT(self, points_m: Array) -> Array:
        """The field at points (n, 3), uT (n, 3)."""
        return self.earth_uT + self.steel.field_uT(np.asarray(points_m, dtype=np.float64))

    def gradient_norm_uT_per_m(self, points_m: Array, step_m: float = 1e-4) -> Array:
        """(n,) Frobenius norm of the Jacobian at points (n, 3), by central differences (Kuevor, eq. 4.5)."""
        steps = step_m * np.eye(3)
        slopes = [(self.field_uT(points_m + s) - self.field_uT(points_m - s)) / (2.0 * step_m) for s in steps]
        return np.asarray(np.sqrt(np.sum(np.square(slopes), axis=(0, 2))))


def make_room(rng: np.random.Generator) -> SyntheticRoom:
    """Draw a room: dipoles of random direction outside all six faces, the strongest gradient as in the seed's room."""
    low, high = TRAINING_BOX_M
    position = rng.uniform(low, high, (_DIPOLES, 3))
    face = rng.permutation(np.arange(_DIPOLES) % 6)
    axis, outwards = face % 3, face // 3
    edge = np.where(outwards == 1, high[axis], low[axis])
    position[np.arange(_DIPOLES), axis] = edge + np.where(outwards == 1, 1.0, -1.0) * rng.uniform(*_GAP_M, _DIPOLES)
    steel = Dipoles(position, rng.normal(size=(_DIPOLES, 3)))
    unscaled = SyntheticRoom(_EARTH_UT, steel).gradient_norm_uT_per_m(box_grid_m(UTILIZATION_BOX_M, (30, 30, 6)))
    return SyntheticRoom(_EARTH_UT, steel.scaled(STEEPEST_UT_PER_M / float(unscaled.max())))


def box_grid_m(box_m: Array, counts: tuple[int, int, int]) -> Array:
    """(n, 3) nodes that span a box (2, 3), its faces included: so many along x, y and z."""
    axes = [np.linspace(low, high, count) for low, high, count in zip(*box_m, counts, strict=True)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def fly(
    room: SyntheticRoom,
    altitudes_m: tuple[float, ...],
    rng: np.random.Generator,
    *,
    rate_hz: float = 2.0,
    noise_uT: float = 0.27,
    offset_sd_uT: float = 0.0,
) -> Samples:
    """The survey of a flight: lanes along x a quarter of a metre apart at each altitude, from the origin and back.

    Positions are exact, as by motion capture; `noise_uT` is white, per axis; `offset_sd_uT` is of a constant that the
    whole flight carries, per axis.
    """
    t_s, path_m = _flight(altitudes_m)
    sampled_s = np.arange(0.0, t_s[-1], 1.0 / rate_hz)
    p = np.stack([np.interp(sampled_s, t_s, path_m[:, axis]) for axis in range(3)], axis=1)
    offset_uT = offset_sd_uT * rng.normal(size=3)
    return Samples(sampled_s, p, room.field_uT(p) + offset_uT + noise_uT * rng.normal(size=p.shape), "building")


def _flight(altitudes_m: tuple[float, ...]) -> tuple[Array, Array]:
    """Finely spaced times (n,) and positions (n, 3): straight legs from rest to rest, quintic in time."""
    corners = np.concatenate([[[0.0, 0.0, altitudes_m[0]]], _corners(altitudes_m), [[0.0, 0.0, altitudes_m[-1]]]])
    legs = np.diff(corners, axis=0)
    lasts_s = np.where(np.linalg.norm(legs, axis=1) > 1.0, _STRIDE_S, _STEP_S)
    part = np.arange(0.0, 1.0, 0.005)
    eased = part**3 * (10.0 - 15.0 * part + 6.0 * part**2)
    path_m = (corners[:-1, None] + eased[:, None] * legs[:, None]).reshape(-1, 3)
    starts_s = np.concatenate([[0.0], np.cumsum(lasts_s)])
    t_s = (starts_s[:-1, None] + part * lasts_s[:, None]).ravel()
    return np.append(t_s, starts_s[-1]), np.vstack([path_m, corners[-1:]])


def _corners(altitudes_m: tuple[float, ...]) -> Array:
    """Ends of the lanes (k, 3), each altitude begun where the one below ended."""
    (x0, y0, _), (x1, y1, _) = TRAINING_BOX_M
    lanes = np.arange(y0, y1 + 1e-9, _LANE_M)
    corners: list[tuple[float, float, float]] = []
    for index, altitude in enumerate(altitudes_m):
        ordered = lanes if index % 2 == 0 else lanes[::-1]
        for lane in ordered:
            ends = [(x0, lane, altitude), (x1, lane, altitude)]
            corners += ends if len(corners) % 4 == 0 else ends[::-1]
    return np.array(corners)
