"""A plane, a window and its errors made ready for the compiled loops of the search."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.positioning.floors import Plane
from app.positioning.kernels import Scene
from app.positioning.lattice import ReducedWindow
from app.positioning.pose_prior import PosePrior
from app.positioning.window_error import WindowError

__all__ = ["make_scene", "telling_order"]

_BETWEEN = 15.0  # cost of a pose between those of the lattice


def make_scene(
    plane: Plane,
    window: ReducedWindow,
    order: NDArray[np.int64],
    prior: PosePrior,
    error: WindowError,
    walkable: NDArray[np.bool_] | None,
) -> tuple[Scene, float]:
    """The scene, and the cost of a pose that matches."""
    n, c = window.features_uT.shape
    precision = error.offset_precision
    inflation = error.inflation * error.own_share
    noise = window.noise_variance_uT2[order] / error.own_share
    noises, kind = np.unique(noise, return_inverse=True)
    steps = plane.pyramid.ladder_uT2 + noises[:, None]
    ladder = np.stack([c * inflation * steps, 1.0 / (inflation * steps), c * np.log(steps / steps[:, :1])], axis=-1)
    least = float(plane.pyramid.ladder_uT2[0])
    cells, height = _prior_in_cells(plane, prior)
    floor = inflation * (least + noise)
    constant = c * float(np.log(2 * np.pi * floor).sum()) + height
    worth = n * c / error.inflation
    usual = constant + worth + 3.0 * math.sqrt(2.0 * worth) + _BETWEEN
    weight = float(np.sum(1.0 / floor)) + (precision or 0.0)
    lightest = float(np.sum(ladder[kind, -1, 1])) + (precision or 0.0)
    if precision is not None:  # one Gaussian factor per component is integrated out
        constant += c * math.log(weight / (precision or 2.0 * np.pi))
    turn = _turn(window)[order]
    scene = Scene(
        plane.mean_uT, plane.variance_uT2, plane.pyramid.records, plane.pyramid.records.view(np.uint8),
        plane.pyramid.places, np.array(plane.pyramid.doubling),
        np.zeros((0, 0), dtype=np.int64) if walkable is None else _summed(walkable), noise, kind,
        ladder, constant, inflation, least, cells, turn, bool(window.turns and len(window.tilt)),
        (precision is not None, precision or 0.0, weight, c * math.log(lightest / weight)),
    )  # fmt: skip
    return scene, usual


def telling_order(window: ReducedWindow, plane: Plane) -> NDArray[np.int64]:
    """The samples, the most telling first: unlike the ambient field, and far from those already taken."""
    strength, usual = window.features_uT, plane.ambient_uT
    if window.turns:
        strength = np.column_stack([np.hypot(strength[:, 0], strength[:, 1]), strength[:, 2]])
        usual = np.array([np.hypot(usual[0], usual[1]), usual[2]])
    unusual = np.linalg.norm(strength - usual, axis=1)
    order: NDArray[np.int64] = _telling(unusual / max(float(unusual.max()), 1e-9), window.from_last_m)
    return order


@numba.njit(cache=True, nogil=True)
def _telling(unusual, place):  # type: ignore[no-untyped-def]
    n = len(unusual)
    order, distance, taken = np.empty(n, dtype=np.int64), np.full(n, np.inf), np.zeros(n, dtype=np.bool_)
    order[0] = np.argmax(unusual)
    for k in range(1, n):
        latest = order[k - 1]
        taken[latest] = True
        most, merit = -1, -1.0
        for i in range(n):
            distance[i] = min(distance[i], math.hypot(place[i, 0] - place[latest, 0], place[i, 1] - place[latest, 1]))
            worth = min(distance[i], 4.0) / 4.0 + 0.5 * unusual[i]
            if not taken[i] and worth > merit:
                most, merit = i, worth
        order[k] = most
    return order


def _turn(window: ReducedWindow) -> Array:
    """(n, 3, 3) rotations of the frame's axes, or the building's, to the sensor's."""
    turn = np.zeros((len(window), 3, 3))
    turn[:, 2, 2] = 1.0
    c, s = np.cos(window.yaw_rad), np.sin(window.yaw_rad)
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1] = c, s, -s, c
    return np.ascontiguousarray(window.tilt @ turn) if len(window.tilt) else turn


def _summed(mask: NDArray[np.bool_]) -> NDArray[np.int64]:
    """(ny + 1, nx + 1) summed-area table."""
    table = np.zeros((mask.shape[0] + 1, mask.shape[1] + 1), dtype=np.int64)
    table[1:, 1:] = mask.cumsum(axis=0).cumsum(axis=1)
    return table


def _prior_in_cells(plane: Plane, prior: PosePrior) -> tuple[Array, float]:
    """(row, column, cost per squared cell) of the position prior on a plane and the cost of the plane's height."""
    if prior.position_m is None:
        return np.zeros(3), 0.0
    x, y, z = prior.position_m
    weight = 1.0 / prior.sd_m**2
    row, column = (y - plane.origin_m[1]) / plane.resolution_m, (x - plane.origin_m[0]) / plane.resolution_m
    height = weight * (z - plane.height_m) ** 2
    return np.array([row, column, weight * plane.resolution_m**2]), float(height)
