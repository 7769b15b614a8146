"""Match a window with the candidate floors: reduce it, choose the headings, search, keep what a belief is made of."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.field.samples import Components
from app.geometry import Array
from app.positioning.fix import LocateOptions, Prior
from app.positioning.floors import Plane, SearchableFloor
from app.positioning.lattice import (
    MAX_HEADINGS,
    MIN_HEADINGS,
    ReducedWindow,
    effective_samples,
    heading_lattice,
    reduce_window,
)
from app.positioning.refine import PoseGaussian
from app.positioning.search import Candidates, PosePrior, search
from app.positioning.window import Window

__all__ = ["Matched", "device_turn_rad", "match"]

_KEPT_NATS = 10.0  # tempered: poses this much less likely than the best are left out of the belief
_HEADING_LOSS_NATS = 1.0  # tempered: what a heading midway between two of the lattice may cost
_GATE_SHARE = 2.0  # squares of residuals add one independent term per two correlation lengths
_COURSE_M = 1.0  # the stretch over which a course is taken


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """A window matched with floors.

    floors, planes     planes[k] belongs to floors[plane_floor[k]]
    window             as it was matched; `temper` = its samples / what they are worth as independent ones for a
                       position, `gate_temper` the same for the squares of their residuals
    headings_rad       (h,) yaws of the window's frame; `device_turn_rad` is added for the device's heading at the last
                       sample (None: a building window has no heading to tell)
    candidates         poses of the lattice; position_m (n, 2) of the last sample
    pose_prior         for the lattice; `gaussian` the same prior for refinement
    prior_mass         of the lattice under the priors, each pose weighing exp(log prior)
    """

    floors: tuple[SearchableFloor, ...]
    planes: tuple[Plane, ...]
    plane_floor: NDArray[np.int64]
    window: ReducedWindow
    temper: float
    gate_temper: float
    demeaned: bool
    headings_rad: Array
    device_turn_rad: float | None
    candidates: Candidates
    position_m: Array
    pose_prior: PosePrior
    gaussian: PoseGaussian
    prior_mass: float


def match(
    window: Window,
    floors: Sequence[SearchableFloor],
    components: Components,
    demeaned: bool,
    prior: Prior | None,
    options: LocateOptions,
) -> Matched:
    """Search all floors, which must already hold `components`, for every pose that matters."""
    planes = tuple(plane for floor in floors for plane in floor.planes)
    reduced = reduce_window(window, components, min(plane.resolution_m for plane in planes))
    correlation = max(floor.grid.error_correlation_m for floor in floors)
    temper = len(reduced) / effective_samples(reduced.path_m, correlation)
    headings = heading_lattice(window, _heading_step(reduced, planes, temper, demeaned))
    pose_prior = PosePrior(
        prior.position_m if prior else None, prior.sd_m if prior else 1.0, _heading_log(window, headings)
    )
    kept = max(_KEPT_NATS, float(np.log(options.mlr_ratio)) + 1.0)
    found = search(
        planes, reduced, headings, pose_prior, window_nats=temper * kept, temper=temper, demeaned=demeaned
    )  # fmt: skip
    return Matched(
        floors=tuple(floors),
        planes=planes,
        plane_floor=np.array([k for k, floor in enumerate(floors) for _ in floor.planes]),
        window=reduced,
        temper=temper,
        gate_temper=len(reduced) / effective_samples(reduced.path_m, correlation, _GATE_SHARE),
        demeaned=demeaned,
        headings_rad=headings,
        device_turn_rad=None if window.frame == "building" else device_turn_rad(window),
        candidates=found,
        position_m=_positions(planes, found),
        pose_prior=pose_prior,
        gaussian=_gaussian(window, prior, headings),
        prior_mass=_prior_mass(planes, pose_prior),
    )


def device_turn_rad(window: Window) -> float:
    """Yaw of the device at the last sample from the frame of the first: told, or how much the course turned.

    The course is that of the first and of the last metre; a device that hardly moves is taken not to turn.
    """
    if window.yaw_rad is not None:
        return float(window.yaw_rad[-1])
    d = np.asarray(window.displacement_m, dtype=np.float64)[:, :2]
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(d, axis=0), axis=1))])
    if path[-1] < 0.5 * _COURSE_M:
        return 0.0
    start = d[min(int(np.searchsorted(path, _COURSE_M)), len(d) - 1)] - d[0]
    end = d[-1] - d[max(int(np.searchsorted(path, path[-1] - _COURSE_M, side="right")) - 1, 0)]
    if min(np.linalg.norm(start), np.linalg.norm(end)) < 0.1 * _COURSE_M:
        return 0.0
    return float(np.arctan2(start[0] * end[1] - start[1] * end[0], start @ end))


def _heading_step(window: ReducedWindow, planes: Sequence[Plane], temper: float, demeaned: bool) -> float:
    """A step at which the pose between two headings of the lattice loses at most `_HEADING_LOSS_NATS`, tempered."""
    centred = window.from_last_m - window.from_last_m.mean(axis=0)
    lever = np.sum(np.square(centred), axis=1)
    steepest = max(plane.gradient_uT_per_m for plane in planes)
    change = 0.5 * steepest**2 * lever  # squared, per radian
    if window.turns:
        turning = window.features_uT[:, :2] - (window.features_uT[:, :2].mean(axis=0) if demeaned else 0.0)
        change = change + np.sum(np.square(turning), axis=1)
    least = min(float(plane.pyramid.ladder_uT2[:, 0].min()) for plane in planes)
    information = float(np.sum(change / (least + window.noise_variance_uT2))) / temper
    widest = 2.0 * np.sqrt(2.0 * _HEADING_LOSS_NATS / max(information, 1e-12))
    return float(np.clip(widest, 2 * np.pi / MAX_HEADINGS, 2 * np.pi / MIN_HEADINGS))


def _heading_log(window: Window, headings_rad: Array) -> Array:
    if window.frame == "building" or window.heading_rad is None or not window.heading_sd_rad:
        return np.zeros(len(headings_rad))
    off = np.angle(np.exp(1j * (headings_rad - window.heading_rad)))
    return np.asarray(-0.5 * np.square(off / window.heading_sd_rad))


def _gaussian(window: Window, prior: Prior | None, headings_rad: Array) -> PoseGaussian:
    mean, precision = np.zeros(3), np.zeros(3)
    if prior is not None:
        mean[:2], precision[:2] = prior.position_m[:2], prior.sd_m**-2
    if window.frame != "building" and window.heading_rad is not None and window.heading_sd_rad:
        mean[2], precision[2] = window.heading_rad, window.heading_sd_rad**-2
    return PoseGaussian(mean, precision, np.array([1.0, 1.0, 1.0 if len(headings_rad) > 1 else 0.0]))


def _positions(planes: Sequence[Plane], found: Candidates) -> Array:
    origin = np.array([plane.origin_m for plane in planes])[found.plane]
    cell = np.array([plane.resolution_m for plane in planes])[found.plane]
    return np.asarray(origin + cell[:, None] * np.stack([found.column, found.row], axis=1))


def _prior_mass(planes: Sequence[Plane], prior: PosePrior) -> float:
    headings = float(np.exp(prior.heading_log).sum())
    total = 0.0
    for plane in planes:
        ny, nx = plane.shape
        if prior.position_m is None:
            total += float(ny * nx)
            continue
        x = plane.origin_m[0] + plane.resolution_m * np.arange(nx) - prior.position_m[0]
        y = plane.origin_m[1] + plane.resolution_m * np.arange(ny) - prior.position_m[1]
        height = np.exp(-0.5 * ((plane.height_m - prior.position_m[2]) / prior.sd_m) ** 2)
        across = np.exp(-0.5 * (x / prior.sd_m) ** 2).sum() * np.exp(-0.5 * (y / prior.sd_m) ** 2).sum()
        total += float(height * across)
    return max(headings * total, 1e-300)
