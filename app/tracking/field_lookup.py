"""The field at particles: bilinear in the plane and linear between layers, compiled; `FieldGrid.at` is the plain twin.

Particles in cells nobody measured get the prior's mean and variance and are not `measured`, as there.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from app.field.grid import AT_HEIGHT_M, FieldGrid
from app.geometry import Array

__all__ = ["FieldTable", "Looked", "field_table", "look_up", "look_up_plain"]

Float32 = NDArray[np.float32]


class FieldTable(NamedTuple):
    """record (nz, ny, nx, 2 c): means (uT) and variances (uT^2); measured (nz, ny, nx); what the prior is (2 c,)."""

    record: Float32
    measured: NDArray[np.bool_]
    heights_m: Array
    outside: Array
    x0_m: float
    y0_m: float
    resolution_m: float


class Looked(NamedTuple):
    """Mean (n, c) uT, latent variance (n, c) uT^2 and measured (n,) at n particles."""

    mean_uT: Array
    variance_uT2: Array
    measured: NDArray[np.bool_]


def field_table(grid: FieldGrid) -> FieldTable:
    """What the compiled loop reads, interleaved: made once per map."""
    record = np.concatenate([grid.mean_uT, np.square(grid.sd_uT)], axis=3, dtype=np.float32)
    outside = np.concatenate([grid.ambient_uT, np.square(grid.prior_sd_uT)]).astype(np.float64)
    heights_m = np.ascontiguousarray(grid.heights_m, dtype=np.float64)
    x0, y0 = map(float, grid.origin_m)
    return FieldTable(record, grid.measured, heights_m, outside, x0, y0, float(grid.resolution_m))


def look_up(table: FieldTable, points_m: Array) -> Looked:
    """The field at points (n, 3) of the building frame, or (n, 2): at the lowest layer."""
    n, c = len(points_m), table.record.shape[3] // 2
    found, measured = np.empty((n, 2 * c)), np.empty(n, dtype=np.bool_)
    _look_up(np.ascontiguousarray(points_m, dtype=np.float64), table, found, measured)
    return Looked(found[:, :c], found[:, c:], measured)


def look_up_plain(grid: FieldGrid, points_m: Array) -> Looked:
    """The same, array by array."""
    values = grid.at(points_m)
    return Looked(values.mean_uT, np.square(values.sd_uT), values.measured)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _look_up(points, table, found, measured):  # type: ignore[no-untyped-def]
    _, ny, nx, columns = table.record.shape
    for k in range(len(points)):
        u = (points[k, 0] - table.x0_m) / table.resolution_m
        v = (points[k, 1] - table.y0_m) / table.resolution_m
        layer, fz, known = _layer(points, k, table.heights_m)
        known &= u >= 0.0 and u <= nx - 1 and v >= 0.0 and v <= ny - 1
        if not known:
            found[k] = table.outside
            measured[k] = False
            continue
        i, j = min(int(u), max(nx - 2, 0)), min(int(v), max(ny - 2, 0))
        found[k] = 0.0
        for corner in range(8 if fz > 0.0 else 4):
            di, dj, dk = corner & 1, (corner >> 1) & 1, corner >> 2
            share = (u - i if di else 1.0 - (u - i)) * (v - j if dj else 1.0 - (v - j)) * (fz if dk else 1.0 - fz)
            if share <= 0.0:
                continue
            known &= table.measured[layer + dk, j + dj, i + di]
            for m in range(columns):
                found[k, m] += share * table.record[layer + dk, j + dj, i + di, m]
        measured[k] = known


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _layer(points, k, heights):  # type: ignore[no-untyped-def]
    """The layer below a point, the share of the way to the next one, and whether the point is between layers."""
    last = len(heights) - 1
    if last == 0 or points.shape[1] < 3:
        return 0, 0.0, True
    z = points[k, 2]
    between = z >= heights[0] - AT_HEIGHT_M and z <= heights[last] + AT_HEIGHT_M
    layer = min(max(np.searchsorted(heights, z, side="right") - 1, 0), last - 1)
    share = (z - heights[layer]) / (heights[layer + 1] - heights[layer])
    return layer, min(max(share, 0.0), 1.0), between
