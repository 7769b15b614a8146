"""Matching by mean absolute deviation: the candidate whose readings differ least from the map's (Cuenca 1.10)."""

from typing import NamedTuple

import numpy as np

from app.geometry import Array

__all__ = ["MadChoice", "least_deviation", "mean_absolute_deviation"]


class MadChoice(NamedTuple):
    """The best candidate, its deviation in uT, and that of the best one elsewhere over it: at least 1, inf if alone."""

    candidate: int
    mad_uT: float
    ratio: float


def mean_absolute_deviation(residual_uT: Array, least_share: float = 0.5) -> Array:
    """Mean over samples and components of |residual| (k, n, c) per candidate, uT (k,) (Cuenca, L629, eq. 3.5).

    A residual is NaN where the map says nothing. A candidate with less than `least_share` of its residuals is NaN: the
    mean over few samples is small by chance.
    """
    known = np.isfinite(residual_uT)
    count = known.sum(axis=(1, 2))
    total = np.abs(residual_uT, where=known, out=np.zeros_like(residual_uT)).sum(axis=(1, 2))
    enough = count >= max(1.0, least_share * residual_uT.shape[1] * residual_uT.shape[2])
    return np.where(enough, total / np.maximum(count, 1), np.nan)


def least_deviation(mad_uT: Array, position_m: Array, min_distance_m: float) -> MadChoice | None:
    """The candidate of the least deviation (k,), and how far behind is the best one at least `min_distance_m` away.

    `position_m` (k, d). Candidates whose deviation is NaN take no part; None when none is left. The ratio second best
    over best is the confidence: near 1 two places fit alike.
    """
    known = np.flatnonzero(np.isfinite(mad_uT))
    if not len(known):
        return None
    best = int(known[np.argmin(mad_uT[known])])
    apart = known[np.linalg.norm(position_m[known] - position_m[best], axis=1) >= min_distance_m]
    apart = apart[apart != best]
    if not len(apart):
        return MadChoice(best, float(mad_uT[best]), np.inf)
    second, least = float(mad_uT[apart].min()), float(mad_uT[best])
    return MadChoice(best, least, second / least if least > 0.0 else (np.inf if second > 0.0 else 1.0))
