"""Why an answer is what it is: the likelihood over a floor, what fits and what does not, and the runner-up."""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array
from app.positioning.belief import Belief, BelievedMode
from app.positioning.matching import Matched
from app.positioning.misfit import standardised_residuals
from app.positioning.scoring import score_poses

__all__ = ["Explanation", "ExplainedPlace", "LikelihoodSurface", "explain"]

_MOST_POSES = 300_000
_MOST_CELLS_A_SIDE = 96


@dataclass(frozen=True, slots=True, eq=False)
class LikelihoodSurface:
    """The log-likelihood of the last sample's place on one layer of a floor, in its best course, less the best of all.

    log_likelihood (ny, nx), cells of `resolution_m` from `origin_m` (x, y of the first): candidates as they were
    scored, between them the best of a coarser lattice
    """

    floor_id: str
    height_m: float
    origin_m: tuple[float, float]
    resolution_m: float
    log_likelihood: Array


@dataclass(frozen=True, slots=True, eq=False)
class ExplainedPlace:
    """A place and how the window fits there.

    position_m (n, 2) of the samples, residual_uT (n, c) window less map in the building frame, standardised (n, c) less
    the sensor's offset, in sds of one reading
    """

    floor_id: str
    position_m: tuple[float, float, float]
    heading_rad: float | None
    probability: float
    log_likelihood: float
    bias_uT: Array
    step_scale: float
    heading_drift_rad_per_m: float
    path_m: Array
    residual_uT: Array
    standardised: Array


@dataclass(frozen=True, slots=True, eq=False)
class Explanation:
    surface: LikelihoodSurface
    best: ExplainedPlace
    runner_up: ExplainedPlace | None
    effective_samples: float


def explain(matched: Matched, belief: Belief) -> Explanation:
    """The likelihood surface of the best match's layer, its residuals, and those of the next best place."""
    others = [mode for mode in belief.modes if mode is not belief.best]
    return Explanation(
        surface=_surface(matched, belief.best.plane),
        best=_place(matched, belief.best),
        runner_up=_place(matched, others[0]) if others else None,
        effective_samples=len(matched.window) / matched.error.inflation,
    )


def _surface(matched: Matched, plane_index: int) -> LikelihoodSurface:
    plane, found = matched.planes[plane_index], matched.candidates
    ny, nx = plane.shape
    stride = max(1, int(np.ceil(max(ny, nx) / _MOST_CELLS_A_SIDE)))
    rows, columns = np.arange(0, ny, stride), np.arange(0, nx, stride)
    courses = np.arange(len(matched.courses))
    thin = max(1, int(np.ceil(len(courses) * len(rows) * len(columns) / _MOST_POSES)))
    h, j, i = (a.ravel() for a in np.meshgrid(courses[thin // 2 :: thin], rows, columns, indexing="ij"))
    fit = score_poses(plane, matched.window, matched.turned[plane_index], (h, j, i), matched.error)
    surface = np.full((len(rows), len(columns)), -np.inf)
    np.maximum.at(surface, (j // stride, i // stride), fit.log_l + matched.courses.log_prior[h])
    here = found.plane == plane_index
    np.maximum.at(surface, (found.row[here] // stride, found.column[here] // stride), matched.score[here])
    origin = tuple(o + plane.resolution_m * (stride - 1) / 2.0 for o in plane.origin_m)
    return LikelihoodSurface(
        matched.floor_id(plane_index), plane.height_m, (origin[0], origin[1]),
        plane.resolution_m * stride, surface - matched.score[0],
    )  # fmt: skip


def _place(matched: Matched, mode: BelievedMode) -> ExplainedPlace:
    plane, fine = matched.planes[mode.plane], mode.refined
    return ExplainedPlace(
        floor_id=matched.floor_id(mode.plane),
        position_m=matched.place(mode.plane, mode.pose),
        heading_rad=matched.device_heading_rad(mode.pose),
        probability=mode.probability,
        log_likelihood=mode.log_l + len(matched.window) * float(np.log(plane.scale).sum()),
        bias_uT=fine.bias_uT[0] / plane.scale,
        step_scale=1.0 + float(mode.pose[3]),
        heading_drift_rad_per_m=float(mode.pose[4]),
        path_m=matched.window.path_m,
        residual_uT=fine.residual_uT[0] / plane.scale,
        standardised=standardised_residuals(matched, fine),
    )
