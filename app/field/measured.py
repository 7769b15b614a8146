"""Which cells of a grid are measured: near enough to samples, and known clearly better than before the survey."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.spatial import cKDTree

from app.field.observations import Walk
from app.field.raster import GridFrame
from app.field.tiles import REACH_M
from app.geometry import Array

__all__ = ["MAX_SD_OF_PRIOR", "measured_cells", "near_other_walks"]

MAX_SD_OF_PRIOR = 0.9
"""A cell whose sd is above this share of the prior's has had less than a fifth of its variance explained."""


def measured_cells(
    frame: GridFrame, walks: Sequence[Walk], resolution_m: float, variance_ratio: Array
) -> NDArray[np.bool_]:
    """(ny, nx): within REACH_M of an observation, and latent sd at most MAX_SD_OF_PRIOR of the prior's."""
    position_m = np.concatenate([walk.position_m for walk in walks])
    empty = np.ones(frame.shape, dtype=np.bool_)
    column = np.rint((position_m[:, 0] - frame.x_m[0]) / resolution_m).astype(np.int64)
    row = np.rint((position_m[:, 1] - frame.y_m[0]) / resolution_m).astype(np.int64)
    empty[row, column] = False
    near = distance_transform_edt(empty, sampling=resolution_m) <= max(REACH_M, resolution_m)
    return np.asarray(near & (variance_ratio <= MAX_SD_OF_PRIOR**2))


def near_other_walks(walks: Sequence[Walk]) -> dict[str, NDArray[np.bool_]]:
    """Survey id -> (N,) samples within REACH_M of an observation of another survey."""
    trees = {walk.survey_id: cKDTree(walk.position_m[:, :2]) for walk in walks}
    boxes = {name: (tree.mins - REACH_M, tree.maxes + REACH_M) for name, tree in trees.items()}
    near: dict[str, NDArray[np.bool_]] = {}
    for walk in walks:
        points = walk.position_m[:, :2]
        close = np.zeros(len(points), dtype=np.bool_)
        for other in walks:
            low, high = boxes[other.survey_id]
            asked = np.flatnonzero(~close & np.all((points >= low) & (points <= high), axis=1))
            if other is not walk and len(asked):
                distance_m, _ = trees[other.survey_id].query(points[asked], distance_upper_bound=REACH_M)
                close[asked] = np.isfinite(distance_m)
        near[walk.survey_id] = close[walk.stretch_of_sample]
    return near
