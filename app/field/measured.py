"""Which cells of a grid are measured: near enough to samples, and known clearly better than before the survey."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from app.field.estimate import FieldEstimate
from app.field.observations import Walk
from app.field.raster import GridFrame
from app.field.tiles import REACH_M
from app.geometry import Array

__all__ = ["MAX_SD_OF_PRIOR", "measured_cells", "near_other_walks"]

MAX_SD_OF_PRIOR = 0.9
"""A cell whose sd is above this share of the prior's has had less than a fifth of its variance explained."""


def measured_cells(
    frame: GridFrame, walks: Sequence[Walk], resolution_m: float, estimate: FieldEstimate
) -> NDArray[np.bool_]:
    """(nz, ny, nx): within REACH_M of an observation, and latent sd at most MAX_SD_OF_PRIOR of the prior's.

    Heights count where the field was fitted in three dimensions; else it is taken to be the same at all of them.
    """
    position_m = np.concatenate([walk.position_m for walk in walks])
    reach_m = max(REACH_M, resolution_m)
    near = [
        _near_columns(frame, position_m[layer], resolution_m, reach_m)
        for layer in _by_layer(frame, position_m[:, 2], estimate)
    ]
    known = estimate.variance_ratio.mean(axis=0) <= MAX_SD_OF_PRIOR**2
    return np.asarray(np.stack(near) & known)


def _by_layer(frame: GridFrame, z_m: Array, estimate: FieldEstimate) -> list[NDArray[np.bool_]]:
    """For every layer the observations (n,) that count for it."""
    if len(estimate.gradient_uT_per_m) == 2:
        return [np.ones(len(z_m), dtype=np.bool_)] * len(frame.heights_m)
    return [np.abs(z_m - height_m) <= REACH_M for height_m in frame.heights_m]


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
    """Survey id -> (N,) samples within REACH_M of an observation of another survey; heights count in a volume."""
    axes = 3 if volume else 2
    trees = {walk.survey_id: cKDTree(walk.position_m[:, :axes]) for walk in walks}
    boxes = {name: (tree.mins - REACH_M, tree.maxes + REACH_M) for name, tree in trees.items()}
    near: dict[str, NDArray[np.bool_]] = {}
    for walk in walks:
        points = walk.position_m[:, :axes]
        close = np.zeros(len(points), dtype=np.bool_)
        for other in walks:
            low, high = boxes[other.survey_id]
            asked = np.flatnonzero(~close & np.all((points >= low) & (points <= high), axis=1))
            if other is not walk and len(asked):
                distance_m, _ = trees[other.survey_id].query(points[asked], distance_upper_bound=REACH_M)
                close[asked] = np.isfinite(distance_m)
        near[walk.survey_id] = close[walk.stretch_of_sample]
    return near
