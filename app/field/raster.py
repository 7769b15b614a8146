"""The cells of a grid, and the blending of tiles into them."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.errors import InvalidInput
from app.field.hilbert import AxisFunctions, TilePosterior
from app.field.observations import Walk
from app.field.tiles import Lattice, Tile
from app.geometry import Array

__all__ = ["BlendedField", "GridFrame"]

MAX_CELLS = 20_000_000
MAX_MARGIN_M = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class GridFrame:
    """Centres of the columns (nx,) and rows (ny,) of a grid, on multiples of its resolution."""

    x_m: Array
    y_m: Array
    height_m: float

    @classmethod
    def around(cls, walks: Sequence[Walk], resolution_m: float, length_m: float, height_m: float | None) -> "GridFrame":
        """The walks' bounding box and one length scale around it, three metres at most.

        Raises InvalidInput when that has more than twenty million cells.
        """
        position_m = np.concatenate([walk.position_m for walk in walks])
        margin_m = min(length_m, MAX_MARGIN_M)
        low = np.floor((position_m[:, :2].min(axis=0) - margin_m) / resolution_m)
        high = np.ceil((position_m[:, :2].max(axis=0) + margin_m) / resolution_m)
        cells = np.prod(high - low + 1.0)
        if cells > MAX_CELLS:
            width, depth = (high - low) * resolution_m
            raise InvalidInput(
                f"a map of {width:.0f} x {depth:.0f} m at {resolution_m:g} m has {cells:.2g} cells, more than "
                f"{MAX_CELLS}: raise resolution_m, or check the positions of the surveys"
            )
        x_m, y_m = (resolution_m * np.arange(a, b + 1.0) for a, b in zip(low, high, strict=True))
        return cls(x_m, y_m, float(np.median(position_m[:, 2])) if height_m is None else height_m)

    @property
    def shape(self) -> tuple[int, int]:
        return len(self.y_m), len(self.x_m)


class BlendedField:
    """Tiles added one by one under the partition of unity; where no tile was added the prior remains.

    mean_uT (c, ny, nx) about the ambient field, gradient_uT_per_m (2, c, ny, nx) of the blended mean itself (weights
    vary too), variance_ratio (ny, nx) over the signal variance: the weighted mean of the tiles' variances, which is
    never below the variance of the weighted mean.
    """

    def __init__(self, lattice: Lattice, frame: GridFrame, components: int) -> None:
        self._lattice, self._frame = lattice, frame
        self._strips: dict[tuple[int, int], _Strip] = {}
        self.mean_uT = np.zeros((components, *frame.shape))
        self.gradient_uT_per_m = np.zeros((2, components, *frame.shape))
        self.variance_ratio = np.ones(frame.shape)

    def add(self, tile: Tile, fitted: TilePosterior) -> None:
        """Blend one tile in."""
        x, y = self._strip(0, tile), self._strip(1, tile)
        if not (len(x.weight) and len(y.weight)):
            return
        cells = (slice(None), y.cells, x.cells)
        wx, wy, dwx, dwy = x.weight, y.weight[:, None], x.weight_slope, y.weight_slope[:, None]
        values = fitted.on_lattice(x.functions, y.functions)
        self.mean_uT[cells] += wx * wy * values.mean_uT
        self.gradient_uT_per_m[0][cells] += wy * (wx * values.slope_x_uT_per_m + dwx * values.mean_uT)
        self.gradient_uT_per_m[1][cells] += wx * (wy * values.slope_y_uT_per_m + dwy * values.mean_uT)
        self.variance_ratio[cells[1:]] += wx * wy * (values.variance_ratio - 1.0)

    def _strip(self, axis: int, tile: Tile) -> "_Strip":
        """What the tiles of one column (axis 0) or row share."""
        key = (axis, tile[axis])
        if key not in self._strips:
            centres_m = self._frame.x_m if axis == 0 else self._frame.y_m
            self._strips[key] = _Strip.of(self._lattice, axis, tile, centres_m)
        return self._strips[key]


class _Strip(NamedTuple):
    """The columns (or rows) of cells that a column (or row) of tiles answers, with weights and functions there."""

    cells: slice
    weight: Array
    weight_slope: Array
    functions: AxisFunctions

    @classmethod
    def of(cls, lattice: Lattice, axis: int, tile: Tile, centres_m: Array) -> "_Strip":
        start, stop = lattice.answers_between(axis, tile)
        cells = slice(int(np.searchsorted(centres_m, start)), int(np.searchsorted(centres_m, stop, side="right")))
        inside_m = centres_m[cells]
        return cls(
            cells,
            lattice.weight(axis, tile, inside_m),
            lattice.weight_slope(axis, tile, inside_m),
            AxisFunctions.at(lattice.basis(tile), axis, inside_m),
        )
