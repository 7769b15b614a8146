"""From a cell to a point: Gauss-Newton on the interpolated field, for several poses at once.

A pose is (x, y, heading) of the last sample, metres and radians. The objective is log L + temper * log prior with the
field, its variance and its gradient taken bilinearly from the grid; a step is kept only where it improves that.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.positioning.features import field_jacobian, reduce_field, reduce_variance
from app.positioning.floors import Plane, SearchableFloor
from app.positioning.lattice import ReducedWindow
from app.positioning.likelihood import window_likelihood

__all__ = ["PoseGaussian", "Refined", "refine_poses"]

_STEPS = 8


@dataclass(frozen=True, slots=True)
class PoseGaussian:
    """Gaussian prior on (x, y, heading): mean (3,), precision (3,), a zero where nothing is known.

    `free` (3,) says which of the three are unknown at all: a building window's heading is not.
    """

    mean: Array
    precision: Array
    free: Array


@dataclass(frozen=True, slots=True, eq=False)
class Refined:
    """Refined poses.

    pose            (m, 3) x, y, heading
    log_l           (m,) log-likelihood of the window there
    objective       (m,) log_l + temper * log prior
    distance2       (m,) squared Mahalanobis distance of the residuals
    covariance      (m, 3, 3) of the tempered posterior about it; zero for what is not free
    """

    pose: Array
    log_l: Array
    objective: Array
    distance2: Array
    covariance: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Linearised:
    log_l: Array
    objective: Array
    distance2: Array
    gradient: Array  # (m, 3) of the objective
    information: Array  # (m, 3, 3) of the objective


def refine_poses(
    floor: SearchableFloor,
    plane: Plane,
    window: ReducedWindow,
    pose: Array,
    prior: PoseGaussian,
    temper: float,
    demeaned: bool,
) -> Refined:
    """Refine poses (m, 3) on one plane by damped Gauss-Newton, each for itself, in eight steps at most.

    Positions stay on the plane's grid: outside it nothing was searched.
    """
    pose = pose.astype(np.float64).copy()
    low = np.array(plane.origin_m)
    high = low + plane.resolution_m * (np.array(plane.shape[::-1]) - 1)
    here = _linearise(floor, plane, window, pose, prior, temper, demeaned)
    damping = np.full(len(pose), 1e-3)
    for _ in range(_STEPS):
        trial = pose + _damped_step(here, prior, damping, plane.resolution_m)
        trial[:, :2] = np.clip(trial[:, :2], low, high)
        step = trial - pose
        there = _linearise(floor, plane, window, trial, prior, temper, demeaned)
        better = there.objective > here.objective
        pose[better] = trial[better]
        here = _choose(better, there, here)
        damping = np.where(better, damping * 0.2, damping * 8.0)
        if np.all(np.abs(step[:, :2]) < 1e-3):
            break
    covariance = _covariance(here.information / temper, prior)
    return Refined(pose, here.log_l, here.objective, here.distance2, covariance)


def _linearise(
    floor: SearchableFloor,
    plane: Plane,
    window: ReducedWindow,
    pose: Array,
    prior: PoseGaussian,
    temper: float,
    demeaned: bool,
) -> _Linearised:
    residual, variance, jacobian = _residuals(floor, plane, window, pose)
    weight = 1.0 / variance
    fit = window_likelihood(residual, variance, demeaned)
    if demeaned:
        shares = (weight / weight.sum(axis=1, keepdims=True))[..., None]
        jacobian = jacobian - np.sum(shares * jacobian, axis=1, keepdims=True)
    off = pose - prior.mean
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    gradient = np.einsum("mnc,mnc,mncp->mp", weight, fit.residual, jacobian) - temper * prior.precision * off
    information = np.einsum("mnc,mncp,mncq->mpq", weight, jacobian, jacobian) + temper * np.diag(prior.precision)
    objective = fit.log_l - 0.5 * temper * np.sum(prior.precision * off**2, axis=1)
    return _Linearised(fit.log_l, objective, fit.distance2, gradient, information)


def _residuals(floor: SearchableFloor, plane: Plane, window: ReducedWindow, pose: Array) -> tuple[Array, Array, Array]:
    """Residuals z - m and variances (m, n, c), and minus the residuals' derivative with the pose (m, n, c, 3)."""
    grid, source, target = floor.grid, floor.grid.components, window.components
    c, s = np.cos(pose[:, 2])[:, None], np.sin(pose[:, 2])[:, None]
    dx, dy = window.from_last_m.T
    east, north = c * dx - s * dy, s * dx + c * dy
    x, y = pose[:, :1] + east, pose[:, 1:2] + north
    values = grid.at(np.stack([x.ravel(), y.ravel(), np.full(x.size, plane.height_m)], axis=1))
    shape = (*x.shape, -1)
    total = values.sd_uT**2 + floor.noise_sd_uT**2
    variance = reduce_variance(values.mean_uT, total, source, target).reshape(shape)
    variance = np.maximum(variance, 1e-6) + window.noise_variance_uT2[:, None]
    slope = field_jacobian(values.mean_uT, source, target) @ values.gradient_uT_per_m[..., :2]
    slope = slope.reshape(*variance.shape, 2)
    z = np.broadcast_to(window.features_uT, variance.shape).copy()
    turn = np.zeros(variance.shape)
    if window.turns:
        bx, by = window.features_uT[:, 0], window.features_uT[:, 1]
        z[..., 0], z[..., 1] = c * bx - s * by, s * bx + c * by
        turn[..., 0], turn[..., 1] = -z[..., 1], z[..., 0]
    heading = -slope[..., 0] * north[..., None] + slope[..., 1] * east[..., None] - turn
    mean = reduce_field(values.mean_uT, source, target).reshape(variance.shape)
    return z - mean, variance, np.concatenate([slope, heading[..., None]], axis=-1)


def _damped_step(here: _Linearised, prior: PoseGaussian, damping: Array, reach_m: float) -> Array:
    """Levenberg-Marquardt steps (m, 3), at most `reach_m` in the plane; zero in what is not free."""
    free = prior.free
    matrix = here.information * np.outer(free, free)
    diagonal = np.einsum("mii->mi", matrix)
    held = np.where(diagonal > 0.0, 0.0, 1.0)
    matrix = matrix + np.einsum("mi,ij->mij", damping[:, None] * diagonal + held, np.eye(3))
    step = np.linalg.solve(matrix, (here.gradient * free)[..., None])[..., 0]
    length = np.linalg.norm(step[:, :2], axis=1, keepdims=True)
    return np.asarray(step * np.minimum(1.0, 2.0 * reach_m / np.maximum(length, 1e-12)))


def _choose(better: NDArray[np.bool_], there: _Linearised, here: _Linearised) -> _Linearised:
    return _Linearised(
        log_l=np.where(better, there.log_l, here.log_l),
        objective=np.where(better, there.objective, here.objective),
        distance2=np.where(better, there.distance2, here.distance2),
        gradient=np.where(better[:, None], there.gradient, here.gradient),
        information=np.where(better[:, None, None], there.information, here.information),
    )


def _covariance(information: Array, prior: PoseGaussian) -> Array:
    """Inverse of the free part; what the window does not tell gets a kilometre or a turn, not infinity."""
    free = prior.free.astype(bool)
    weakest = np.array([1e-6, 1e-6, 0.1])[free]
    part = information[:, free][:, :, free] + np.diag(weakest)
    covariance = np.zeros_like(information)
    covariance[np.ix_(np.arange(len(information)), np.flatnonzero(free), np.flatnonzero(free))] = np.linalg.inv(part)
    return covariance
