"""Learn how errors hang together along walks from the surveys left out, each against the map of the others."""

from collections.abc import Mapping

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.optimize import nnls

from app.field.error_structure import UNKNOWN_STRUCTURE, ErrorStructure
from app.field.leave_one_out import LAG_M, MAX_LAG_M, HeldOut
from app.field.tally import means_of_places
from app.geometry import Array

__all__ = ["held_out_structure"]

_LENGTHS_M = np.geomspace(0.25, 8.0, 21)
_LEAST_PAIRS = 50
_LEAST_WHITE = 0.02  # without it two readings side by side would be worth infinitely much


def held_out_structure(held_out: Mapping[str, HeldOut]) -> ErrorStructure:
    """Least squares fit of the model to the pooled autocovariance of errors in predictive sds, up to twenty metres.

    UNKNOWN_STRUCTURE when too few stretches are judged.
    """
    lags = int(MAX_LAG_M / LAG_M)
    products, pairs = np.zeros(lags), np.zeros(lags)
    for survey in held_out.values():
        path_m = survey.path_m[survey.judged]
        if len(path_m) == 0:
            continue
        cell = np.floor(path_m / LAG_M).astype(np.int64)
        cell -= cell[0]
        z, count = means_of_places(
            np.clip(survey.standardised, -5.0, 5.0), cell, np.ones(len(cell), dtype=np.bool_), int(cell[-1]) + 1
        )
        _add_lagged_products(z, count > 0, products, pairs)
    known = pairs >= _LEAST_PAIRS
    if not known[0] or products[0] <= 0.0 or np.count_nonzero(known) < 8:
        return UNKNOWN_STRUCTURE
    lag_m = np.asarray(LAG_M * np.flatnonzero(known)[1:])
    covariance = products[known] / pairs[known]
    weight = np.asarray(np.sqrt(pairs[known][1:] / pairs[0]))
    fits = [_fit(lag_m, covariance[1:], weight, length_m) for length_m in _LENGTHS_M]
    best = int(np.argmin([misfit for misfit, _ in fits]))
    constant, walk = (float(share) for share in fits[best][1])
    white = max(float(covariance[0]) - constant - walk, _LEAST_WHITE * float(covariance[0]))
    return ErrorStructure(constant, walk, white, float(_LENGTHS_M[best]))


def _fit(lag_m: Array, covariance: Array, weight: Array, length_m: float) -> tuple[float, Array]:
    """(misfit, (constant, walk)) of the best shares, neither negative, at one length."""
    design = np.column_stack([np.ones(len(lag_m)), np.exp(-lag_m / length_m)])
    shares, misfit = nnls(weight[:, None] * design, weight * covariance)
    return float(misfit), shares


@njit(cache=True)
def _add_lagged_products(z: Array, known: NDArray[np.bool_], products: Array, pairs: Array) -> None:
    """Add the products of cells (n, c) at every lag, and how many there are."""
    n, c = z.shape
    for lag in range(min(len(products), n)):
        for i in range(lag, n):
            if known[i] and known[i - lag]:
                pairs[lag] += c
                for m in range(c):
                    products[lag] += z[i, m] * z[i - lag, m]
