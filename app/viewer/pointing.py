"""What a pointer points at: a ray of the camera, the place on a floor it hits, and what is known there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from app.errors import IncompatibleFrames
from app.field.grid import FieldGrid
from app.geometry import Array, rotate_by_quaternion
from app.viewer.source import Walk

__all__ = [
    "SUPPORT_WITHIN_M", "Support", "camera_ray", "kept_upright", "plane_hit", "supporting_walks", "walk_residual_uT",
    "walk_residuals",
]  # fmt: skip

SUPPORT_WITHIN_M = 1.0
RESIDUAL_OVER_M = 1.0
_UPRIGHT = 1e-3  # radians off the vertical


@dataclass(frozen=True, slots=True)
class Support:
    """A survey near a place: how many of its (thinned) samples, the nearest, and their mean field less the map's, uT.

    residual_uT is None where the map has no value, or the survey has not the map's components.
    """

    survey_id: str
    name: str
    samples: int
    nearest_m: float
    residual_uT: tuple[float, ...] | None


def camera_ray(q_wxyz: Array, fov_rad: float, aspect: float, u: float, v: float) -> Array:
    """The direction (3,) of a point of the picture: u from the left, v from the top, both in [0, 1].

    q_wxyz turns the camera's axes (x right, y down, z ahead) into the world's; fov_rad is the vertical field of view.
    """
    half = np.tan(fov_rad / 2.0)
    ahead = np.array([(2.0 * u - 1.0) * half * aspect, (2.0 * v - 1.0) * half, 1.0])
    direction = rotate_by_quaternion(np.asarray(q_wxyz, dtype=np.float64), ahead)
    return np.asarray(direction / np.linalg.norm(direction))


def kept_upright(q_wxyz: Array, position_m: Array, look_at_m: Array) -> tuple[Array, Array]:
    """The camera's position and target, such that from these alone the picture has the same side up.

    One that looks straight down is moved back a little: otherwise any side could be up.
    """
    away_m = position_m - look_at_m
    distance_m = float(np.linalg.norm(away_m))
    if np.hypot(away_m[0], away_m[1]) > _UPRIGHT * distance_m:
        return position_m, look_at_m
    up = rotate_by_quaternion(np.asarray(q_wxyz, dtype=np.float64), np.array([0.0, -1.0, 0.0]))[:2]
    back_m = -_UPRIGHT * distance_m * up / max(float(np.linalg.norm(up)), 1e-12)
    return look_at_m + np.array([back_m[0], back_m[1], away_m[2]]), look_at_m


def plane_hit(position_m: Array, direction: Array, z_m: float) -> tuple[float, Array] | None:
    """Where a ray meets the horizontal plane at z_m: distance and point (3,); None where it never does."""
    if abs(direction[2]) < 1e-9:
        return None
    distance_m = float((z_m - position_m[2]) / direction[2])
    return (distance_m, position_m + distance_m * direction) if distance_m > 0.0 else None


def walk_residual_uT(grid: FieldGrid, walk: Walk) -> Array | None:
    """(n, c) what the walk measured less the map, uT; NaN where the map has no value.

    None when the walk cannot give the map's components.
    """
    try:
        measured_uT = walk.samples.features(grid.components)
    except IncompatibleFrames:
        return None
    there = grid.at(walk.p_building_m)
    return np.asarray(np.where(there.measured[:, None], measured_uT - there.mean_uT, np.nan))


def walk_residuals(grid: FieldGrid, walks: Sequence[Walk]) -> tuple[Array, ...]:
    """(n,) of each walk: length of the mean, over a metre walked, of what was measured less the map, uT.

    NaN where that is not known. The mean leaves out the sensor's noise, which says nothing of the map.
    """
    return tuple(_mean_over_a_metre_uT(grid, walk) for walk in walks)


def _mean_over_a_metre_uT(grid: FieldGrid, walk: Walk) -> Array:
    residual_uT = walk_residual_uT(grid, walk)
    if residual_uT is None:
        return np.full(len(walk.samples), np.nan)
    path_m = walk.samples.path_length_m()
    known = np.isfinite(residual_uT[:, :1])
    sums = np.cumsum(np.vstack([np.zeros(residual_uT.shape[1] + 1),
                                np.hstack([np.where(known, residual_uT, 0.0), known])]), axis=0)  # fmt: skip
    first = np.searchsorted(path_m, path_m - RESIDUAL_OVER_M / 2.0)
    last = np.searchsorted(path_m, path_m + RESIDUAL_OVER_M / 2.0, side="right")
    near = sums[last] - sums[first]
    mean_uT = near[:, :-1] / np.maximum(near[:, -1:], 1.0)
    return np.where(known[:, 0], np.linalg.norm(mean_uT, axis=1), np.nan)


def supporting_walks(
    grid: FieldGrid, walks: Sequence[Walk], point_m: Array, within_m: float = SUPPORT_WITHIN_M
) -> list[Support]:
    """The walks that came within `within_m` of a place in the plane, nearest first."""
    found = []
    for walk in walks:
        away_m = np.linalg.norm(walk.p_building_m[:, :2] - point_m[:2], axis=1)
        near = away_m <= within_m
        if near.any():
            mean = _mean_residual_uT(grid, walk, near)
            found.append(Support(walk.survey_id, walk.name, int(near.sum()), float(away_m.min()), mean))
    return sorted(found, key=lambda support: support.nearest_m)


def _mean_residual_uT(grid: FieldGrid, walk: Walk, near: Array) -> tuple[float, ...] | None:
    residual_uT = walk_residual_uT(grid, walk)
    if residual_uT is None or np.isnan(residual_uT[near]).all():
        return None
    return tuple(float(value) for value in np.nanmean(residual_uT[near], axis=0))
