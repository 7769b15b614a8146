"""Match a window with the candidate floors: reduce it, choose the courses, search, score what was found in full."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.errors import Fault, InvalidInput
from app.field.error_structure import ErrorStructure, strictest
from app.field.samples import Components
from app.geometry import Array, wrap_angle_rad
from app.positioning.feature_matching import feature_candidates, find_feature, with_aligned
from app.positioning.fix import LocateOptions, Prior
from app.positioning.floors import Plane, SearchableFloor
from app.positioning.lattice import (
    Courses,
    ReducedWindow,
    Turned,
    course_lattice,
    lattice_noise_uT2,
    reduce_window,
    turn_window,
    widest_steps,
)
from app.positioning.scoring import score_poses
from app.positioning.search import Candidates, PosePrior, search
from app.positioning.window import Composition, Window, course_yaw_rad
from app.positioning.window_error import WindowError, differenced, window_error

__all__ = ["Matched", "device_turn_rad", "match", "prior_mass"]

_KEPT_NATS = 10.0  # poses this much less likely than the best, as they are searched, are left out of the belief
_SAMPLES = 40  # of a window of some length: more are averaged, as long as they stay near each other
_SPACING_M = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Matched:
    """A window matched with floors.

    floors, planes     planes[k] belongs to floors[plane_floor[k]]
    window, error      as it was matched; `turned[k]` the window on planes[k]
    structure          of the errors of the floors' maps, the strictest of theirs
    courses            of the lattice; `device_turn_rad` is added for the device's heading at the last sample (None: a
                       building window has no heading to tell)
    candidates         poses of the lattice; position_m (n, 2) of the last sample
    score              (n,) log density of the window's features under the full covariance, plus log prior, best first
    distance2          (n,) its squared distance
    best               the candidate that answers for maximum likelihood: the first; of a feature the first whose peak
                       lies on one of the map's
    pose_prior         of the position
    """

    floors: tuple[SearchableFloor, ...]
    planes: tuple[Plane, ...]
    plane_floor: NDArray[np.int64]
    window: ReducedWindow
    turned: tuple[Turned, ...]
    error: WindowError
    structure: ErrorStructure
    courses: Courses
    asked: Window
    composition: Composition
    options: LocateOptions
    device_turn_rad: float | None
    candidates: Candidates
    position_m: Array
    score: Array
    distance2: Array
    best: int
    pose_prior: PosePrior

    def floor_id(self, plane: int) -> str:
        return self.floors[int(self.plane_floor[plane])].floor_id

    def place(self, plane: int, position_m: Array) -> tuple[float, float, float]:
        """A position (x, y, ...) on a plane in three dimensions."""
        return float(position_m[0]), float(position_m[1]), self.planes[plane].height_m

    def device_heading_rad(self, pose: Array) -> float | None:
        """Yaw of the device at the last sample, from a refined pose; None for a building window."""
        if self.device_turn_rad is None:
            return None
        half_m = 0.5 * float(self.window.path_m[-1] - self.window.path_m[0])
        return float(wrap_angle_rad(pose[2] + pose[4] * half_m + self.device_turn_rad))


def match(
    window: Window,
    floors: Sequence[SearchableFloor],
    components: Components,
    composition: Composition,
    prior: Prior | None,
    options: LocateOptions,
) -> Matched:
    """Search all floors, which must already hold `components`, for every pose that matters."""
    planes = tuple(plane for floor in floors for plane in floor.planes)
    typical = float(np.mean([plane.typical_variance_uT2 for plane in planes]))
    structure = strictest([floor.grid.error_structure for floor in floors])
    reduced = _reduced(window, components, planes, structure.white_share * typical)
    known = composition in ("raw", "feature")
    bias_sd_uT = options.bias_sd_uT if known else None
    feature = None
    if composition == "feature":
        feature = find_feature(reduced, float(np.sqrt(typical)))
        reduced = feature.section
    error = window_error(reduced.path_m, reduced.noise_variance_uT2, typical, structure, bias_sd_uT)
    searched = min(plane.searched_variance_uT2 for plane in planes)
    variance = error.inflation * (error.own_share * searched + reduced.noise_variance_uT2)
    steepest = max(plane.gradient_uT_per_m for plane in planes)
    steps = widest_steps(reduced, steepest, variance, error.offset_precision)
    courses = course_lattice(window, steps, options.step_scale_sd, options.heading_drift_sd_rad_per_m)
    between = lattice_noise_uT2(reduced, steepest, courses.steps)
    on_lattice = replace(reduced, noise_variance_uT2=reduced.noise_variance_uT2 + between)
    pose_prior = PosePrior(
        prior.position_m if prior else None, prior.sd_m if prior else 1.0, _walkable(floors, options)
    )
    kept = max(_KEPT_NATS, float(np.log(options.mlr_ratio)) + 1.0)
    found = search(planes, on_lattice, courses, pose_prior, error, window_nats=kept, out_of_time=options.out_of_time)
    aligned = np.ones(len(found.plane), dtype=np.bool_)
    if feature is not None:
        found, aligned = with_aligned(found, feature_candidates(feature, planes, courses))
    found, aligned = _kept_to(found, aligned, pose_prior)
    by_resolution = {cell_m: turn_window(reduced, courses, cell_m) for cell_m in {p.resolution_m for p in planes}}
    turned = tuple(by_resolution[plane.resolution_m] for plane in planes)
    if composition == "differenced":
        error = replace(error, whiten=differenced(len(reduced)), log_det=0.0, offset_precision=None)
    score, distance2 = _scored(planes, on_lattice, turned, found, error)
    position = _positions(planes, found)
    score = score + _log_prior(planes, found, courses, position, pose_prior)
    order = np.argsort(-score, kind="stable")
    found, aligned = found.take(order), aligned[order]
    return Matched(
        floors=tuple(floors),
        planes=planes,
        plane_floor=np.array([k for k, floor in enumerate(floors) for _ in floor.planes]),
        window=reduced,
        turned=turned,
        error=error,
        structure=structure,
        courses=courses,
        asked=window,
        composition=composition,
        options=options,
        device_turn_rad=None if window.frame == "building" else device_turn_rad(window),
        candidates=found,
        position_m=position[order],
        score=score[order],
        distance2=distance2[order],
        best=int(np.argmax(aligned)),
        pose_prior=pose_prior,
    )


def device_turn_rad(window: Window) -> float:
    """Yaw of the device at the last sample from the frame of the first: told, or how much the course turned."""
    if window.yaw_rad is not None:
        return float(window.yaw_rad[-1])
    return float(np.angle(np.exp(1j * course_yaw_rad(window.displacement_m)[-1])))


def _reduced(window: Window, components: Components, planes: Sequence[Plane], white_uT2: float) -> ReducedWindow:
    """Samples no nearer than a cell, and no more of them than tell anything new.

    White noise of a surveyor's sensor is part of what readings differ from the map by: the window's own counts where it
    is larger.
    """
    cell_m = min(plane.resolution_m for plane in planes)
    d = np.asarray(window.displacement_m, dtype=np.float64)[:, :2]
    length_m = float(np.linalg.norm(np.diff(d, axis=0), axis=1).sum())
    spacing_m = max(cell_m, min(length_m / _SAMPLES, _SPACING_M))
    reduced = reduce_window(window, components, spacing_m, planes[0].scale)
    return replace(reduced, noise_variance_uT2=np.maximum(reduced.noise_variance_uT2 - white_uT2, 0.0))


def _kept_to(found: Candidates, aligned: NDArray[np.bool_], prior: PosePrior) -> tuple[Candidates, NDArray[np.bool_]]:
    """The candidates the last sample may be at. Raises InvalidInput when there are none."""
    kept = np.ones(len(found.plane), dtype=np.bool_)
    for k, mask in enumerate(prior.walkable or ()):
        here = found.plane == k
        kept[here] = mask[found.row[here], found.column[here]]
    if not kept.any():
        reason = "no cell of the maps lies in the walkable area: check its coordinates, metres in the building frame"
        raise InvalidInput(reason, Fault("/options/walkable", reason))
    return (found, aligned) if kept.all() else (found.take(kept), aligned[kept])


def _scored(
    planes: Sequence[Plane], window: ReducedWindow, turned: Sequence[Turned], found: Candidates, error: WindowError
) -> tuple[Array, Array]:
    """Log density and squared distance (n,) of every candidate."""
    log_l, distance2 = np.zeros(len(found.score)), np.zeros(len(found.score))
    for k, plane in enumerate(planes):
        here = found.plane == k
        if here.any():
            poses = found.course[here], found.row[here], found.column[here]
            fit = score_poses(plane, window, turned[k], poses, error)
            log_l[here], distance2[here] = fit.log_l, fit.distance2
    return log_l, distance2


def _log_prior(
    planes: Sequence[Plane], found: Candidates, courses: Courses, position_m: Array, prior: PosePrior
) -> Array:
    log_prior = courses.log_prior[found.course]
    if prior.position_m is None:
        return np.asarray(log_prior)
    height_m = np.array([plane.height_m for plane in planes])[found.plane]
    off = np.column_stack([position_m, height_m]) - np.array(prior.position_m)
    return np.asarray(log_prior - 0.5 * np.sum(np.square(off), axis=1) / prior.sd_m**2)


def _positions(planes: Sequence[Plane], found: Candidates) -> Array:
    origin = np.array([plane.origin_m for plane in planes])[found.plane]
    cell = np.array([plane.resolution_m for plane in planes])[found.plane]
    return np.asarray(origin + cell[:, None] * np.stack([found.column, found.row], axis=1))


def _walkable(floors: Sequence[SearchableFloor], options: LocateOptions) -> list[NDArray[np.bool_]] | None:
    """Per plane, the cells whose centres the options' area holds."""
    if options.walkable is None:
        return None
    masks = []
    for floor in floors:
        for plane in floor.planes:
            ny, nx = plane.shape
            x = np.asarray(plane.origin_m[0] + plane.resolution_m * np.arange(nx))
            y = np.asarray(plane.origin_m[1] + plane.resolution_m * np.arange(ny))
            masks.append(np.asarray(options.walkable(floor.floor_id, x, y), dtype=np.bool_))
    return masks


def prior_mass(planes: Sequence[Plane], prior: PosePrior, courses: Courses) -> float:
    """Of the lattice under the priors, each pose weighing exp(log prior); never zero."""
    total = 0.0
    for k, plane in enumerate(planes):
        ny, nx = plane.shape
        mask = None if prior.walkable is None else prior.walkable[k]
        if prior.position_m is None:
            total += float(ny * nx if mask is None else mask.sum())
            continue
        x = plane.origin_m[0] + plane.resolution_m * np.arange(nx) - prior.position_m[0]
        y = plane.origin_m[1] + plane.resolution_m * np.arange(ny) - prior.position_m[1]
        height = np.exp(-0.5 * ((plane.height_m - prior.position_m[2]) / prior.sd_m) ** 2)
        along_y, along_x = np.exp(-0.5 * (y / prior.sd_m) ** 2), np.exp(-0.5 * (x / prior.sd_m) ** 2)
        held = along_y.sum() * along_x.sum() if mask is None else along_y @ mask @ along_x
        total += float(height * held)
    return max(float(np.exp(courses.log_prior).sum()) * total, 1e-300)
