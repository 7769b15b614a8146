"""A map as a filter reads it: cells with a mean, a variance, and whether anything is known there.

Cell [j, i] is centred on `(x0 + i r, y0 + j r)`, as in `FieldGrid`. The components may be a vector, its norm, or what
else a sensor reads. Cells without data are masked, never zero: a ramp to zero is a contour of its own (Storms 1.4).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.field.grid import FieldGrid
from app.geometry import Array

__all__ = ["MapCells"]


@dataclass(frozen=True, slots=True, eq=False)
class MapCells:
    """mean_uT (ny, nx, c), variance_uT2 (ny, nx, c) of the map's own error, known (ny, nx)."""

    origin_m: tuple[float, float]
    resolution_m: float
    mean_uT: Array
    variance_uT2: Array
    known: NDArray[np.bool_]

    def __post_init__(self) -> None:
        assert self.mean_uT.shape == self.variance_uT2.shape, (self.mean_uT.shape, self.variance_uT2.shape)
        assert self.known.shape == self.mean_uT.shape[:2]

    @classmethod
    def of_grid(cls, grid: FieldGrid, layer: int = 0) -> "MapCells":
        """One layer of a served map."""
        variance_uT2 = np.square(grid.sd_uT[layer].astype(np.float64))
        mean_uT = grid.mean_uT[layer].astype(np.float64)
        return cls(grid.origin_m, grid.resolution_m, mean_uT, variance_uT2, grid.measured[layer])

    @property
    def x_m(self) -> Array:
        """(nx,) of the cell centres."""
        return np.asarray(self.origin_m[0] + self.resolution_m * np.arange(self.known.shape[1]))

    @property
    def y_m(self) -> Array:
        """(ny,) of the cell centres."""
        return np.asarray(self.origin_m[1] + self.resolution_m * np.arange(self.known.shape[0]))

    def norm(self) -> "MapCells":
        """The map of the magnitude: its variance is that of the component along the field."""
        norm_uT = np.linalg.norm(self.mean_uT, axis=2, keepdims=True)
        along = self.mean_uT / np.maximum(norm_uT, 1e-12)
        variance_uT2 = np.sum(np.square(along) * self.variance_uT2, axis=2, keepdims=True)
        return MapCells(self.origin_m, self.resolution_m, norm_uT, variance_uT2, self.known)

    def window(self, centre_m: Array, half_m: Array) -> "MapCells | None":
        """The cells within `half_m` (2,) of a place along x and y; None if there are none."""
        ny, nx = self.known.shape
        first, last = (
            (centre_m + sign * half_m - np.asarray(self.origin_m)) / self.resolution_m for sign in (-1.0, 1.0)
        )
        i0, j0 = np.maximum(np.ceil(first - 1e-9), 0).astype(np.int64)
        i1, j1 = np.minimum(np.floor(last + 1e-9), [nx - 1, ny - 1]).astype(np.int64) + 1
        if i0 >= i1 or j0 >= j1:
            return None
        origin_m = (self.origin_m[0] + int(i0) * self.resolution_m, self.origin_m[1] + int(j0) * self.resolution_m)
        part = np.s_[j0:j1, i0:i1]
        return MapCells(origin_m, self.resolution_m, self.mean_uT[part], self.variance_uT2[part], self.known[part])

    def resampled(self, centre_m: Array, half_m: Array, spacing_m: float) -> "MapCells":
        """A lattice of its own about a place, as far as `half_m` (2,), values bilinear: finer than the cells, say."""
        nx, ny = np.ceil(half_m / spacing_m).astype(np.int64)
        x, y = centre_m[0] + spacing_m * np.arange(-nx, nx + 1), centre_m[1] + spacing_m * np.arange(-ny, ny + 1)
        mean, variance = (self._bilinear(v, x, y[:, None]) for v in (self.mean_uT, self.variance_uT2))
        known = np.isfinite(mean[..., 0])
        return MapCells((float(x[0]), float(y[0])), spacing_m, mean, variance, known)

    def at(self, points_m: Array) -> Array:
        """Bilinear values (n, c) at points (n, 2), uT; NaN where one of the four cells around is unknown."""
        return self._bilinear(self.mean_uT, points_m[:, 0], points_m[:, 1])

    def _bilinear(self, values: Array, x_m: Array, y_m: Array) -> Array:
        """Values (..., c) of a layer (ny, nx, c) at coordinates that broadcast."""
        i, u, inside_x = _between(x_m, self.origin_m[0], self.resolution_m, self.known.shape[1])
        j, v, inside_y = _between(y_m, self.origin_m[1], self.resolution_m, self.known.shape[0])
        inside = inside_x & inside_y
        out = np.zeros((*inside.shape, values.shape[2]))
        for jj, wv in ((j, 1.0 - v), (j + 1, v)):
            for ii, wu in ((i, 1.0 - u), (i + 1, u)):
                row, column = np.minimum(jj, self.known.shape[0] - 1), np.minimum(ii, self.known.shape[1] - 1)
                weight = wv * wu
                used = weight != 0.0
                inside &= self.known[row, column] | ~used
                out += np.where(used[..., None], weight[..., None] * values[row, column], 0.0)
        out[~inside] = np.nan
        return out


def _between(
    at_m: Array, origin_m: float, resolution_m: float, count: int
) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """The cell centre below each coordinate, the fraction of the way to the next, and whether it is on the map."""
    place = np.round((at_m - origin_m) / resolution_m, 9)  # a centre is a centre, whatever its rounding
    below = np.clip(place.astype(np.int64), 0, max(count - 2, 0))
    return below, place - below, (place >= 0.0) & (place <= count - 1)
