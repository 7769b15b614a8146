"""Errors along a walk: white noise plus an Ornstein-Uhlenbeck process over the distance walked, whitened in O(n).

In units of the white variance the covariance of one walk's errors is `R = I + ratio * exp(-|s - s'| / length)`.
Differencing with `rho = exp(-step / length)` makes R tridiagonal, and its Cholesky factor, of one band, whitens it: the
innovations of the Kalman filter of the same model, for any spacing and for walks that leave a tile and come back.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit

from app.geometry import Array

__all__ = ["WHITE", "WalkNoise", "whiten"]


@dataclass(frozen=True, slots=True)
class WalkNoise:
    """The shape of R: variance of the correlated error over that of the white one, and its length along the path."""

    variance_ratio: float
    length_m: float


WHITE = WalkNoise(0.0, 1.0)


def whiten(columns: Array, path_m: Array, noise: WalkNoise, white_scale: Array | None = None) -> tuple[Array, float]:
    """`W columns` with `W R W^T = I`, and log det R. columns (n, k); path_m (n,) never decreasing.

    white_scale (n,): factors on the white variance of single rows, 1 for all when not given.
    """
    if white_scale is None:
        if noise.variance_ratio == 0.0:
            return columns, 0.0
        white_scale = np.ones(len(columns))
    rho = np.exp(-np.diff(path_m) / noise.length_m)
    return _whiten(np.ascontiguousarray(columns), rho, noise.variance_ratio, white_scale)


@njit(cache=True)
def _whiten(columns: Array, rho: Array, variance_ratio: float, white_scale: Array) -> tuple[Array, float]:
    """Differences, and forward substitution with the Cholesky factor of their tridiagonal covariance, row by row."""
    white = np.empty_like(columns)
    scale = np.sqrt(variance_ratio + white_scale[0])
    white[0] = columns[0] / scale
    log_det = 2.0 * np.log(scale)
    for i in range(1, len(columns)):
        r = rho[i - 1]
        below = -r * white_scale[i - 1] / scale
        scale = np.sqrt(variance_ratio * (1.0 - r * r) + white_scale[i] + r * r * white_scale[i - 1] - below * below)
        for j in range(columns.shape[1]):
            white[i, j] = (columns[i, j] - r * columns[i - 1, j] - below * white[i - 1, j]) / scale
        log_det += 2.0 * np.log(scale)
    return white, log_det
