"""Errors along a walk: white noise plus an Ornstein-Uhlenbeck process over the distance walked, whitened in O(n).

In units of the white variance the covariance of one walk's errors is `R = I + ratio * exp(-|s - s'| / length)`.
Differencing with `rho = exp(-step / length)` makes R tridiagonal, and a banded Cholesky factor whitens it: the
innovations of the Kalman filter of the same model, for any spacing and for walks that leave a tile and come back.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cholesky_banded
from scipy.linalg.lapack import dtbtrs

from app.geometry import Array

__all__ = ["WHITE", "WalkNoise", "whiten"]


@dataclass(frozen=True, slots=True)
class WalkNoise:
    """The shape of R: variance of the correlated error over that of the white one, and its length along the path."""

    variance_ratio: float
    length_m: float


WHITE = WalkNoise(0.0, 1.0)


def whiten(columns: Array, path_m: Array, noise: WalkNoise) -> tuple[Array, float]:
    """`W columns` with `W R W^T = I`, and log det R. columns (n, k); path_m (n,) never decreasing."""
    if noise.variance_ratio == 0.0:
        return columns, 0.0
    rho = np.exp(-np.diff(path_m) / noise.length_m)
    differenced = np.array(columns, order="F")
    differenced[1:] -= rho[:, None] * columns[:-1]
    band = np.zeros((2, len(path_m)))
    band[0, 0] = noise.variance_ratio + 1.0
    band[0, 1:] = noise.variance_ratio * (1.0 - rho**2) + 1.0 + rho**2
    band[1, :-1] = -rho
    factor = cholesky_banded(band, lower=True, check_finite=False)
    white, info = dtbtrs(factor, differenced, uplo="L", overwrite_b=1)
    assert info == 0, info
    return np.asarray(white), float(2.0 * np.sum(np.log(factor[0])))
