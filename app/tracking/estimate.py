"""What weighted particles say: a place with its uncertainty, the other places it may be, and how sure that is."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array, wrap_angle_rad
from app.tracking.particle_filter import effective_sample_size
from app.tracking.particles import COURSE, HEADING, MEASURED, SCALE, Particles, Z

__all__ = ["Estimate", "Spot", "State", "carried_on", "describe", "occupied_bins"]

State = Literal["searching", "converged", "lost"]

_MODE_M = 3.0  # particles this near a mode's mean are its own
_MODES = 5
_LEAST_MODE = 0.02
_BIN_M, _BIN_RAD = 0.5, np.pi / 12


@dataclass(frozen=True, slots=True)
class Spot:
    """A place the device may be, with the share of the belief that is there."""

    floor: int
    position_m: tuple[float, float, float]
    heading_rad: float
    probability: float


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The belief after a step.

    position_m, covariance_m2   mean of the strongest spot, and second moment (2, 2) of the floor's belief about it
    heading_rad                 yaw of the track's frame
    radius_68_m, radius_95_m    about the position, that hold this share of the belief on its floor
    floor_probability           (f,)
    spots                       strongest first
    concentration               share of the belief in the strongest spot
    measured                    how much of the last metres is mapped
    step_scale, course_rad      of displacements: their true length over what was told, and their turn
    """

    floor: int
    position_m: tuple[float, float, float]
    covariance_m2: Array
    heading_rad: float
    heading_sd_rad: float
    radius_68_m: float
    radius_95_m: float
    floor_probability: Array
    spots: tuple[Spot, ...]
    concentration: float
    measured: float
    step_scale: float
    course_rad: float
    particles: int
    effective_sample_size: float


def describe(particles: Particles, weight: Array, floors: int, map_variance_m2: float) -> Estimate:
    """The estimate of particles of normalised weights; `map_variance_m2` per axis is what places of the map err by."""
    spots = _spots(particles, weight)
    best = spots[0]
    rows, w = particles.rows, weight
    if len(spots) > 1 or best.probability < 1.0:
        here = particles.floor == best.floor
        rows, w = rows[here], weight[here] / weight[here].sum()
    off = rows[:, :2] - np.array(best.position_m[:2])
    drawn_m2 = _BIN_M**2 * float(np.sum(np.square(w)))  # a few particles know their spread badly
    covariance = (w[:, None] * off).T @ off + (map_variance_m2 + drawn_m2) * np.eye(2)
    distance = np.hypot(off[:, 0], off[:, 1])
    order = np.argsort(distance, kind="stable")
    held = np.cumsum(w[order])
    radii = [
        float(np.hypot(distance[order[min(int(np.searchsorted(held, share)), len(order) - 1)]], reach))
        for share, reach in zip((0.68, 0.95), np.sqrt(map_variance_m2) * np.array([1.51, 2.45]), strict=True)
    ]
    turned = wrap_angle_rad(rows[:, HEADING] - best.heading_rad)
    return Estimate(
        floor=best.floor,
        position_m=best.position_m,
        covariance_m2=covariance,
        heading_rad=best.heading_rad,
        heading_sd_rad=float(np.sqrt(w @ np.square(turned))),
        radius_68_m=radii[0],
        radius_95_m=radii[1],
        floor_probability=np.asarray(np.bincount(particles.floor, weights=weight, minlength=floors), dtype=np.float64),
        spots=tuple(spots),
        concentration=best.probability,
        measured=float(w @ rows[:, MEASURED]),
        step_scale=float(w @ rows[:, SCALE]),
        course_rad=float(w @ rows[:, COURSE]),
        particles=len(particles),
        effective_sample_size=effective_sample_size(weight),
    )


def carried_on(estimate: Estimate, moved_m: Array) -> Estimate:
    """The estimate after the device went on by `moved_m` (3,) in the track's frame, as it reckons itself."""

    def on(position_m: tuple[float, float, float], heading_rad: float) -> tuple[float, float, float]:
        angle = heading_rad + estimate.course_rad
        c, s = estimate.step_scale * np.cos(angle), estimate.step_scale * np.sin(angle)
        x, y, z = position_m
        return (
            float(x + c * moved_m[0] - s * moved_m[1]),
            float(y + s * moved_m[0] + c * moved_m[1]),
            float(z + moved_m[2]),
        )

    spots = tuple(replace(spot, position_m=on(spot.position_m, spot.heading_rad)) for spot in estimate.spots)
    return replace(estimate, position_m=on(estimate.position_m, estimate.heading_rad), spots=spots)


def _spots(particles: Particles, weight: Array) -> list[Spot]:
    """Greedily: the heaviest square metre, then what lies within reach of its mean. One place alone is seen at once."""
    alone = _one_spot(particles, weight)
    if alone is not None:
        return [alone]
    left = weight.copy()
    key = _keys(particles, 2.0 * _BIN_M)
    spots: list[Spot] = []
    while len(spots) < _MODES and left.sum() > _LEAST_MODE:
        peak = int(np.argmax(np.bincount(key, weights=left)))
        start = np.flatnonzero((key == peak) & (left > 0.0))
        floor = int(particles.floor[start[0]])
        centre = np.average(particles.rows[start, :2], axis=0, weights=left[start])
        for _ in range(2):
            off = particles.rows[:, :2] - centre
            near = (particles.floor == floor) & (off[:, 0] ** 2 + off[:, 1] ** 2 < _MODE_M**2) & (left > 0.0)
            centre = np.average(particles.rows[near, :2], axis=0, weights=left[near])
        w = left[near]
        z = float(np.average(particles.rows[near, Z], weights=w))
        heading = float(np.angle(np.sum(w * np.exp(1j * particles.rows[near, HEADING]))))
        if not spots or w.sum() > _LEAST_MODE:
            spots.append(Spot(floor, (float(centre[0]), float(centre[1]), z), heading, float(w.sum())))
        left[near] = 0.0
    return sorted(spots, key=lambda spot: -spot.probability)


def _one_spot(particles: Particles, weight: Array) -> Spot | None:
    """All there is, where it is near its mean on one floor."""
    floor = int(particles.floor[0])
    if (particles.floor != floor).any():
        return None
    centre = weight @ particles.rows[:, :3]
    off = particles.rows[:, :2] - centre[:2]
    if float(np.max(off[:, 0] ** 2 + off[:, 1] ** 2)) > _MODE_M**2:
        return None
    heading = float(np.angle(weight @ np.exp(1j * particles.rows[:, HEADING])))
    return Spot(floor, (float(centre[0]), float(centre[1]), float(centre[2])), heading, 1.0)


def _keys(particles: Particles, bin_m: float) -> NDArray[np.int64]:
    """(n,) number of each particle's bin of place."""
    cell = np.floor(particles.rows[:, :2] / bin_m).astype(np.int64)
    cell -= cell.min(axis=0)
    columns, rows = (cell.max(axis=0) + 1).tolist()
    return np.asarray((particles.floor * rows + cell[:, 1]) * columns + cell[:, 0])


def occupied_bins(particles: Particles) -> int:
    """How many bins of floor, place and heading hold a particle."""
    place = _keys(particles, _BIN_M)
    heading = np.floor(np.mod(particles.rows[:, HEADING], 2.0 * np.pi) / _BIN_RAD).astype(np.int64)
    return len(np.unique(place * 32 + heading))
