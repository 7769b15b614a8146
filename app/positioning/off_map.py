"""The hypothesis that a window was walked where nothing is mapped: its evidence under a Gaussian process.

The field beyond the map is taken to be like the mapped one: the ambient mean, the map's prior variance, and a length
scale at which it is as steep as the map is. So smooth a field gives correlated samples, and the evidence charges for
the independent numbers a window holds, not for its samples. With the noise of both sides inflated by the temper, its
ratio to the evidence of the map's poses is a Bayes factor (Kuevor and Shockley have no such hypothesis).
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist

from app.field.kernels import covariance
from app.geometry import Array
from app.positioning.features import reduce_variance
from app.positioning.floors import Plane
from app.positioning.lattice import turn_window
from app.positioning.likelihood import window_likelihood
from app.positioning.matching import Matched

__all__ = ["Evidence", "OffMap", "ProcessPrior", "off_map", "process_evidence", "process_prior"]

OFF_MAP_PRIOR = 0.4  # how likely, before the window is looked at, it was walked where nothing is mapped
_MOST_CELLS = 40_000  # enough of a map to know how steep it is


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

    mass                 in units of the best pose's tempered posterior, as the masses of candidates are
    distance2, scalars   how well the best heading fits: a chi-square, and its degrees of freedom
    """

    mass: float
    distance2: float
    scalars: float


def off_map(matched: Matched) -> OffMap:
    """Weigh the hypothesis against the candidates: prior odds times the ratio of evidences."""
    plane, window, temper = matched.planes[int(matched.candidates.plane[0])], matched.window, matched.temper
    grid = matched.floors[matched.plane_floor[matched.candidates.plane[0]]].grid
    variance = reduce_variance(grid.ambient_uT, np.square(grid.prior_sd_uT), grid.components, window.components)
    noise = np.maximum(plane.off_map_variance_uT2 - variance, 1e-6) + window.noise_variance_uT2[:, None]
    residual = turn_window(window, matched.headings_rad, plane.resolution_m).features_uT - plane.ambient_uT
    prior = process_prior(plane, variance)
    fit = process_evidence(residual, window.from_last_m, temper * noise, prior, matched.demeaned)
    relative = np.exp(np.clip(fit.log_l - _best_pose_log_evidence(matched), -600, 600))
    heading = np.exp(matched.pose_prior.heading_log)
    odds = OFF_MAP_PRIOR / (1.0 - OFF_MAP_PRIOR)
    gated = process_evidence(residual, window.from_last_m, matched.gate_temper * noise, prior, matched.demeaned)
    n, c = window.features_uT.shape
    return OffMap(
        mass=float(odds * matched.prior_mass * (heading @ relative) / heading.sum()),
        distance2=float(gated.distance2.min()),
        scalars=float((n - matched.demeaned) * c),
    )


def process_evidence(
    residual_uT: Array, position_m: Array, noise_uT2: Array, prior: ProcessPrior, demeaned: bool
) -> Evidence:
    """Log evidence of residuals (h, n, c) about the ambient field, at positions (n, 2), with noise variances (n, c).

    `log N(r; 0, K + R)` summed over components; demeaned, a constant per component is integrated out under a flat
    prior, as `window_likelihood` does. One Cholesky factor per component serves all headings, since turning a window
    leaves its distances as they are.
    """
    n, c = noise_uT2.shape
    correlation = covariance("matern32", cdist(position_m, position_m), prior.length_m)
    log_l, distance2 = np.zeros(len(residual_uT)), np.zeros(len(residual_uT))
    for k in range(c):
        factor = np.linalg.cholesky(prior.variance_uT2[k] * correlation + np.diag(noise_uT2[:, k]))
        white = solve_triangular(factor, residual_uT[:, :, k].T, lower=True)
        log_det = 2.0 * float(np.log(np.diag(factor)).sum()) + n * np.log(2.0 * np.pi)
        if demeaned:
            one = solve_triangular(factor, np.ones(n), lower=True)
            white = white - np.outer(one, one @ white) / (one @ one)
            log_det += float(np.log(one @ one / (2.0 * np.pi)))
        square = np.sum(np.square(white), axis=0)
        log_l -= 0.5 * (square + log_det)
        distance2 += square
    return Evidence(log_l, distance2)


def process_prior(plane: Plane, variance_uT2: Array) -> ProcessPrior:
    """The process of the given variances (c,) that is as steep as a plane's measured cells are.

    A Matern 3/2 field of variance s^2 has a mean squared gradient of 6 s^2 / length^2 over the plane. A flat map, or
    one of scattered cells, leaves the length scale at that of the whole plane.
    """
    stride = max(1, int(np.sqrt(plane.measured.size / _MOST_CELLS)))
    mean, measured = plane.mean_uT[1:-1, 1:-1].astype(np.float64), plane.measured
    squared = 0.0
    for axis in (0, 1):
        here, there = (slice(None), slice(-1)), (slice(None), slice(1, None))
        one, next_one = (here, there) if axis else (here[::-1], there[::-1])
        both = measured[one] & measured[next_one]
        both[np.arange(len(both)) % stride != 0] = False
        if both.any():
            squared += float(np.mean(np.sum(np.square(mean[next_one][both] - mean[one][both]), axis=1)))
    widest = plane.resolution_m * max(plane.shape)
    steepness = np.sqrt(squared) / plane.resolution_m
    steepest = np.sqrt(6.0 * float(variance_uT2.sum()))
    return ProcessPrior(variance_uT2, float(np.clip(steepest / max(steepness, 1e-9), plane.resolution_m, widest)))


def _best_pose_log_evidence(matched: Matched) -> float:
    """Log density of the window at the best pose of the lattice with tempered noise, and the pose's log prior."""
    found, window, temper = matched.candidates, matched.window, matched.temper
    plane, heading = matched.planes[int(found.plane[0])], int(found.heading[0])
    turned = turn_window(window, matched.headings_rad[heading : heading + 1], plane.resolution_m)
    cells = np.array([found.row[0], found.column[0]]) + turned.offset_cells[0] + 1  # padded by a cell of prior
    row, column = np.clip(cells, 0, np.array(plane.shape) + 1).T
    residual = turned.features_uT[0] - plane.mean_uT[row, column]
    variance = plane.variance_uT2[row, column] + window.noise_variance_uT2[:, None]
    plain = window_likelihood(residual, variance, matched.demeaned)
    tempered = window_likelihood(residual, temper * variance, matched.demeaned)
    return float(tempered.log_l + (found.score[0] - plain.log_l) / temper)
