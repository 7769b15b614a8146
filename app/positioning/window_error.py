"""One covariance for the errors of a window: a constant offset, errors alike along the walk, white noise.

At the right pose the residuals r_i = z_i - m(p_i), turned to the sensor's axes, have per component the covariance
    C = D^1/2 R D^1/2 + s_b^2 1 1',    D = diag((w + u) V_i + noise_i),    R_ij = w' exp(-|s_i - s_j| / l), R_ii = 1,
where s_i is the distance walked, V_i the variance of one measurement about the map there, w, u and l the shares of walk
and white noise and the length that surveys left out have shown (`ErrorStructure`; the constant share is part of s_b^2),
w' the part of D that is walk noise, and s_b what is not known of the sensor's offset.

The search scores with f D + s_b^2 1 1', f the largest eigenvalue of R: that covariance dominates C, so the squared
distance of a pose under the model is never less than the one it was searched by. Poses that were found are then scored
under C itself.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cholesky, solve_triangular

from app.field.error_structure import ErrorStructure
from app.geometry import Array

__all__ = ["Fit", "WindowError", "plain_error", "weigh_residuals", "window_error"]


@dataclass(frozen=True, slots=True, eq=False)
class WindowError:
    """whiten            (k, n) W with W R W' = 1: |W D^-1/2 r|^2 is the squared distance, before an offset
    correlation        (n, n) R
    log_det            of R
    inflation          largest eigenvalue of R
    own_share          share of the map's variance that is not constant over a window
    offset_precision   1 / s_b^2, zero for a flat prior, None for no offset at all
    """

    whiten: Array
    correlation: Array
    log_det: float
    inflation: float
    own_share: float
    offset_precision: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How well residuals fit, (...,) each: log density of the features, and the squared distance it is of."""

    log_l: Array
    distance2: Array


def window_error(
    path_m: Array, noise_uT2: Array, map_variance_uT2: float, structure: ErrorStructure, bias_sd_uT: float | None
) -> WindowError:
    """The errors of a window of samples at path_m (n,), with sensor noise (n,) on a map of that typical variance.

    bias_sd_uT: what is not known of the sensor's offset; None: nothing is known (a flat prior, "demeaned").
    """
    own = structure.walk_share + structure.white_share
    white = float(np.mean(noise_uT2))
    share = structure.walk_share * map_variance_uT2 / (own * map_variance_uT2 + white)
    apart = np.abs(path_m[:, None] - path_m[None, :])
    R = share * np.exp(-apart / structure.walk_length_m)
    np.fill_diagonal(R, 1.0)
    precision: float | None = 0.0
    if bias_sd_uT is not None:
        variance = bias_sd_uT**2 + structure.constant_share * map_variance_uT2
        precision = 1.0 / variance if variance > 0.0 else None
    factor = cholesky(R, lower=True)
    whiten = solve_triangular(factor, np.eye(len(R)), lower=True)
    return WindowError(
        np.ascontiguousarray(whiten), R, 2.0 * float(np.log(np.diag(factor)).sum()),
        float(np.linalg.eigvalsh(R)[-1]), own, precision,
    )  # fmt: skip


def plain_error(samples: int, offset_precision: float | None = None) -> WindowError:
    """Independent errors, with or without an offset (Shockley 7.1)."""
    return WindowError(np.eye(samples), np.eye(samples), 0.0, 1.0, 1.0, offset_precision)


def weigh_residuals(residual: Array, variance: Array, error: WindowError) -> Fit:
    """Log density of residuals (..., n, c), in the sensor's axes, with variances (..., n) of the diagonal D.

    With a flat prior the offset costs one Gaussian factor per component (Shockley 8.6, L1236).
    """
    c = residual.shape[-1]
    root = 1.0 / np.sqrt(variance)
    white = error.whiten @ (residual * root[..., None])
    distance2 = np.sum(np.square(white), axis=(-2, -1))
    log_l = -0.5 * c * (np.sum(np.log(2.0 * np.pi * variance), axis=-1) + error.log_det)
    if error.offset_precision is not None:
        one = root @ error.whiten.T
        total = np.sum(np.square(one), axis=-1) + error.offset_precision
        shared = np.einsum("...n,...nc->...c", one, white)
        distance2 = np.maximum(distance2 - np.sum(np.square(shared), axis=-1) / total, 0.0)
        log_l = log_l - 0.5 * c * np.log(total / (error.offset_precision or 2.0 * np.pi))
    return Fit(np.asarray(log_l - 0.5 * distance2), np.asarray(distance2))


def differenced(samples: int) -> NDArray[np.float64]:
    """(n - 1, n) first differences along the window (Shockley 8.6): unwhitened, as the seed compares them."""
    return np.asarray(np.diff(np.eye(samples), axis=0))
