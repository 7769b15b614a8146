"""The cells of a grid, and the blending of tiles into them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import EllipsisType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.errors import InvalidInput
from app.field.blending import add_cells
from app.field.hilbert import Patch
from app.field.observations import Walk
from app.field.spec import MapSpec
from app.field.tiles import POTENTIAL_REACH_UP_M, REACH_M, Lattice, Tile
from app.geometry import Array

__all__ = [
    "Blended",
    "GridFrame",
    "blend",
    "layer_heights_m",
    "on_all_layers",
    "placed",
    "reach_up_m",
    "reachable",
    "tile_cells",
]

MAX_CELLS = 20_000_000
MAX_MARGIN_M = 3.0
TOUCHING_M = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class GridFrame:
    """Centres of the columns (nx,) and rows (ny,) of a grid, on multiples of its resolution, and its heights (nz,)."""

    x_m: Array
    y_m: Array
    heights_m: Array

    @classmethod
    def around(cls, walks: Sequence[Walk], resolution_m: float, length_m: float, heights_m: Array) -> "GridFrame":
        """The walks' bounding box and one length scale around it, three metres at most.

        Raises InvalidInput when that has more than twenty million cells.
        """
        across_m = [np.concatenate([walk.position_m[:, axis] for walk in walks]) for axis in (0, 1)]
        margin_m = min(length_m, MAX_MARGIN_M)
        low = np.floor((np.array([each.min() for each in across_m]) - margin_m) / resolution_m)
        high = np.ceil((np.array([each.max() for each in across_m]) + margin_m) / resolution_m)
        cells = np.prod(high - low + 1.0) * len(heights_m)
        if cells > MAX_CELLS:
            width, depth = (high - low) * resolution_m
            layers = f", {len(heights_m)} layers," if len(heights_m) > 1 else ""
            raise InvalidInput(
                f"a map of {width:.0f} x {depth:.0f} m{layers} at {resolution_m:g} m has {cells:.2g} cells, more than "
                f"{MAX_CELLS}: raise resolution_m, or check the positions of the surveys"
            )
        x_m, y_m = (resolution_m * np.arange(a, b + 1.0) for a, b in zip(low, high, strict=True))
        return cls(x_m, y_m, np.asarray(heights_m, dtype=np.float64))

    @property
    def shape(self) -> tuple[int, int, int]:
        return len(self.heights_m), len(self.y_m), len(self.x_m)


def layer_heights_m(walks: Sequence[Walk], spec: MapSpec) -> Array:
    """(nz,) the heights asked for, or the one median height of the observations.

    Raises InvalidInput when none of those asked for is within reach of an observation.
    """
    z_m = np.concatenate([walk.position_m[:, 2] for walk in walks])
    if spec.heights_m is None:
        return np.array([np.median(z_m)])
    asked_m = np.array(spec.heights_m, dtype=np.float64)
    if not reachable(asked_m, z_m, reach_up_m(spec)).any():
        raise InvalidInput(
            f"the surveys were taken between {z_m.min():.2f} and {z_m.max():.2f} m, and no layer of heights_m "
            f"({', '.join(f'{height_m:g}' for height_m in asked_m)} m) is within {reach_up_m(spec):g} m of them: ask "
            "for heights near the surveys', in the building's frame"
        )
    return asked_m


def reach_up_m(spec: MapSpec) -> float:
    """How far above and below the surveys a map is believed."""
    return POTENTIAL_REACH_UP_M if spec.curl_free else REACH_M


def reachable(layers_m: Array, z_m: Array, up_m: float) -> NDArray[np.bool_]:
    """(nz,) layers that are within REACH_M of an observed height, and not farther than up_m above or below all."""
    near = np.array([np.abs(z_m - height_m).min() <= REACH_M + TOUCHING_M for height_m in layers_m])
    past_m = np.maximum(z_m.min() - layers_m, layers_m - z_m.max())
    return np.asarray(near & (past_m <= up_m + TOUCHING_M))


def on_all_layers(values: Array, answered: NDArray[np.bool_], elsewhere: float) -> Array:
    """(..., nz, ny, nx) of values (..., answered, ny, nx), which are the same on all other layers."""
    if answered.all():
        return values
    everywhere = np.full((*values.shape[:-3], len(answered), *values.shape[-2:]), elsewhere)
    everywhere[..., answered, :, :] = values
    return everywhere


def tile_cells(lattice: Lattice, axis: int, tile: Tile, resolution_m: float) -> Array:
    """Centres (n,) of the columns (axis 0) or rows of cells that a tile answers, whatever the grid."""
    start, stop = lattice.answers_between(axis, tile)
    first, last = np.ceil(start / resolution_m - 1e-9), np.floor(stop / resolution_m + 1e-9)
    return np.asarray(resolution_m * np.arange(first, last + 1.0))


class Blended(NamedTuple):
    """mean_uT (c, nz, ny, nx) about the ambient field, gradient_uT_per_m (d, c, nz, ny, nx) of the blended mean itself

    (weights vary too), variance_ratio (v, nz, ny, nx) over the signal variance: the weighted mean of the tiles'
    variances, which is never below the variance of the weighted mean. Where no tile answers the prior remains.
    """

    mean_uT: Array
    gradient_uT_per_m: Array
    variance_ratio: Array


def blend(lattice: Lattice, frame: GridFrame, resolution_m: float, patches: Mapping[Tile, Patch]) -> Blended:
    """The tiles' fields under the partition of unity; `patches` must not be empty."""
    shape = next(iter(patches.values()))
    mean = np.zeros((len(shape.mean_uT), *frame.shape))
    gradient = np.zeros((*shape.gradient_uT_per_m.shape[:2], *frame.shape))
    variance = np.ones((len(shape.variance_ratio), *frame.shape))
    columns, rows = ({tile[axis]: tile for tile in patches} for axis in (0, 1))
    across = {i: _along(lattice, 0, tile, resolution_m, frame.x_m) for i, tile in columns.items()}
    up = {j: _along(lattice, 1, tile, resolution_m, frame.y_m) for j, tile in rows.items()}
    for (column, row), patch in patches.items():
        (y, own_y, along_y), (x, own_x, along_x) = up[row], across[column]
        first, skipped = (y.start, x.start), (own_y.start, own_x.start)
        add_cells(mean, gradient, variance, patch[:3], first, skipped, along_y, along_x)
    return Blended(mean, gradient, variance)


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Where a tile lies in a grid: its cells there, those of its own cells that are, and its weight (ny, nx) on them.

    slope: of the weight over x and over y. curvature: over xx, xy and yy.
    """

    cells: tuple[EllipsisType, slice, slice]
    own: tuple[EllipsisType, slice, slice]
    weight: Array
    slope: tuple[Array, Array]
    curvature: tuple[Array, Array, Array]

    def of(self, patch: Patch) -> Patch:
        """The part of the tile's patch that lies in the grid."""
        mean, gradient, variance, potential = patch
        inside = self.own
        return Patch(mean[inside], gradient[inside], variance[inside], None if potential is None else potential[inside])


def placed(lattice: Lattice, frame: GridFrame, resolution_m: float, tile: Tile) -> Placed:
    columns, own_columns, (wx, sx, cx) = _along(lattice, 0, tile, resolution_m, frame.x_m)
    rows, own_rows, along_y = _along(lattice, 1, tile, resolution_m, frame.y_m)
    wy, sy, cy = along_y[:, :, None]
    return Placed(
        (..., rows, columns),
        (..., own_rows, own_columns),
        wx * wy,
        (sx * wy, wx * sy),
        (cx * wy, sx * sy, wx * cy),
    )


def _along(
    lattice: Lattice, axis: int, tile: Tile, resolution_m: float, centres_m: Array
) -> tuple[slice, slice, Array]:
    """Along one axis: the tile's cells among the centres, which of its own they are, and the weights (3, n) there."""
    own_m = tile_cells(lattice, axis, tile, resolution_m)
    cells, own = _overlap(centres_m, own_m)
    return cells, own, lattice.weights(axis, tile, own_m[own])


def _overlap(centres_m: Array, own_m: Array) -> tuple[slice, slice]:
    """Which of the centres are among the tile's own, and which of its own they are; both are runs of the raster."""
    if not len(own_m):
        return slice(0, 0), slice(0, 0)
    first, last = np.searchsorted(centres_m, [own_m[0] - TOUCHING_M, own_m[-1] + TOUCHING_M]).tolist()
    if first >= last:
        return slice(0, 0), slice(0, 0)
    skipped = int(np.searchsorted(own_m, centres_m[first] - TOUCHING_M))
    return slice(first, last), slice(skipped, skipped + last - first)
