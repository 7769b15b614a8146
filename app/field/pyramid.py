"""Sliding-window bounds of a gridded field: the smallest and largest value in any square of 2^l cells.

A level answers for the square of side s whose first cell is (j, i), wherever that lies: one lookup whatever the
displacement of a block of poses. Sides are the powers of two and steps of a quarter between them, for poses that are
not displaced alike. Starts are kept every q = max(1, s / 4) cells, for squares that much larger, so that high levels
stay small enough for the processor's caches. Cells off the grid hold the prior. Variances are kept as one-byte codes
of a logarithmic ladder, rounded outwards, beside the bounds of the mean in the same record. All levels lie in one
array, so that a search may take each of its lookups from another level; a last record covers everything.
"""

from dataclasses import dataclass
from typing import TypeVar

import numba
import numpy as np
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["LADDER_STEPS", "Level", "Pyramid", "build_pyramid", "variance_ladder"]

LADDER_STEPS = 64
Float32 = NDArray[np.float32]
Codes = NDArray[np.uint8]
_Cells = TypeVar("_Cells", Float32, Codes)


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """Bounds over squares of `side` cells: that at (j, i) is in record [(j + base) // step, (i + base) // step].

    records   (h, w, width) float32: c lower then c upper bounds of the mean, uT, then, as two bytes, the ladder
              positions at or below and at or above every variance in the square, then nothing up to the width
    step      cells between records, a power of two; base = side + step. Indices beyond the array: the nearest record
    """

    side: int
    step: int
    records: Float32

    @property
    def base(self) -> int:
        return self.side + self.step


@dataclass(frozen=True, slots=True, eq=False)
class Pyramid:
    """levels by ascending side; ladder_uT2 (LADDER_STEPS,) ascends from the smallest variance.

    records   (k, width) of all levels, row by row, the smallest squares first, then one that covers all cells
    places    (levels + 1, 6) where a level's lie among them: base, log2 of its step, height, width, first record, side
    doubling  index of the level of side 2^l at l, from one; a search may start from blocks of the last
    """

    levels: tuple[Level, ...]
    ladder_uT2: Array
    records: Float32
    places: NDArray[np.int64]
    doubling: tuple[int, ...]

    @property
    def nbytes(self) -> int:
        return self.ladder_uT2.nbytes + self.records.nbytes + self.places.nbytes


def variance_ladder(variance_uT2: Array | Float32) -> Array:
    """(LADDER_STEPS,) logarithmic ladder from the smallest to the largest variance."""
    low, high = float(variance_uT2.min()), float(variance_uT2.max())
    ladder = low * (high / low) ** np.linspace(0.0, 1.0, LADDER_STEPS)
    ladder[-1] = high
    return np.asarray(ladder)


def build_pyramid(mean_uT: Float32, variance_uT2: Float32, levels: int) -> Pyramid:
    """Levels 1 to `levels` of a field (ny + 2, nx + 2, c) and its variance (ny + 2, nx + 2), which already carry one
    cell of prior on each side."""
    ladder = variance_ladder(variance_uT2)
    bounds, codes = np.concatenate([mean_uT, mean_uT], axis=2), _codes(variance_uT2.astype(np.float64), ladder)
    whole = np.concatenate([mean_uT.min(axis=(0, 1)), mean_uT.max(axis=(0, 1))])[None, None]
    extremes = np.array([codes[..., 0].min(), codes[..., 1].max()], dtype=np.uint8)[None, None]
    built = []
    below = 1
    for side, step in _squares(levels):
        bounds, codes = _widened(bounds, below, side), _widened(codes, below, side)
        built.append((side, step, _records(_thinned(bounds, side, step), _thinned(codes, side, step))))
        below = side
    return _gathered(built, _records(whole, extremes), ladder)


def _squares(levels: int) -> list[tuple[int, int]]:
    """Sides, from two to twice 2^levels, and steps."""
    squares = []
    for side in (1 << level for level in range(1, levels + 1)):
        step = max(1, side // 4)
        squares.append((side, step))
        if side == 4:
            squares.append((6, 2))
        if side > 4:
            squares += [(side * quarters // 4, step) for quarters in (5, 6, 7)]
    return [*squares, (2 << levels, max(1, (2 << levels) // 4))]


def _gathered(built: list[tuple[int, int, Float32]], whole: Float32, ladder: Array) -> Pyramid:
    """Levels, as (side, step, records), and the record of everything in one array."""
    places, first = [], 0
    for side, step, own in built:
        places.append((side + step, step.bit_length() - 1, own.shape[0], own.shape[1], first, side))
        first += own.shape[0] * own.shape[1]
    places.append((0, 0, 1, 1, first, 0))
    records = np.concatenate([own.reshape(-1, own.shape[2]) for own in (*(own for _, _, own in built), whole)])
    levels = tuple(
        Level(side, step, records[place[4] : place[4] + place[2] * place[3]].reshape(own.shape))
        for (side, step, own), place in zip(built, places, strict=False)
    )
    table = np.array(places, dtype=np.int64)
    sides = [side for side, _, _ in built]
    doubling = tuple(sides.index(1 << level) for level in range(1, (sides[-1] // 2).bit_length()))
    return Pyramid(levels, ladder, records, table, (0, *doubling))


def _records(bounds: Float32, codes: Codes) -> Float32:
    """Bounds and codes side by side; records of three components fill 32 bytes, which no cache line parts."""
    c = bounds.shape[2] // 2
    records = np.zeros((*bounds.shape[:2], 2 * c + 2 if c == 3 else 2 * c + 1), dtype=np.float32)
    records[..., : 2 * c] = bounds
    records.view(np.uint8)[..., 8 * c : 8 * c + 2] = codes
    return records


def _codes(variance: Array, ladder: Array) -> Codes:
    """(ny, nx, 2) ladder positions at or below, and at or above, each variance."""
    codes = np.zeros((*variance.shape, 2), dtype=np.uint8)
    if ladder[0] < ladder[-1]:
        codes[..., 0] = np.searchsorted(ladder, variance, side="right") - 1
        codes[..., 1] = np.searchsorted(ladder, variance, side="left")
    return codes


def _widened(below: _Cells, before: int, side: int) -> _Cells:
    """Every square of `side` cells, starts -side to n, from every square of side `before`, at least half of that."""
    more = side - before
    above = np.empty((below.shape[0] + more, below.shape[1] + more, below.shape[2]), dtype=below.dtype)
    _cover(below, above, 1, -more, more)
    return above


def _thinned(squares: _Cells, side: int, step: int) -> _Cells:
    """Squares of side + step - 1 cells, starts -(side + step) to n + step, every `step`."""
    ny, nx, width = squares.shape[0] - side - 1, squares.shape[1] - side - 1, squares.shape[2]
    rows, columns = ((n + side + 2 * step) // step + 1 for n in (ny, nx))
    thin = np.empty((rows, columns, width), dtype=squares.dtype)
    _cover(squares, thin, step, -step, step - 1)
    return thin


@numba.njit(cache=True, nogil=True)
def _cover(squares, target, step, first, apart):  # type: ignore[no-untyped-def]
    """target[j] = the union of the squares at step j + first and `apart` behind it, on both axes, indices clamped."""
    rows, columns, width = target.shape
    last_row, last_column = squares.shape[0] - 1, squares.shape[1] - 1
    c = width // 2
    for j in range(rows):
        j0 = min(max(step * j + first, 0), last_row)
        j1 = min(max(step * j + first + apart, 0), last_row)
        for i in range(columns):
            i0 = min(max(step * i + first, 0), last_column)
            i1 = min(max(step * i + first + apart, 0), last_column)
            for k in range(width):
                a, b = squares[j0, i0, k], squares[j0, i1, k]
                d, e = squares[j1, i0, k], squares[j1, i1, k]
                target[j, i, k] = min(min(a, b), min(d, e)) if k < c else max(max(a, b), max(d, e))
