"""Which points lie in or near which cells of a lattice, in compiled loops."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["cell_members"]

Indices = NDArray[np.int64]

SPARSE = 16
"""With more cells than this many per point, in the rectangle around all, points are sorted and not counted."""


def cell_members(points_m: Array, pitch_m: float, reach: float) -> tuple[Indices, Indices, list[int]]:
    """Cells (t, 2), in order of column and row, with a point (n, 2) within `reach` pitches; of all cells one after

    the other the indices of their points, ascending; and the bounds (t + 1) of each cell's among these.
    """
    if not len(points_m):
        return np.zeros((0, 2), dtype=np.int64), np.zeros(0, dtype=np.int64), [0]
    scaled = np.ascontiguousarray(points_m.T) / pitch_m  # (2, n): extremes along rows are quick
    first = np.floor(scaled.min(axis=1)).astype(np.int64) - 1
    columns, rows = (np.floor(scaled.max(axis=1)).astype(np.int64) + 2 - first).tolist()
    key, index = _near_cells(scaled, first, rows, reach)
    if columns * rows <= SPARSE * len(points_m):
        order, cells, bounds = _counted(key, columns * rows)
    else:
        order = np.argsort(key, kind="stable")
        cells, start = np.unique(key[order], return_index=True)
        bounds = np.append(start, len(key))
    return first + np.stack(np.divmod(cells, rows), axis=1), index[order], bounds.tolist()


@njit(cache=True)
def _near_cells(scaled: Array, first: Indices, rows: int, reach: float) -> tuple[Indices, Indices]:
    """Key of every cell near a point, and the point, in order of points."""
    key = np.empty(9 * scaled.shape[1], dtype=np.int64)
    index = np.empty(9 * scaled.shape[1], dtype=np.int64)
    count = 0
    for i in range(scaled.shape[1]):
        column, row = np.floor(scaled[0, i]), np.floor(scaled[1, i])
        x, y = scaled[0, i] - column, scaled[1, i] - row
        for right in range(-1, 2):
            if (right < 0 and x > reach) or (right > 0 and x < 1.0 - reach):
                continue
            for up in range(-1, 2):
                if (up < 0 and y > reach) or (up > 0 and y < 1.0 - reach):
                    continue
                key[count] = (int(column) + right - first[0]) * rows + int(row) + up - first[1]
                index[count] = i
                count += 1
    return key[:count], index[:count]


@njit(cache=True)
def _counted(key: Indices, cells: int) -> tuple[Indices, Indices, Indices]:
    """The stable order of the keys, those there are, and the bounds of each in the order."""
    start = np.zeros(cells + 1, dtype=np.int64)
    for k in key:
        start[k + 1] += 1
    there = np.flatnonzero(start[1:])
    start = np.cumsum(start)
    bounds = np.append(start[there], len(key))
    order = np.empty(len(key), dtype=np.int64)
    for i in range(len(key)):
        order[start[key[i]]] = i
        start[key[i]] += 1
    return order, there, bounds
