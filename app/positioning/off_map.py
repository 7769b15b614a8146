"""The hypothesis that a window was walked where nothing is mapped: its evidence under a Gaussian process.

The field beyond the map is taken to be like the mapped one: the ambient mean, the map's prior variance, and a length
scale at which it is as steep as the map is. So smooth a field gives correlated samples, and the evidence charges for
the independent numbers a window holds, not for its samples. With the same errors on both sides, those of a typical
measured cell, its ratio to the evidence of the map's poses is a Bayes factor (Kuevor and Shockley have no such
hypothesis). A window that is on the map ends where something was measured: its prior odds are against those poses,
so that empty cells of a grid do not make this hypothesis the likelier beforehand.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist

from app.field.kernels import covariance
from app.geometry import Array
from app.positioning.features import reduce_variance
from app.positioning.floors import Plane
from app.positioning.lattice import single_course, turn_window
from app.positioning.matching import Matched, prior_mass

__all__ = ["Evidence", "OffMap", "ProcessPrior", "off_map", "process_evidence", "process_prior"]

OFF_MAP_PRIOR = 0.5  # how likely, before the window is looked at, it was walked where nothing is mapped


@dataclass(frozen=True, slots=True, eq=False)
class ProcessPrior:
    """A Matern 3/2 field about its ambient value: variance_uT2 (c,) of the components, and one length scale."""

    variance_uT2: Array
    length_m: float


class Evidence(NamedTuple):
    """log_l (h,) and squared Mahalanobis distance (h,), per heading."""

    log_l: Array
    distance2: Array


@dataclass(frozen=True, slots=True)
class OffMap:
    """The hypothesis that none of a window is mapped.

    mass                 in units of the best pose's posterior, as the masses of candidates are
    distance2, scalars   how well the best heading fits: a chi-square, and its degrees of freedom
    """

    mass: float
    distance2: float
    scalars: float


def off_map(matched: Matched, peak: float) -> OffMap:
    """Weigh the hypothesis against the candidates: prior odds times the ratio of evidences, in units of exp(peak)."""
    best = int(matched.candidates.plane[0])
    plane, window, error = matched.planes[best], matched.window, matched.error
    floor = matched.floors[matched.plane_floor[best]]
    grid, scale2 = floor.grid, np.square(window.scale)
    variance = scale2 * reduce_variance(
        grid.ambient_uT, np.square(grid.prior_sd_uT), grid.components, window.components
    )
    sd = np.sqrt(error.own_share * plane.typical_variance_uT2 + window.noise_variance_uT2)
    correlated = sd[:, None] * error.correlation * sd
    headings = single_course(np.unique(matched.courses.heading_rad))
    residual = turn_window(window, headings, plane.resolution_m).features_uT - plane.ambient_uT
    prior = process_prior(plane, variance)
    fit = process_evidence(residual, window.from_last_m, correlated, prior, error.offset_precision)
    log_heading = _heading_log(matched, headings.heading_rad)
    relative = np.exp(np.clip(fit.log_l - peak, -600, 600))
    weight = np.exp(log_heading)
    odds = OFF_MAP_PRIOR / (1.0 - OFF_MAP_PRIOR)
    return OffMap(
        mass=float(odds * _measured_mass(matched) * (weight @ relative) / weight.sum()),
        distance2=float(fit.distance2.min()),
        scalars=float(window.features_uT.size),
    )


def _measured_mass(matched: Matched) -> float:
    """The part of the prior's mass that ends on measured cells."""
    allowed = matched.pose_prior.walkable or [np.ones(plane.shape, dtype=np.bool_) for plane in matched.planes]
    measured = [mask & plane.measured for mask, plane in zip(allowed, matched.planes, strict=True)]
    return prior_mass(matched.planes, replace(matched.pose_prior, walkable=measured), matched.courses)


def _heading_log(matched: Matched, heading_rad: Array) -> Array:
    """Log prior of each heading: what its courses weigh together."""
    _, group = np.unique(matched.courses.heading_rad, return_inverse=True)
    return np.asarray(np.log(np.bincount(group, weights=np.exp(matched.courses.log_prior)) + 1e-300))


def process_evidence(
    residual_uT: Array, position_m: Array, error_uT2: Array, prior: ProcessPrior, offset_precision: float | None
) -> Evidence:
    """Log evidence of residuals (h, n, c) about the ambient field, at positions (n, 2), errors of covariance (n, n).

    `log N(r; 0, K + C)` summed over components; with a precision, a constant per component is integrated out under its
    prior, flat if zero. One Cholesky factor per component serves all headings, since turning a window leaves its
    distances as they are.
    """
    n, c = len(position_m), residual_uT.shape[2]
    correlation = covariance("matern32", cdist(position_m, position_m), prior.length_m)
    log_l, distance2 = np.zeros(len(residual_uT)), np.zeros(len(residual_uT))
    for k in range(c):
        factor = np.linalg.cholesky(prior.variance_uT2[k] * correlation + error_uT2)
        white = solve_triangular(factor, residual_uT[:, :, k].T, lower=True)
        log_det = 2.0 * float(np.log(np.diag(factor)).sum()) + n * np.log(2.0 * np.pi)
        square = np.sum(np.square(white), axis=0)
        if offset_precision is not None:
            one = solve_triangular(factor, np.ones(n), lower=True)
            total = float(one @ one) + offset_precision
            square = np.maximum(square - np.square(one @ white) / total, 0.0)
            log_det += float(np.log(total / (offset_precision or 2.0 * np.pi)))
        log_l -= 0.5 * (square + log_det)
        distance2 += square
    return Evidence(log_l, distance2)


def process_prior(plane: Plane, variance_uT2: Array) -> ProcessPrior:
    """The process of the given variances (c,) that is as steep as a plane's measured cells are.

    A Matern 3/2 field of variance s^2 has a mean squared gradient of 6 s^2 / length^2 over the plane. A flat map, or
    one of scattered cells, leaves the length scale at that of the whole plane.
    """
    widest = plane.resolution_m * max(plane.shape)
    steepest = np.sqrt(6.0 * float(variance_uT2.sum()))
    length_m = steepest / max(plane.gradient_uT_per_m, 1e-9)
    return ProcessPrior(variance_uT2, float(np.clip(length_m, plane.resolution_m, widest)))
