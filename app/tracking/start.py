"""Particles where the global search finds the last metres of a track, and how sure that is.

Poses are drawn from the search's candidates, spread over what lies between the poses of its lattice, and then weighed
exactly: each is carried along its own course through the whole window, with the filter every particle has, so that they
start out knowing the sensor's offset.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.positioning.fix import LocateOptions, Prior
from app.positioning.floors import SearchableFloor
from app.positioning.matching import Matched, match
from app.positioning.off_map import OFF_MAP_PRIOR, off_map
from app.positioning.window import Window, WindowFrame
from app.tracking.ground import Barriers, Ground
from app.tracking.moves import Moves
from app.tracking.options import StartPrior, TrackOptions
from app.tracking.particles import (
    COURSE,
    DRAWS,
    DRIFT,
    HEADING,
    MEASURED,
    SCALE,
    Particles,
    X,
    Y,
    Z,
    advance,
    log_evidence,
    new_particles,
)
from app.tracking.places import Places
from app.tracking.step import Step

__all__ = ["Found", "find", "spread", "walkable_cells"]

_STILL = np.array([0.0, 0.0, 1.0, 0.0, 1.0, 0.0])


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Weighted particles at the end of a window, their positions (r, n, 2) at each of its readings, and the log of how

    much better the map explains the window than no map does."""

    particles: Particles
    history_m: Array
    log_ratio: float


def find(
    moves: Moves, window: Window, floors: Sequence[SearchableFloor], places: Places, barriers: Barriers,
    options: TrackOptions, prior: Prior | None, count: int, rng: np.random.Generator,
) -> Found:  # fmt: skip
    """Search all floors for a window whose readings are `moves`. Raises InvalidInput where nothing is walkable."""
    asked = LocateOptions(
        bias_sd_uT=options.bias_sd_uT, step_scale_sd=options.step_scale_sd,
        heading_drift_sd_rad_per_m=options.heading_drift_sd_rad_per_m, walkable=walkable_cells(options.ground),
    )  # fmt: skip
    matched = match(window, floors, places.components, "raw", prior, asked)
    drawn, proposed = _draw(matched, places, window.frame, count, rng)
    offset = moves.offset_variance_uT2
    particles, history = _carried(drawn, moves, places, barriers, offset)
    peak = float(matched.score[0])
    mass, nowhere = float(np.exp(matched.score - peak).sum()), off_map(matched, peak)
    weighed = replace(particles, log_weight=particles.log_weight - proposed)
    known = weighed.rows[:, MEASURED] >= 0.5
    if known.any():
        share = np.exp(log_evidence(_only(weighed, known)) - log_evidence(weighed))
        weighed, history = _only(weighed, known), history[:, known]
    else:
        share = 1e-9
    even = weighed.log_weight - log_evidence(weighed)
    odds = OFF_MAP_PRIOR / (1.0 - OFF_MAP_PRIOR)
    log_ratio = float(np.log(max(mass * share, 1e-300)) - np.log(max(nowhere.mass / odds, 1e-300)))
    return Found(replace(weighed, log_weight=even), history, log_ratio)


def spread(
    floors: Sequence[SearchableFloor], places: Places, prior: StartPrior | None, step: Step, frame: WindowFrame,
    options: TrackOptions, offset_variance_uT2: float, rng: np.random.Generator,
) -> Particles:  # fmt: skip
    """Particles about a place that was told, on the floors whose heights agree with it; or wherever there is a map."""
    n = options.particles
    if prior is None:
        position, floor = _anywhere(floors, n, rng)
    else:
        position = np.asarray(prior.position_m) + prior.sd_m * rng.normal(size=(n, 3))
        floor = np.argmin(np.abs(position[:, 2:] - places.heights_m), axis=1)
        position[:, 2] = np.clip(position[:, 2], places.lowest_m[floor], places.highest_m[floor])
    turned = frame == "level"
    heading = rng.uniform(-np.pi, np.pi, n) if frame != "building" else np.zeros(n)
    if turned and step.heading_rad is not None:
        heading = step.heading_rad + (step.heading_sd_rad or 0.0) * rng.normal(size=n)
    particles = new_particles(position, floor, heading, offset_variance_uT2)
    particles.rows[:, SCALE] += options.step_scale_sd * rng.normal(size=n)
    particles.rows[:, COURSE] = options.course_sd_rad * rng.normal(size=n)
    if frame != "building":
        particles.rows[:, DRIFT] = options.heading_drift_sd_rad_per_m * rng.normal(size=n)
    return replace(particles, log_weight=np.full(n, -np.log(n)))


def _anywhere(
    floors: Sequence[SearchableFloor], count: int, rng: np.random.Generator
) -> tuple[Array, NDArray[np.int64]]:
    """Positions (n, 3) and floors, evenly over all that is mapped."""
    cells = []
    for k, floor in enumerate(floors):
        plane = floor.planes[len(floor.planes) // 2]
        row, column = np.nonzero(plane.measured)
        x0, y0 = plane.origin_m
        size = np.full(len(row), plane.resolution_m)
        cells.append(np.column_stack([
            x0 + size * column, y0 + size * row, np.full(len(row), plane.height_m), np.full(len(row), k), size,
        ]))  # fmt: skip
    cell = np.concatenate(cells)
    chosen = cell[rng.choice(len(cell), count, p=cell[:, 4] ** 2 / np.sum(cell[:, 4] ** 2))]
    position = chosen[:, :3].copy()
    position[:, :2] += chosen[:, 4:] * rng.uniform(-0.5, 0.5, size=(count, 2))
    return position, chosen[:, 3].astype(np.int64)


def _draw(
    matched: Matched, places: Places, frame: WindowFrame, count: int, rng: np.random.Generator
) -> tuple[Particles, Array]:
    """Particles at the end of the window, and the log of what each was drawn with, up to a constant."""
    w = np.exp(matched.score - matched.score[0])
    edges = np.cumsum(w)
    chosen = np.searchsorted(edges, (rng.uniform() + np.arange(count)) / count * edges[-1], side="right")
    chosen = np.minimum(chosen, len(w) - 1)
    found, courses = matched.candidates, matched.courses
    plane, course = found.plane[chosen], found.course[chosen]
    cell = np.array([each.resolution_m for each in matched.planes])[plane]
    floor = matched.plane_floor[plane]
    spread = rng.uniform(-0.5, 0.5, size=(count, 5))
    position = np.column_stack([
        matched.position_m[chosen] + cell[:, None] * spread[:, :2],
        np.array([each.height_m for each in matched.planes])[plane],
    ])  # fmt: skip
    half_m = 0.5 * float(matched.window.path_m[-1] - matched.window.path_m[0])
    drift, heading = courses.drift_rad_per_m[course], courses.heading_rad[course]
    if frame != "building":
        drift = drift + courses.steps.drift_rad_per_m * spread[:, 4] * (matched.options.heading_drift_sd_rad_per_m > 0)
        heading = heading + courses.steps.heading_rad * spread[:, 2]
    particles = new_particles(position, floor, heading + drift * half_m, 0.0)
    particles.rows[:, DRIFT] = drift
    scale = courses.scale[course]
    if matched.options.step_scale_sd > 0.0:
        scale = scale + courses.steps.scale * spread[:, 3]
    particles.rows[:, SCALE] = scale
    return particles, matched.score[chosen] - courses.log_prior[course]


def _carried(
    ends: Particles, moves: Moves, places: Places, barriers: Barriers, offset_variance_uT2: float
) -> tuple[Particles, Array]:
    """Particles carried through the window so that they end where they were drawn: weighed, and where they were."""
    n, length_m = len(ends), float(sum(each.distance_m for each in moves.advances))
    rows = ends.rows.copy()
    rows[:, HEADING] -= rows[:, DRIFT] * length_m
    begun = new_particles(rows[:, :3], ends.floor, rows[:, HEADING], offset_variance_uT2)
    begun.rows[:, [SCALE, DRIFT]] = rows[:, [SCALE, DRIFT]]
    still = np.zeros((n, DRAWS), dtype=np.float32)
    blind = begun
    for each in moves.advances:
        blind = advance(blind, replace(each, features_uT=None, walk=_STILL), places, barriers, still)
    begun.rows[:, [X, Y]] -= blind.rows[:, [X, Y]] - ends.rows[:, [X, Y]]
    begun.rows[:, Z] = ends.rows[:, Z]
    history = np.empty((len(moves.advances), n, 2))
    particles = begun
    for k, each in enumerate(moves.advances):
        particles = advance(particles, replace(each, walk=_STILL, risen_m=0.0), places, barriers, still)
        history[k] = particles.position_m
    return particles, history


def _only(particles: Particles, kept: NDArray[np.bool_]) -> Particles:
    return Particles(particles.rows[kept], particles.floor[kept], particles.log_weight[kept])


Inside = Callable[[str, Array, Array], NDArray[np.bool_]]


def walkable_cells(ground: Ground | None) -> Inside | None:
    """(floor id, x_m (nx,), y_m (ny,)) -> (ny, nx) where one can walk, as the search asks; None: anywhere."""
    if ground is None or not ground.walkable:
        return None

    def inside(floor_id: str, x_m: Array, y_m: Array) -> NDArray[np.bool_]:
        test = ground.walkable.get(floor_id)
        x, y = np.meshgrid(x_m, y_m)
        if test is None:
            return np.ones(x.shape, dtype=np.bool_)
        return np.asarray(test(np.column_stack([x.ravel(), y.ravel()]))).reshape(x.shape)

    return inside
