"""Overlapping tiles on an absolute lattice of the building frame, and the partition of unity that blends them.

Tile (i, j) of a lattice of pitch P has the core `[i P, (i + 1) P] x [j P, (j + 1) P]`, whatever the samples. It is
fitted from samples within a margin of its core and answers within a smaller overlap; weights fall smoothly from 1 to 0
across the overlap and sum to 1 everywhere.
"""

from dataclasses import dataclass
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.field.basis import CosineBasis
from app.field.spec import Kernel
from app.geometry import Array

__all__ = ["FUNCTIONS_PER_AXIS", "MARGIN", "OVERLAP", "PITCHES_M", "REACH_M", "Lattice", "Tile"]

PITCHES_M = (1.0, 1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.3, 8.0, 10.0, 12.5, 16.0, 20.0, 25.0, 32.0, 40.0, 63.0, 100.0)
PITCH_IN_LENGTHS: dict[Kernel, float] = {"squared_exponential": 4.5, "matern52": 2.0, "matern32": 1.5}
WIDE_PITCH_IN_LENGTHS: dict[Kernel, float] = {"squared_exponential": 4.5, "matern52": 3.0, "matern32": 2.25}
"""A rough kernel has detail finer than its length and wants functions packed closer than a smooth one. Small tiles
cost least; only wide ones can tell a long length, or a survey's offset in the tile, from a large field."""
MARGIN = 0.3
OVERLAP = 0.1
FUNCTIONS_PER_AXIS: dict[Kernel, int] = {"squared_exponential": 15, "matern52": 14, "matern32": 15}
WIDE_FUNCTIONS_PER_AXIS: dict[Kernel, int] = {"squared_exponential": 15, "matern52": 20, "matern32": 23}

REACH_M = 1.0
"""Farther than a metre from any sample a map of a building is a guess: steel a metre away bends the field that fast."""


class Tile(NamedTuple):
    """Column and row of a tile; a lattice turns it into metres."""

    column: int
    row: int


@dataclass(frozen=True, slots=True)
class Lattice:
    """The tiles of one pitch. Margin and overlap are fractions of the pitch on every side of a core."""

    pitch_m: float
    margin: float = MARGIN
    overlap: float = OVERLAP
    functions_per_axis: int = FUNCTIONS_PER_AXIS["matern32"]

    @classmethod
    def for_length(cls, kernel: Kernel, length_m: float, wide: bool = False) -> "Lattice":
        """The finest lattice whose tiles are wide enough for a kernel of this length."""
        pitch_in_lengths = WIDE_PITCH_IN_LENGTHS if wide else PITCH_IN_LENGTHS
        functions = WIDE_FUNCTIONS_PER_AXIS if wide else FUNCTIONS_PER_AXIS
        least_m = pitch_in_lengths[kernel] * length_m
        pitch_m = next((pitch for pitch in PITCHES_M if pitch >= least_m), PITCHES_M[-1])
        return cls(pitch_m, functions_per_axis=functions[kernel])

    def basis(self, tile: Tile) -> CosineBasis:
        """The functions a tile is fitted with, on its core and margin."""
        corner = tuple((index - self.margin) * self.pitch_m for index in tile)
        side = (1.0 + 2.0 * self.margin) * self.pitch_m
        return CosineBasis((corner[0], corner[1]), side, self.functions_per_axis)

    def fitting(self, points_m: Array) -> dict[Tile, NDArray[np.int64]]:
        """Tile -> indices, ascending, of the points (n, 2) it is fitted from."""
        return self._members(points_m, self.margin)

    def answering(self, points_m: Array) -> dict[Tile, NDArray[np.int64]]:
        """Tile -> indices, ascending, of the points (n, 2) at which it has a weight."""
        return self._members(points_m, self.overlap)

    def reached(self, points_m: Array) -> set[Tile]:
        """The tiles that answer anywhere within REACH_M of a point (n, 2); the others have no measured cell."""
        return set(self._members(points_m, min(self.margin, self.overlap + REACH_M / self.pitch_m)))

    def answers_between(self, axis: int, tile: Tile) -> tuple[float, float]:
        """The interval of x (axis 0) or y (axis 1) over which a tile has a weight."""
        return (tile[axis] - self.overlap) * self.pitch_m, (tile[axis] + 1 + self.overlap) * self.pitch_m

    def weight(self, axis: int, tile: Tile, coordinate_m: Array) -> Array:
        """The tile's one-dimensional weight; a tile's weight at a point is the product over x and y."""
        low, high = self._ramps(axis, tile, coordinate_m)
        return np.asarray(_smooth_step(low) * _smooth_step(high))

    def weight_slope(self, axis: int, tile: Tile, coordinate_m: Array) -> Array:
        """Derivative of `weight`, per metre."""
        low, high = self._ramps(axis, tile, coordinate_m)
        width = 2.0 * self.overlap * self.pitch_m
        rise = _smooth_step_slope(low) * _smooth_step(high) - _smooth_step(low) * _smooth_step_slope(high)
        return np.asarray(rise / width)

    def _ramps(self, axis: int, tile: Tile, coordinate_m: Array) -> tuple[Array, Array]:
        start, stop = self.answers_between(axis, tile)
        width = 2.0 * self.overlap * self.pitch_m
        return np.clip((coordinate_m - start) / width, 0.0, 1.0), np.clip((stop - coordinate_m) / width, 0.0, 1.0)

    def _members(self, points_m: Array, reach: float) -> dict[Tile, NDArray[np.int64]]:
        scaled = points_m / self.pitch_m
        home = np.floor(scaled).astype(np.int64)
        past = scaled - home
        inside = {-1: past <= reach, 0: np.ones(past.shape, dtype=np.bool_), 1: past >= 1.0 - reach}
        tiles, indices = [], []
        for right, up in product(inside, inside):
            near = np.flatnonzero(inside[right][:, 0] & inside[up][:, 1])
            tiles.append(home[near] + (right, up))
            indices.append(near)
        tile, index = np.concatenate(tiles), np.concatenate(indices)
        order = np.lexsort((index, tile[:, 1], tile[:, 0]))
        tile, index = tile[order], index[order]
        starts = np.flatnonzero(np.any(tile[1:] != tile[:-1], axis=1)) + 1
        cuts = [0, *starts.tolist(), len(order)] if len(order) else []
        return {Tile(*tile[start].tolist()): index[start:stop] for start, stop in pairwise(cuts)}


def _smooth_step(t: Array) -> Array:
    """0 to 1 with two continuous derivatives; s(t) + s(1 - t) = 1."""
    return np.asarray(t**3 * (10.0 - 15.0 * t + 6.0 * t**2))


def _smooth_step_slope(t: Array) -> Array:
    return np.asarray(30.0 * t**2 * (1.0 - t) ** 2)
