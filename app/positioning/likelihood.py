"""How likely a window is at a pose: Gaussian residuals, raw or with an offset integrated out (Shockley 7-8.6)."""

from typing import NamedTuple

import numpy as np

from app.geometry import Array

__all__ = ["Likelihood", "window_likelihood"]


class Likelihood(NamedTuple):
    """log_l (...,), squared Mahalanobis distance (...,), and the residuals it is of (..., n, c)."""

    log_l: Array
    distance2: Array
    residual: Array


def window_likelihood(residual: Array, variance: Array, demeaned: bool) -> Likelihood:
    """Log-likelihood of residuals (..., n, c) with variances of the same shape (Shockley 7.1, L754).

    Demeaned: an unknown constant per component, under a flat prior, is integrated out; with equal variances that is
    subtracting the means of window and map (Shockley 8.6, L1236), and it costs one Gaussian factor per component.
    """
    weight = 1.0 / np.broadcast_to(variance, residual.shape)
    log_l = 0.5 * np.sum(np.log(weight / (2.0 * np.pi)), axis=(-2, -1))
    if demeaned:
        total = weight.sum(axis=-2, keepdims=True)
        residual = residual - (weight * residual).sum(axis=-2, keepdims=True) / total
        log_l = log_l + 0.5 * np.sum(np.log(2.0 * np.pi / total), axis=(-2, -1))
    distance2 = np.sum(weight * residual**2, axis=(-2, -1))
    return Likelihood(np.asarray(log_l - 0.5 * distance2), np.asarray(distance2), residual)
