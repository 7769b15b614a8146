"""Two layers of a map: how many surveys a cell was seen by, and how far those disagree beyond their stated uncertainty.

Each survey counts once wherever it was near: a thousand samples of one walk within a metre share their label error and
their offset, and are one error. So the conflict of a cell is the root mean square, over surveys, of each one's own
root-mean-square error against the map of the others, in predictive sds: 1 is what was stated, 2 is twice that.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from app.field.leave_one_out import HeldOut
from app.field.observations import Walk
from app.field.tiles import REACH_M
from app.geometry import Array

__all__ = ["quality_layers"]

FINEST_M = 0.25
"""On a finer grid, blocks of cells this large at most share one value."""

Layer = NDArray[np.float32]
Indices = NDArray[np.int64]


def quality_layers(
    x_m: Array, y_m: Array, heights_m: Array, walks: Sequence[Walk], held_out: Mapping[str, HeldOut]
) -> dict[str, Layer]:
    """ "coverage" and "conflict" (nz, ny, nx) on cells centred on evenly spaced x_m (nx,), y_m (ny,).

    coverage: surveys with an observation within REACH_M of the cell. conflict: NaN where fewer than two surveys can be
    judged within REACH_M. With several heights, an observation counts on those within REACH_M of its own.
    """
    errors = [_squared_error(walk, held_out[walk.survey_id]) for walk in walks]
    layers = []
    for height_m in heights_m:
        near = [
            np.full(len(walk), len(heights_m) == 1) | (np.abs(walk.position_m[:, 2] - height_m) <= REACH_M)
            for walk in walks
        ]
        points = [walk.position_m[mask, :2] for walk, mask in zip(walks, near, strict=True)]
        layers.append(_layer(x_m, y_m, points, [e[mask] for e, mask in zip(errors, near, strict=True)]))
    coverage, conflict = (np.stack(each).astype(np.float32) for each in zip(*layers, strict=True))
    return {"coverage": coverage, "conflict": conflict}


def _squared_error(walk: Walk, held_out: HeldOut) -> Array:
    """(n,) squared error of every observation in predictive variances, mean over components; NaN where not judged."""
    n, judged = len(walk), held_out.judged
    stretch = walk.stretch_of_sample[judged]
    counts = np.bincount(stretch, minlength=n)
    z = np.stack([np.bincount(stretch, column, n) for column in held_out.standardised.T], axis=1)
    with np.errstate(invalid="ignore"):
        return np.asarray(np.mean(np.square(z / counts[:, None]), axis=1))


def _layer(x_m: Array, y_m: Array, points: Sequence[Array], errors: Sequence[Array]) -> tuple[Array, Array]:
    """Coverage and conflict (ny, nx) of one height."""
    step_m = float(np.diff(x_m[:2] if len(x_m) > 1 else y_m[:2])[0]) if max(len(x_m), len(y_m)) > 1 else REACH_M
    merged = max(1, int(FINEST_M / step_m + 1e-9))
    first_m = np.array([x_m[0], y_m[0]]) + 0.5 * (merged - 1) * step_m
    shape = -(-len(y_m) // merged), -(-len(x_m) // merged)
    seen, judged, square = (np.zeros(shape[0] * shape[1]) for _ in range(3))
    for survey_points, error in zip(points, errors, strict=True):
        indices = np.rint((survey_points - first_m) / (merged * step_m)).astype(np.int64)
        known = np.isfinite(error)
        cells, _ = _spread(indices, np.ones(len(indices)), merged * step_m, shape)
        seen[cells] += 1.0
        cells, mean_square = _spread(indices[known], error[known], merged * step_m, shape)
        judged[cells] += 1.0
        square[cells] += mean_square
    conflict = np.sqrt(np.divide(square, judged, out=np.full_like(square, np.nan), where=judged >= 2.0))
    seen, conflict = (
        each.reshape(shape).repeat(merged, axis=0).repeat(merged, axis=1)[: len(y_m), : len(x_m)]
        for each in (seen, conflict)
    )
    return seen, conflict


def _spread(indices: Indices, values: Array, step_m: float, shape: tuple[int, int]) -> tuple[Indices, Array]:
    """Cells (flat) within REACH_M of a survey's observations, and the mean of `values` (n,) around each.

    indices (n, 2): column and row of every observation. Observations in one cell are averaged first.
    """
    if not len(indices):
        return np.zeros(0, np.int64), np.zeros(0)
    column, row = (indices - indices.min(axis=0)).T
    _, first, place = np.unique(row * (column.max() + 1) + column, return_index=True, return_inverse=True)
    mean = np.bincount(place, values) / np.bincount(place)
    reach = int(REACH_M / step_m + 1e-9)
    dx, dy = np.meshgrid(*[np.arange(-reach, reach + 1)] * 2)
    disc = np.hypot(dx, dy) * step_m <= REACH_M + 1e-9
    column, row = (np.add.outer(indices[first, axis], d[disc]) for axis, d in enumerate((dx, dy)))
    inside = (column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0])
    weight = np.broadcast_to(mean[:, None], inside.shape)[inside]
    cells, place = np.unique((row * shape[1] + column)[inside], return_inverse=True)
    return cells, np.bincount(place, weight) / np.bincount(place)
