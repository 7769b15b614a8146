"""From a cell to a point: Gauss-Newton on the interpolated field, for several poses at once.

A pose is (x, y, heading, scale, drift): metres, radians, true over told displacement less one, radians per metre; the
heading is the frame's half-way along the path. The objective is the log density of the window under the full covariance
of its errors, the sensor's offset integrated out, plus the log prior; the field, its variance and its gradient are
taken bilinearly from the grid. A step is kept only where it improves the objective.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.positioning.features import field_jacobian, reduce_field, reduce_variance
from app.positioning.floors import Plane, SearchableFloor
from app.positioning.lattice import ReducedWindow, bent_m
from app.positioning.scoring import sensor_residual
from app.positioning.window_error import WindowError

__all__ = ["PoseGaussian", "Refined", "refine_poses"]

_STEPS = 12
_FIRST_STEPS, _HOPEFUL_NATS = 2, 20.0  # after a few steps only poses that may still be among the best go on
_STILL_M = 1e-3
POSE = 5


@dataclass(frozen=True, slots=True)
class PoseGaussian:
    """Gaussian prior on a pose: mean (5,), precision (5,), a zero where nothing is known.

    `free` (5,) says which of the five are unknown at all: a building window's heading is not.
    """

    mean: Array
    precision: Array
    free: Array


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Refined poses.

    pose            (m, 5)
    log_l           (m,) log density of the window there
    objective       (m,) log_l + log prior, up to the prior's constant
    distance2       (m,) squared Mahalanobis distance of the residuals
    covariance      (m, 5, 5) of the posterior about it; zero for what is not free
    residual_uT, variance_uT2   (m, n, c), (m, n) there: scaled features less the map's, in the building frame
    bias_uT         (m, c) of the sensor, in its axes, scaled; zero if there is none
    """

    pose: Array
    log_l: Array
    objective: Array
    distance2: Array
    covariance: Array
    residual_uT: Array
    variance_uT2: Array
    bias_uT: Array

    def only(self, k: int) -> "Refined":
        """One of the poses."""
        return Refined(*(getattr(self, name)[k : k + 1] for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    log_l: Array
    objective: Array
    distance2: Array
    gradient: Array  # (m, 5) of the objective
    information: Array  # (m, 5, 5) of the objective
    residual: Array
    variance: Array
    bias: Array

    def take(self, chosen: NDArray[np.int64] | NDArray[np.bool_]) -> "_Linearised":
        return _Linearised(*(getattr(self, name)[chosen] for name in self.__slots__))

    def put(self, chosen: NDArray[np.int64], values: "_Linearised") -> None:
        for name in self.__slots__:
            getattr(self, name)[chosen] = getattr(values, name)


def refine_poses(
    floor: SearchableFloor, plane: Plane, window: ReducedWindow, pose: Array, prior: PoseGaussian, error: WindowError
) -> Refined:
    """Refine poses (m, 5) on one plane by damped Gauss-Newton, each for itself, in twelve steps at most.

    Those far worse than the best after a few steps go no further.

    Positions stay on the plane's grid: outside it nothing was searched.
    """
    pose = pose.astype(np.float64).copy()
    low = np.array(plane.origin_m)
    high = low + plane.resolution_m * (np.array(plane.shape[::-1]) - 1)
    here = _linearise(floor, plane, window, pose, prior, error)
    damping, moving = np.full(len(pose), 1e-3), np.arange(len(pose))
    for step in range(_STEPS):
        now = here.take(moving)
        trial = pose[moving] + _damped_step(now, prior, damping[moving], plane.resolution_m)
        trial[:, :2] = np.clip(trial[:, :2], low, high)
        there = _linearise(floor, plane, window, trial, prior, error)
        better = there.objective > now.objective
        moved = np.linalg.norm(trial[:, :2] - pose[moving, :2], axis=1)
        chosen = moving[better]
        pose[chosen] = trial[better]
        here.put(chosen, there.take(better))
        damping[moving] *= np.where(better, 0.2, 8.0)
        hopeful = here.objective[moving] > here.objective.max() - (_HOPEFUL_NATS if step >= _FIRST_STEPS else np.inf)
        moving = moving[(moved > _STILL_M) & hopeful]
        if not len(moving):
            break
    covariance = _covariance(here.information, prior)
    return Refined(
        pose, here.log_l, here.objective, here.distance2, covariance, here.residual, here.variance, here.bias
    )


def _linearise(
    floor: SearchableFloor, plane: Plane, window: ReducedWindow, pose: Array, prior: PoseGaussian, error: WindowError
) -> _Linearised:
    residual, variance, jacobian, turn = _residuals(floor, plane, window, pose)
    v = error.own_share * variance + window.noise_variance_uT2
    root = 1.0 / np.sqrt(v)
    in_sensor = sensor_residual(residual, turn, window.tilt)
    columns = np.moveaxis(sensor_residual(np.moveaxis(jacobian, -1, 0), turn, window.tilt), 0, -1)
    white = np.einsum("kn,mnc->mkc", error.whiten, in_sensor * root[..., None])
    slope = np.einsum("kn,mncp->mkcp", error.whiten, columns * root[..., None, None])
    c = residual.shape[-1]
    distance2 = np.sum(np.square(white), axis=(1, 2))
    log_l = -0.5 * c * (np.sum(np.log(2.0 * np.pi * v), axis=1) + error.log_det)
    gradient = np.einsum("mkc,mkcp->mp", white, slope)
    information = np.einsum("mkcp,mkcq->mpq", slope, slope)
    bias = np.zeros((len(pose), c))
    if error.offset_precision is not None:
        one = root @ error.whiten.T
        total = np.sum(np.square(one), axis=1) + error.offset_precision
        shared, shared_slope = np.einsum("mk,mkc->mc", one, white), np.einsum("mk,mkcp->mcp", one, slope)
        bias = shared / total[:, None]
        distance2 = np.maximum(distance2 - np.sum(shared * bias, axis=1), 0.0)
        gradient = gradient - np.einsum("mc,mcp->mp", bias, shared_slope)
        information = information - np.einsum("mcp,mcq->mpq", shared_slope, shared_slope) / total[:, None, None]
        log_l = log_l - 0.5 * c * np.log(total / (error.offset_precision or 2.0 * np.pi))
    log_l = log_l - 0.5 * distance2
    off = pose - prior.mean
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    gradient = gradient - prior.precision * off
    information = information + np.diag(prior.precision)
    objective = log_l - 0.5 * np.sum(prior.precision * off**2, axis=1)
    return _Linearised(log_l, objective, distance2, gradient, information, residual, variance, bias)


def _residuals(
    floor: SearchableFloor, plane: Plane, window: ReducedWindow, pose: Array
) -> tuple[Array, Array, Array, Array]:
    """Scaled residuals z - m (m, n, c), variances (m, n), minus the residuals' derivative with the pose (m, n, c, 5),
    and cosine and sine of the sensor's yaw (m, n, 2)."""
    grid, source, target = floor.grid, floor.grid.components, window.components
    along = window.path_m - 0.5 * (window.path_m[0] + window.path_m[-1])
    told, sideways = bent_m(window, pose[:, 4])
    yaw = pose[:, 2, None] + pose[:, 4, None] * along
    c, s = np.cos(pose[:, 2])[:, None], np.sin(pose[:, 2])[:, None]
    told_x, told_y = c * told[..., 0] - s * told[..., 1], s * told[..., 0] + c * told[..., 1]
    bent_x, bent_y = c * sideways[:, 0] - s * sideways[:, 1], s * sideways[:, 0] + c * sideways[:, 1]
    stretch = 1.0 + pose[:, 3, None]
    east, north = stretch * told_x, stretch * told_y
    x, y = pose[:, :1] + east, pose[:, 1:2] + north
    values = grid.at(np.stack([x.ravel(), y.ravel(), np.full(x.size, plane.height_m)], axis=1))
    total = values.sd_uT**2 + floor.noise_sd_uT**2
    variance = np.mean(np.square(plane.scale) * reduce_variance(values.mean_uT, total, source, target), axis=-1)
    variance = np.maximum(variance, 1e-6).reshape(x.shape)
    slope = field_jacobian(values.mean_uT, source, target) @ values.gradient_uT_per_m[..., :2]
    slope = (plane.scale[:, None] * slope).reshape(*x.shape, len(plane.scale), 2)
    z = np.broadcast_to(window.features_uT, slope.shape[:-1]).copy()
    turned = np.zeros_like(z)
    turn = np.stack([np.ones_like(yaw), np.zeros_like(yaw)], axis=-1)
    if window.components == "vector":
        sensor = window.yaw_rad + (pose[:, 2, None] if window.turns else 0.0)
        turn = np.broadcast_to(np.stack([np.cos(sensor), np.sin(sensor)], axis=-1), turn.shape)
    if window.turns:
        cy, sy = np.cos(yaw), np.sin(yaw)
        bx, by = window.features_uT[:, 0], window.features_uT[:, 1]
        z[..., 0], z[..., 1] = cy * bx - sy * by, sy * bx + cy * by
        turned[..., 0], turned[..., 1] = -z[..., 1], z[..., 0]
    heading = -slope[..., 0] * north[..., None] + slope[..., 1] * east[..., None] - turned
    scale = slope[..., 0] * told_x[..., None] + slope[..., 1] * told_y[..., None]
    drift = slope[..., 0] * (stretch * bent_x)[..., None] + slope[..., 1] * (stretch * bent_y)[..., None]
    drift = drift - turned * along[:, None]
    mean = (plane.scale * reduce_field(values.mean_uT, source, target)).reshape(z.shape)
    jacobian = np.concatenate([slope, np.stack([heading, scale, drift], axis=-1)], axis=-1)
    return z - mean, variance, jacobian, turn


def _damped_step(here: _Linearised, prior: PoseGaussian, damping: Array, reach_m: float) -> Array:
    """Levenberg-Marquardt steps (m, 5), at most two cells in the plane; zero in what is not free."""
    free = prior.free
    matrix = here.information * np.outer(free, free)
    diagonal = np.einsum("mii->mi", matrix)
    held = np.where(diagonal > 0.0, 0.0, 1.0)
    matrix = matrix + np.einsum("mi,ij->mij", damping[:, None] * diagonal + held, np.eye(POSE))
    step = np.linalg.solve(matrix, (here.gradient * free)[..., None])[..., 0]
    length = np.linalg.norm(step[:, :2], axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, 2.0 * reach_m / np.maximum(length, 1e-12)))


def _covariance(information: Array, prior: PoseGaussian) -> Array:
    """Inverse of the free part; what the window does not tell gets a kilometre or a turn, not infinity."""
    free = prior.free.astype(bool)
    weakest = np.array([1e-6, 1e-6, 0.1, 1e-6, 1e-6])[free]
    part = information[:, free][:, :, free] + np.diag(weakest)
    covariance = np.zeros_like(information)
    covariance[np.ix_(np.arange(len(information)), np.flatnonzero(free), np.flatnonzero(free))] = np.linalg.inv(part)
    return covariance
