"""Two layers of a map: how many surveys a cell was seen by, and how far those disagree beyond their stated uncertainty.

Each survey counts once wherever it was near: a thousand samples of one walk within a metre share their label error and
their offset, and are one error. So the conflict of a cell is the root mean square, over surveys, of each one's own
root-mean-square error against the map of the others, in predictive sds: 1 is what was stated, 2 is twice that.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.field.leave_one_out import HeldOut
from app.field.observations import Walk
from app.field.tally import means_of_places
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
    """(n,) mean squared error of the samples of every observation in predictive variances; NaN where not judged."""
    z, stretch = held_out.standardised, walk.stretch_of_sample[held_out.judged]
    squared, _ = means_of_places(np.square(z), stretch, np.ones(len(z), dtype=np.bool_), len(walk))
    return np.asarray(np.mean(squared, axis=1))


def _layer(x_m: Array, y_m: Array, points: Sequence[Array], errors: Sequence[Array]) -> tuple[Array, Array]:
    """Coverage and conflict (ny, nx) of one height."""
    step_m = float(np.diff(x_m[:2] if len(x_m) > 1 else y_m[:2])[0]) if max(len(x_m), len(y_m)) > 1 else REACH_M
    merged = max(1, int(FINEST_M / step_m + 1e-9))
    first_m = np.array([x_m[0], y_m[0]]) + 0.5 * (merged - 1) * step_m
    shape = -(-len(y_m) // merged), -(-len(x_m) // merged)
    seen, judged, square = np.zeros((3, *shape))
    for survey_points, error in zip(points, errors, strict=True):
        indices = np.rint((survey_points - first_m) / (merged * step_m)).astype(np.int64)
        if len(indices):
            box, near, known, mean_square = _spread(indices, error, merged * step_m, shape)
            seen[box] += near
            judged[box] += known
            square[box] += np.where(known, mean_square, 0.0)
    conflict = np.sqrt(np.divide(square, judged, out=np.full_like(square, np.nan), where=judged >= 2.0))
    seen, conflict = (
        each.repeat(merged, axis=0).repeat(merged, axis=1)[: len(y_m), : len(x_m)] for each in (seen, conflict)
    )
    return seen, conflict


def _spread(
    indices: Indices, error: Array, step_m: float, shape: tuple[int, int]
) -> tuple[tuple[slice, slice], NDArray[np.bool_], NDArray[np.bool_], Array]:
    """A survey's part of the grid: where it is (rows, columns), the cells within REACH_M of its observations, those
    within REACH_M of a judged one, and the mean squared error around each.

    indices (n, 2): column and row of every observation; error (n,): NaN where not judged.
    """
    reach = int(REACH_M / step_m + 1e-9)
    dx, dy = np.meshgrid(*[np.arange(-reach, reach + 1)] * 2)
    disc = np.hypot(dx, dy) * step_m <= REACH_M + 1e-9
    along = np.ascontiguousarray(indices.T)  # extremes along rows are quick
    low, high = along.min(axis=1) - reach, along.max(axis=1) + reach
    wide, tall = (high - low + 1).tolist()
    near, weight, total = _around(indices - low, error, disc, tall, wide)
    (x0, y0), (x1, y1) = np.maximum(low, 0), np.minimum(high + 1, shape[::-1])
    part = slice(y0 - low[1], y1 - low[1]), slice(x0 - low[0], x1 - low[0])
    weight = weight[part]
    box = slice(int(y0), int(y1)), slice(int(x0), int(x1))
    return box, near[part] > 0, weight > 0, total[part] / np.maximum(weight, 1)


@njit(cache=True)
def _around(
    indices: Indices, error: Array, disc: NDArray[np.bool_], tall: int, wide: int
) -> tuple[Indices, Indices, Array]:
    """(tall, wide) of every cell, over the cells around it: how many are observed, how many judged, the sum of errors.

    Of every observed cell its mean error counts; disc (2 r + 1, 2 r + 1): what is around.
    """
    seen, known, mean = np.zeros((tall, wide)), np.zeros((tall, wide)), np.zeros((tall, wide))
    for i in range(len(indices)):
        x, y = indices[i]
        seen[y, x] = 1.0
        if np.isfinite(error[i]):
            known[y, x] += 1.0
            mean[y, x] += error[i]
    near, weight = np.zeros((tall, wide), dtype=np.int64), np.zeros((tall, wide), dtype=np.int64)
    total, reach = np.zeros((tall, wide)), len(disc) // 2
    for y in range(reach, tall - reach):
        for x in range(reach, wide - reach):
            if seen[y, x] == 0.0:
                continue
            for dy in range(-reach, reach + 1):
                for dx in range(-reach, reach + 1):
                    if disc[dy + reach, dx + reach]:
                        near[y + dy, x + dx] += 1
                        if known[y, x] > 0.0:
                            weight[y + dy, x + dx] += 1
                            total[y + dy, x + dx] += mean[y, x] / known[y, x]
    return near, weight, total
