"""The partition of unity of a lattice, in compiled loops: weights along an axis, and sums of tiles under them."""

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["add_at_points", "add_cells", "weights"]


@njit(cache=True)
def _step(t: float) -> tuple[float, float, float]:
    """From 0 to 1 with two continuous derivatives, and these; s(t) + s(1 - t) = 1."""
    t = min(max(t, 0.0), 1.0)
    square, rest = t * t, 1.0 - t
    return (
        square * t * (10.0 - 15.0 * t + 6.0 * square),
        30.0 * square * (rest * rest),
        60.0 * t * rest * (1.0 - 2.0 * t),
    )


@njit(cache=True)
def weights(coordinate_m: Array, start_m: float, stop_m: float, width_m: float) -> Array:
    """(3, n) the weight along one axis of a tile that answers from start to stop, and its first two derivatives."""
    values = np.empty((3, len(coordinate_m)))
    for i in range(len(coordinate_m)):
        low, low_slope, low_bend = _step((coordinate_m[i] - start_m) / width_m)
        high, high_slope, high_bend = _step((stop_m - coordinate_m[i]) / width_m)
        values[0, i] = low * high
        values[1, i] = (low_slope * high - low * high_slope) / width_m
        values[2, i] = (low_bend * high + low * high_bend - 2.0 * low_slope * high_slope) / width_m**2
    return values


@njit(cache=True)
def add_at_points(
    total: Array, part: Array, prior: float, points_m: Array, inside: NDArray[np.int64], corner_m: Array, width_m: float
) -> None:
    """Add to total (N, c), at the indices `inside`, a tile's weight times part (n, c) less the prior.

    corner_m (2, 2): from where to where the tile answers, by axis.
    """
    for i in range(len(inside)):
        place, weight = inside[i], 1.0
        for axis in range(2):
            at = points_m[place, axis]
            weight *= _step((at - corner_m[axis, 0]) / width_m)[0] * _step((corner_m[axis, 1] - at) / width_m)[0]
        for c in range(part.shape[1]):
            total[place, c] += weight * (part[i, c] - prior)


@njit(cache=True)
def add_cells(
    mean: Array,
    gradient: Array,
    variance: Array,
    own: tuple[Array, Array, Array],
    first: tuple[int, int],
    skipped: tuple[int, int],
    along_y: Array,
    along_x: Array,
) -> None:
    """Add a tile's mean (c, z, y, x), gradient (d, c, z, y, x) and variance (v, z, y, x) less one, under its weights.

    along_y (3, n), along_x (3, m): `weights` of the n rows and m columns that are added, from row and column `first` of
    the grid and `skipped` of the tile. The gradient is that of the weighted mean: weights vary too.
    """
    own_mean, own_gradient, own_variance = own
    components, heights = own_mean.shape[:2]
    for z in range(heights):
        for row in range(along_y.shape[1]):
            y, v = first[0] + row, skipped[0] + row
            for column in range(along_x.shape[1]):
                x, u = first[1] + column, skipped[1] + column
                weight = along_x[0, column] * along_y[0, row]
                for c in range(components):
                    value = own_mean[c, z, v, u]
                    mean[c, z, y, x] += weight * value
                    for axis in range(len(own_gradient)):
                        gradient[axis, c, z, y, x] += weight * own_gradient[axis, c, z, v, u]
                    gradient[0, c, z, y, x] += along_x[1, column] * along_y[0, row] * value
                    gradient[1, c, z, y, x] += along_x[0, column] * along_y[1, row] * value
                for k in range(len(own_variance)):
                    variance[k, z, y, x] += weight * (own_variance[k, z, v, u] - 1.0)
