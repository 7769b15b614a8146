"""Order statistics of many surveys' values, with each survey in turn left out.

Leaving one survey out moves a rank by no more than its own values, so all surveys' answers lie in a short run of the
sorted whole: only that run is sorted, and what a survey has below it is counted.
"""

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["ranked_without"]


def ranked_without(values: Sequence[Array], ranks: NDArray[np.int64]) -> Array:
    """(s, k, c): of every column, the values at ranks (s, k), from zero, of all surveys' (n, c) but the survey's own.

    A survey without values gets the ranks of all. Where the others have fewer values the answer means nothing.
    """
    sizes = [len(own) for own in values]
    owner = np.repeat(np.arange(len(sizes)), sizes)
    pooled = np.concatenate(values).T
    if not len(owner):
        return np.full((*ranks.shape, values[0].shape[1]), np.nan)
    last = np.minimum(ranks.max(axis=1) + np.array(sizes), len(owner) - 1)
    bounds = [int(ranks.min()), int(last.max())]
    return np.stack([_one_column(np.ascontiguousarray(c), owner, ranks, bounds) for c in pooled], axis=-1)


def _one_column(column: Array, owner: NDArray[np.int64], ranks: NDArray[np.int64], bounds: list[int]) -> Array:
    low, high = np.partition(column, bounds)[bounds]
    below, inside = _cut(column, owner, low, high, len(ranks))
    inside = inside[np.argsort(column[inside])]
    places = _places(owner[inside], ranks - below.sum() + below[:, None])
    return np.asarray(column[inside[np.minimum(places, len(inside) - 1)]])


@njit(cache=True)
def _cut(
    column: Array, owner: NDArray[np.int64], low: float, high: float, surveys: int
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """How many values each survey has below `low`, and the indices of those from `low` to `high`."""
    below = np.zeros(surveys, dtype=np.int64)
    inside = np.empty(len(column), dtype=np.int64)
    count = 0
    for i in range(len(column)):
        if column[i] < low:
            below[owner[i]] += 1
        elif column[i] <= high:
            inside[count] = i
            count += 1
    return below, inside[:count].copy()


@njit(cache=True)
def _places(owner: NDArray[np.int64], ranks: NDArray[np.int64]) -> NDArray[np.int64]:
    """Where among sorted values the ranks (s, k) lie when each survey leaves out its own."""
    by_owner = np.argsort(owner, kind="mergesort")
    places = ranks.copy()
    start = 0
    for survey in range(len(ranks)):
        stop = start
        while stop < len(by_owner) and owner[by_owner[stop]] == survey:
            stop += 1
        for k in range(ranks.shape[1]):
            for t in range(start, stop):
                if by_owner[t] > places[survey, k]:
                    break
                places[survey, k] += 1
        start = stop
    return places
