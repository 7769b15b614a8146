"""The nearest point on the measured contour: where a map holds the norm just measured (Cuenca 1.11).

A place found otherwise is moved to the nearest cell whose norm agrees with the last reading. The cells that agree form
a contour of the map; the tolerance says how wide it is.
"""

from typing import NamedTuple

import numpy as np

from app.geometry import Array

__all__ = ["ContourPoint", "contour_tolerance_uT", "nearest_on_contour"]


class ContourPoint(NamedTuple):
    """A cell of the map and its distance from where the search began, in cells."""

    row: int
    column: int
    distance_cells: float


def contour_tolerance_uT(norm_uT: Array, resolution_m: float, sigma_uT: float) -> Array:
    """Half of the norm's change across a cell, at least one sensor sigma, (ny, nx): wider where the map is steep.

    `norm_uT` (ny, nx) is NaN where nothing was measured. The gradient is central, one-sided beside a gap, and taken as
    zero where there is no neighbour; gradients are per metre and multiplied by the cell again (Cuenca, L1028).
    """
    slope_uT_per_m = np.hypot(*(_slope(norm_uT, axis) / resolution_m for axis in (0, 1)))
    return np.maximum(sigma_uT, 0.5 * slope_uT_per_m * resolution_m)


def nearest_on_contour(
    norm_uT: Array, start: tuple[float, float], measured_uT: float, tolerance_uT: Array | float, reach_cells: float
) -> ContourPoint | None:
    """The cell nearest to `start` (row, column) whose norm is within the tolerance of the reading (Cuenca, L660).

    `norm_uT` (ny, nx), NaN where unmeasured; `tolerance_uT` of the same shape, or one number. Only cells at most
    `reach_cells` away are looked at; None when none of them agrees. Of equally near cells the first in row order.
    """
    ny, nx = norm_uT.shape
    row0, row1 = _window(start[0], reach_cells, ny)
    column0, column1 = _window(start[1], reach_cells, nx)
    part = norm_uT[row0:row1, column0:column1]
    tolerance = np.broadcast_to(tolerance_uT, norm_uT.shape)[row0:row1, column0:column1]
    rows, columns = np.nonzero(np.abs(part - measured_uT) <= tolerance)  # a comparison with NaN is false
    distance = np.hypot(rows + row0 - start[0], columns + column0 - start[1])
    if not len(distance) or distance.min() > reach_cells:
        return None
    nearest = int(np.argmin(distance))
    return ContourPoint(int(rows[nearest]) + row0, int(columns[nearest]) + column0, float(distance[nearest]))


def _window(centre: float, reach: float, cells: int) -> tuple[int, int]:
    """The cells [first, stop) of an axis within reach of a place on it."""
    return max(0, int(np.ceil(centre - reach))), max(0, min(cells, int(np.floor(centre + reach)) + 1))


def _slope(values: Array, axis: int) -> Array:
    """Change per cell along an axis: the mean of the differences to the neighbours that are known, else zero."""
    forward = np.diff(values, axis=axis)
    pad = np.full_like(np.take(values, [0], axis=axis), np.nan)
    sides = np.stack([np.concatenate([pad, forward], axis=axis), np.concatenate([forward, pad], axis=axis)])
    known = np.isfinite(sides)
    return np.asarray(np.where(known, sides, 0.0).sum(axis=0) / np.maximum(known.sum(axis=0), 1))
