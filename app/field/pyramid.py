"""Sliding-window bounds of a gridded field: the smallest and largest value in any square of 2^l cells.

Level l answers for the square of side s = 2^l whose first cell is (j, i), for every start from -s (wholly before the
grid) to n (wholly behind it): one lookup whatever the displacement of a block of poses. Cells off the grid hold the
prior. Variances are kept as one-byte codes of a logarithmic ladder, rounded outwards, so that they stay bounds.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["LADDER_STEPS", "Pyramid", "build_pyramid", "variance_ladder"]

LADDER_STEPS = 256
Float32 = NDArray[np.float32]
Codes = NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """Bounds of all levels, flat, level by level, rows of `height[l] x width[l]` starts.

    mean_bounds   (sum_l height width, 2 c) float32: c lower then c upper bounds of the mean, uT
    code_bounds   (same, 2 c) uint8: positions on `ladder_uT2` that enclose the variance
    ladder_uT2    (c, LADDER_STEPS) variances, ascending; the first is the smallest in the grid
    start, height, width   (levels,) int64
    """

    mean_bounds: Float32
    code_bounds: Codes
    ladder_uT2: Array
    start: NDArray[np.int64]
    height: NDArray[np.int64]
    width: NDArray[np.int64]

    @property
    def nbytes(self) -> int:
        return self.mean_bounds.nbytes + self.code_bounds.nbytes + self.ladder_uT2.nbytes


def variance_ladder(variance_uT2: Array | Float32) -> Array:
    """(c, LADDER_STEPS) logarithmic ladder from the smallest to the largest variance of each component."""
    flat = variance_uT2.reshape(-1, variance_uT2.shape[-1]).astype(np.float64)
    low, high = flat.min(axis=0), flat.max(axis=0)
    ladder = low[:, None] * (high / low)[:, None] ** np.linspace(0.0, 1.0, LADDER_STEPS)
    ladder[:, -1] = high
    return np.asarray(ladder)


def build_pyramid(mean_uT: Float32, variance_uT2: Float32, levels: int) -> Pyramid:
    """Levels 0 to `levels` of a field (ny + 2, nx + 2, c) that already carries one cell of prior on each side."""
    ladder = variance_ladder(variance_uT2)
    ny, nx, c = mean_uT.shape[0] - 2, mean_uT.shape[1] - 2, mean_uT.shape[2]
    sides = [1 << level for level in range(levels + 1)]
    height = np.array([ny + s + 1 for s in sides], dtype=np.int64)
    width = np.array([nx + s + 1 for s in sides], dtype=np.int64)
    start = np.concatenate([[0], np.cumsum(height * width)]).astype(np.int64)
    bounds = np.empty((start[-1], 2 * c), dtype=np.float32)
    codes = np.empty((start[-1], 2 * c), dtype=np.uint8)
    cells = mean_uT.reshape(-1, c)
    bounds[: start[1], :c], bounds[: start[1], c:] = cells, cells
    codes[: start[1]] = _codes(variance_uT2.reshape(-1, c).astype(np.float64), ladder)
    for level in range(1, levels + 1):
        lower, here = slice(start[level - 1], start[level]), slice(start[level], start[level + 1])
        shape = (int(height[level - 1]), int(width[level - 1]), 2 * c)
        new = (int(height[level]), int(width[level]), 2 * c)
        _double(bounds[lower].reshape(shape), bounds[here].reshape(new), sides[level])
        _double(codes[lower].reshape(shape), codes[here].reshape(new), sides[level])
    return Pyramid(bounds, codes, ladder, start[:-1], height, width)


def _codes(variance: Array, ladder: Array) -> Codes:
    """(cells, 2 c) ladder positions at or below, and at or above, each variance."""
    c = ladder.shape[0]
    codes = np.empty((len(variance), 2 * c), dtype=np.uint8)
    for k in range(c):
        below = np.searchsorted(ladder[k], variance[:, k], side="right") - 1
        above = np.searchsorted(ladder[k], variance[:, k], side="left")
        codes[:, k] = np.clip(below, 0, LADDER_STEPS - 1)
        codes[:, c + k] = np.clip(above, 0, LADDER_STEPS - 1)
    if np.any(ladder[:, 0] == ladder[:, -1]):
        codes[:, c:][:, ladder[:, 0] == ladder[:, -1]] = 0
        codes[:, :c][:, ladder[:, 0] == ladder[:, -1]] = 0
    return codes


@numba.njit(cache=True, nogil=True)
def _double(below, above, side):  # type: ignore[no-untyped-def]
    """Squares of `side` cells from four squares of half the side; starts are clamped where both lie off the grid."""
    half = side // 2
    rows, columns, width = above.shape
    last_row, last_column = below.shape[0] - 1, below.shape[1] - 1
    c = width // 2
    for j in range(rows):
        j0 = min(max(j - half, 0), last_row)
        j1 = min(j, last_row)
        for i in range(columns):
            i0 = min(max(i - half, 0), last_column)
            i1 = min(i, last_column)
            for k in range(width):
                a, b = below[j0, i0, k], below[j0, i1, k]
                d, e = below[j1, i0, k], below[j1, i1, k]
                above[j, i, k] = min(min(a, b), min(d, e)) if k < c else max(max(a, b), max(d, e))
