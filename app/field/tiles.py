"""Overlapping tiles on an absolute lattice of the building frame, and the partition of unity that blends them.

Tile (i, j) of a lattice of pitch P has the core `[i P, (i + 1) P] x [j P, (j + 1) P]`, whatever the samples. It is
fitted from samples within a margin of its core and answers within a smaller overlap; weights fall smoothly from 1 to 0
across the overlap and sum to 1 everywhere. Tiles of a lattice with a slab reach from one height to another.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.errors import InvalidInput
from app.field.basis import CosineBasis
from app.field.blending import weights
from app.field.hyperparameters import Basis
from app.field.kernels import base_kernel
from app.field.membership import cell_members
from app.field.slab import SlabBasis
from app.field.spec import BaseKernel, Kernel
from app.geometry import Array

__all__ = [
    "FUNCTIONS_PER_AXIS",
    "MARGIN",
    "OVERLAP",
    "PITCHES_M",
    "POTENTIAL_REACH_UP_M",
    "REACH_M",
    "Heights",
    "Lattice",
    "Slab",
    "Tile",
]

PITCHES_M = (
    *(1.0, 1.12, 1.25, 1.4, 1.6, 1.8, 2.0, 2.24, 2.5, 2.8, 3.15, 3.55, 4.0, 4.5, 5.0, 5.6, 6.3, 7.1, 8.0, 9.0),
    *(10.0, 11.2, 12.5, 14.0, 16.0, 18.0, 20.0, 22.4, 25.0, 28.0, 31.5, 40.0, 63.0, 100.0),
)
PITCH_IN_LENGTHS: dict[BaseKernel, float] = {"squared_exponential": 4.5, "matern52": 2.0, "matern32": 1.1}
WIDE_PITCH_IN_LENGTHS: dict[BaseKernel, float] = {"squared_exponential": 4.5, "matern52": 2.4, "matern32": 1.8}
"""A rough kernel has detail finer than its length and wants functions packed closer than a smooth one. Small tiles
cost least; only wide ones can tell a long length, or a survey's offset in the tile, from a large field."""
MARGIN = 0.3
POTENTIAL_MARGIN = 0.5
"""A potential adds up what lies around: with sparse lanes a narrow margin costs a quarter of the accuracy."""
OVERLAP = 0.1
FUNCTIONS_PER_AXIS: dict[BaseKernel, int] = {"squared_exponential": 15, "matern52": 14, "matern32": 15}
WIDE_FUNCTIONS_PER_AXIS: dict[BaseKernel, int] = {"squared_exponential": 15, "matern52": 16, "matern32": 18}

BORDER_POINTS = 9

ROOM_M = 0.5
"""The heights of a slab are rounded outwards to this, so that the next survey fits in."""

AIR_BEYOND_M = 0.1
"""Above and below what was walked there is air as well, a hand's breadth of it."""

REACH_M = 1.0
"""Farther than a metre from any sample a map of a building is a guess: steel a metre away bends the field that fast."""


POTENTIAL_REACH_UP_M = 0.5
"""Above and below what was walked the field of a potential is continued, and errors grow much faster than sideways."""
MAX_FUNCTIONS = 3000
"""In a box: their matrices take 70 MB a survey, and a second to solve."""


class _SlabShape(NamedTuple):
    """In lengths of the kernel: pitch of the tiles, padding of their boxes sideways and up and down, cutoff."""

    pitch: float
    padding: float
    headroom: float
    cutoff: float


_SLABS: dict[BaseKernel, _SlabShape] = {
    "squared_exponential": _SlabShape(2.5, 0.0, 0.75, 4.5),
    "matern52": _SlabShape(2.0, 0.0, 0.75, 8.0),
    "matern32": _SlabShape(1.5, 0.0, 0.5, 10.0),
}
_POTENTIAL_SLABS: dict[BaseKernel, _SlabShape] = {
    "squared_exponential": _SlabShape(2.5, 1.0, 2.0, 4.5),
    "matern52": _SlabShape(1.5, 0.7, 1.2, 8.0),
    "matern32": _SlabShape(1.2, 0.7, 1.2, 8.0),
}


class Heights(NamedTuple):
    """Lowest and highest: of what was walked, and of what the functions must hold, layers included."""

    walked_m: tuple[float, float]
    held_m: tuple[float, float]


class Tile(NamedTuple):
    """Column and row of a tile; a lattice turns it into metres."""

    column: int
    row: int


@dataclass(frozen=True, slots=True)
class Slab:
    """The boxes of a lattice of slabs, for a field between the heights `inner_m`: `headroom_m` taller on either side,

    `padding_m` wider than their tile on every side. air_m: the heights of the surveys, and a little more.
    """

    air_m: tuple[float, float]
    inner_m: tuple[float, float]
    headroom_m: float
    padding_m: float
    cutoff_rad_per_m: float
    potential: bool


@dataclass(frozen=True, slots=True)
class Lattice:
    """The tiles of one pitch. Margin and overlap are fractions of the pitch on every side of a core."""

    pitch_m: float
    margin: float = MARGIN
    overlap: float = OVERLAP
    functions_per_axis: int = FUNCTIONS_PER_AXIS["matern32"]
    slab: Slab | None = None

    @classmethod
    def for_length(cls, kernel: Kernel, length_m: float, wide: bool = False) -> "Lattice":
        """The finest lattice whose tiles are wide enough for a kernel of this length."""
        pitch_in_lengths = WIDE_PITCH_IN_LENGTHS if wide else PITCH_IN_LENGTHS
        functions = WIDE_FUNCTIONS_PER_AXIS if wide else FUNCTIONS_PER_AXIS
        base = base_kernel(kernel)
        return cls(_pitch_m(pitch_in_lengths[base] * length_m), functions_per_axis=functions[base])

    @classmethod
    def of_slabs(
        cls,
        kernel: Kernel,
        length_m: float,
        walked_m: tuple[float, float],
        potential: bool,
        held_m: tuple[float, float] | None = None,
    ) -> "Lattice":
        """The same, of boxes for a field walked between two heights, and wanted between two others.

        Raises InvalidInput for boxes that are too tall.
        """
        shape = (_POTENTIAL_SLABS if potential else _SLABS)[base_kernel(kernel)]
        low_m, high_m = held_m or walked_m
        air_m = walked_m[0] - AIR_BEYOND_M, walked_m[1] + AIR_BEYOND_M
        inner_m = (float(np.floor(low_m / ROOM_M) * ROOM_M), float(np.ceil(high_m / ROOM_M) * ROOM_M))
        slab = Slab(
            air_m, inner_m, shape.headroom * length_m, shape.padding * length_m, shape.cutoff / length_m, potential
        )
        lattice = cls(_pitch_m(shape.pitch * length_m), margin=POTENTIAL_MARGIN if potential else MARGIN, slab=slab)
        _check_size(lattice.basis(Tile(0, 0)), walked_m)
        return lattice

    def basis(self, tile: Tile) -> Basis:
        """The functions a tile is fitted with, on its core and margin."""
        x, y = ((index - self.margin) * self.pitch_m for index in tile)
        side = (1.0 + 2.0 * self.margin) * self.pitch_m
        if self.slab is None:
            return CosineBasis((x, y), side, self.functions_per_axis)
        s = self.slab
        low_m, high_m = s.inner_m[0] - s.headroom_m, s.inner_m[1] + s.headroom_m
        corner = (x - s.padding_m, y - s.padding_m, low_m)
        return SlabBasis(corner, side + 2.0 * s.padding_m, high_m - low_m, s.cutoff_rad_per_m, s.potential, s.air_m)

    def fitting(self, points_m: Array) -> dict[Tile, NDArray[np.int64]]:
        """Tile -> indices, ascending, of the points (n, 2) or (n, 3) it is fitted from."""
        return self._members(points_m[:, :2], self.margin)

    def answering(self, points_m: Array) -> dict[Tile, NDArray[np.int64]]:
        """Tile -> indices, ascending, of the points (n, 2) or (n, 3) at which it has a weight."""
        return self._members(points_m[:, :2], self.overlap)

    def reached(self, points_m: Array) -> set[Tile]:
        """The tiles that answer anywhere within REACH_M of a point (n, 2 or 3); the others have no measured cell."""
        return set(self._members(points_m[:, :2], min(self.margin, self.overlap + REACH_M / self.pitch_m)))

    def answers_between(self, axis: int, tile: Tile) -> tuple[float, float]:
        """The interval of x (axis 0) or y (axis 1) over which a tile has a weight."""
        return (tile[axis] - self.overlap) * self.pitch_m, (tile[axis] + 1 + self.overlap) * self.pitch_m

    def weight(self, axis: int, tile: Tile, coordinate_m: Array) -> Array:
        """The tile's one-dimensional weight; a tile's weight at a point is the product over x and y."""
        return np.asarray(self.weights(axis, tile, coordinate_m)[0])

    def weights(self, axis: int, tile: Tile, coordinate_m: Array) -> Array:
        """(3, n) `weight` at coordinates (n,), and its first and second derivative over metres."""
        return np.asarray(weights(coordinate_m, *self.answers_between(axis, tile), self.ramp_m))

    @property
    def ramp_m(self) -> float:
        """Over which a weight rises."""
        return 2.0 * self.overlap * self.pitch_m

    def borders(self, tile: Tile, heights_m: Array) -> Array:
        """(4 n, 3) points along the left, right, lower and upper border of a core; tiles that share one share them."""
        i, j = np.array(tile) * self.pitch_m
        along = np.linspace(0.0, self.pitch_m, BORDER_POINTS)
        low, high = np.zeros(BORDER_POINTS), np.full(BORDER_POINTS, self.pitch_m)
        x = i + np.concatenate([low, high, along, along])
        y = j + np.concatenate([along, along, low, high])
        middle_m = 0.5 * (heights_m[0] + heights_m[-1])
        return np.column_stack([x, y, np.full(len(x), middle_m)])

    def _members(self, points_m: Array, reach: float) -> dict[Tile, NDArray[np.int64]]:
        cells, index, bounds = cell_members(points_m, self.pitch_m, reach)
        places = zip(cells.tolist(), pairwise(bounds), strict=True)
        return {Tile(*cell): index[start:stop] for cell, (start, stop) in places}


def _check_size(basis: Basis, walked_m: tuple[float, float]) -> None:
    assert isinstance(basis, SlabBasis)
    if basis.about_size > MAX_FUNCTIONS:
        raise InvalidInput(
            f"a map of surveys between {walked_m[0]:.1f} and {walked_m[1]:.1f} m would take {basis.about_size:.0f} "
            f"functions a tile, more than {MAX_FUNCTIONS}: build one map of each level, by survey_ids"
        )


def _pitch_m(least_m: float) -> float:
    return next((pitch for pitch in PITCHES_M if pitch >= least_m), PITCHES_M[-1])
