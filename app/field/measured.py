"""Which cells of a grid are measured: near enough to samples, and known clearly better than before the survey."""

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from app.field.estimate import FieldEstimate
from app.field.observations import Walk, walk_bounds
from app.field.raster import TOUCHING_M, GridFrame, reachable
from app.field.tiles import REACH_M
from app.geometry import Array

__all__ = ["MAX_SD_OF_PRIOR", "measured_cells", "near_observations", "near_other_walks"]

MOST_AT_ONE_PLACE = 25
"""Somebody who walks takes about ten at 50 Hz within the 20 cm of an observation."""
MAX_SD_OF_PRIOR = 0.9
"""A cell whose sd is above this share of the prior's has had less than a fifth of its variance explained."""


def measured_cells(
    frame: GridFrame, walks: Sequence[Walk], resolution_m: float, estimate: FieldEstimate
) -> NDArray[np.bool_]:
    """(nz, ny, nx): within REACH_M of an observation, and latent sd at most MAX_SD_OF_PRIOR of the prior's.

    A plane, whose field is the same at all heights, holds for layers within REACH_M of any observation. In three
    dimensions only what was observed as near above or below counts, or, of a potential, half as near or on both sides.
    """
    position_m = np.concatenate([walk.position_m for walk in walks])
    reach_m = max(REACH_M, resolution_m)

    def near(observed: NDArray[np.bool_]) -> NDArray[np.bool_]:
        return _near_columns(frame, position_m[observed], resolution_m, reach_m)

    z_m, up_m = position_m[:, 2], estimate.reach_up_m
    layers = np.zeros(frame.shape, dtype=np.bool_)
    for layer in np.flatnonzero(reachable(frame.heights_m, z_m, up_m)):
        above_m = z_m - frame.heights_m[layer]
        if len(estimate.gradient_uT_per_m) == 2:
            layers[layer] = near(np.ones(len(z_m), dtype=np.bool_))
            continue
        layers[layer] = near(np.abs(above_m) <= up_m + TOUCHING_M)
        if up_m < REACH_M:
            between = [near((side_m >= 0.0) & (side_m <= REACH_M + TOUCHING_M)) for side_m in (above_m, -above_m)]
            layers[layer] |= between[0] & between[1]
    known = estimate.variance_ratio.mean(axis=0) <= MAX_SD_OF_PRIOR**2
    return np.asarray(layers & known)


def _near_columns(frame: GridFrame, position_m: Array, resolution_m: float, reach_m: float) -> NDArray[np.bool_]:
    """(ny, nx): cells within reach of a position (n, 3), looked at from above."""
    empty = np.ones((len(frame.y_m), len(frame.x_m)), dtype=np.bool_)
    if not len(position_m):
        return ~empty
    column = np.rint((position_m[:, 0] - frame.x_m[0]) / resolution_m).astype(np.int64)
    row = np.rint((position_m[:, 1] - frame.y_m[0]) / resolution_m).astype(np.int64)
    empty[row, column] = False
    return np.asarray(distance_transform_edt(empty, sampling=resolution_m) <= reach_m)


def near_other_walks(walks: Sequence[Walk], volume: bool) -> dict[str, NDArray[np.bool_]]:
    """Survey id -> (N,) samples whose observation is near another survey, as `near_observations`.

    Of a long stand at one place the first MOST_AT_ONE_PLACE samples: more are the same error again.
    """
    near = near_observations(walks, volume)
    return {walk.survey_id: _of_samples(near[walk.survey_id], walk.stretch_of_sample) for walk in walks}


@njit(cache=True)
def _of_samples(near: NDArray[np.bool_], stretch_of_sample: NDArray[np.int64]) -> NDArray[np.bool_]:
    chosen, place, count = np.zeros(len(stretch_of_sample), dtype=np.bool_), -1, 0
    for i in range(len(stretch_of_sample)):
        if stretch_of_sample[i] != place:
            place, count = stretch_of_sample[i], 0
        count += 1
        chosen[i] = near[place] and count <= MOST_AT_ONE_PLACE
    return chosen


def near_observations(walks: Sequence[Walk], volume: bool) -> dict[str, NDArray[np.bool_]]:
    """Survey id -> (n,) observations within REACH_M of one of another survey; heights count in a volume."""
    position_m = np.concatenate([walk.position_m for walk in walks])
    if not volume:
        position_m = position_m * [1.0, 1.0, 0.0]
    survey = np.repeat(np.arange(len(walks)), [len(walk) for walk in walks])
    column, row = np.floor(position_m[:, :2].T / REACH_M).astype(np.int64)
    rows = int(np.ptp(row)) + 3
    key = (column - column.min() + 1) * rows + row - row.min() + 1
    order = np.argsort(key, kind="stable")
    close = np.empty(len(key), dtype=np.bool_)
    close[order] = _near_others(position_m.take(order, axis=0), survey[order], key[order], rows, REACH_M**2)
    parts = np.split(close, walk_bounds(walks)[1:-1])
    return {walk.survey_id: part for walk, part in zip(walks, parts, strict=True)}


@njit(cache=True)
def _near_others(
    position_m: Array, survey: NDArray[np.int64], key: NDArray[np.int64], rows: int, reach_m2: float
) -> NDArray[np.bool_]:
    """Points sorted by the key of their cell, one reach wide; looked for in the nine cells around."""
    near = np.zeros(len(key), dtype=np.bool_)
    for i in range(len(key)):
        for column in range(-1, 2):
            first = np.searchsorted(key, key[i] + column * rows - 1)
            last = np.searchsorted(key, key[i] + column * rows + 1, side="right")
            for j in range(first, last):
                if survey[j] != survey[i]:
                    squared = 0.0
                    for axis in range(3):
                        squared += (position_m[j, axis] - position_m[i, axis]) ** 2
                    if squared <= reach_m2:
                        near[i] = True
                        break
            if near[i]:
                break
    return near
