"""Score poses of the lattice under the full covariance of a window's errors (see `window_error`)."""

import math

import numba
import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.positioning.floors import Plane
from app.positioning.lattice import ReducedWindow, Turned
from app.positioning.window_error import Fit, WindowError

__all__ = ["pose_residuals", "score_poses", "sensor_residual"]

Index = NDArray[np.int64]


def score_poses(
    plane: Plane, window: ReducedWindow, turned: Turned, poses: tuple[Index, Index, Index], error: WindowError
) -> Fit:
    """Log density of the window's features and its squared distance at poses (course, row, column), (k,) each.

    Cells off the map hold the prior.
    """
    course, row, column = poses
    log_l, distance2 = _score(
        course, row, column, turned.features_uT, turned.offset_cells, turned.turn, window.tilt, plane.mean_uT,
        plane.variance_uT2, window.noise_variance_uT2, error.whiten, error.own_share,
        -1.0 if error.offset_precision is None else error.offset_precision,
    )  # fmt: skip
    c = window.features_uT.shape[1]
    constant = -0.5 * c * (len(window) * math.log(2.0 * math.pi) + error.log_det)
    return Fit(log_l + constant, distance2)


def pose_residuals(
    plane: Plane, turned: Turned, poses: tuple[Index, Index, Index]
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Residuals z - m (k, n, c) in the building frame, the map's variances (k, n), and which samples are measured."""
    course, row, column = poses
    cells = np.stack([row, column], axis=1)[:, None] + turned.offset_cells[course]
    ny, nx = plane.shape
    a, b = np.clip(cells[..., 0] + 1, 0, ny + 1), np.clip(cells[..., 1] + 1, 0, nx + 1)
    inside = (a >= 1) & (a <= ny) & (b >= 1) & (b <= nx)
    measured = inside & plane.measured[np.clip(a - 1, 0, ny - 1), np.clip(b - 1, 0, nx - 1)]
    return turned.features_uT[course] - plane.mean_uT[a, b], plane.variance_uT2[a, b].astype(np.float64), measured


def sensor_residual(residual: Array, turn: Array, tilt: Array) -> Array:
    """Residuals (..., n, c) turned from the building frame to the sensor's axes: by yaw (..., n, 2), then by tilt."""
    if residual.shape[-1] != 3:
        return residual
    c, s = turn[..., 0], turn[..., 1]
    x, y, z = residual[..., 0], residual[..., 1], residual[..., 2]
    upright = np.stack([c * x + s * y, c * y - s * x, z], axis=-1)
    return np.einsum("nab,...nb->...na", tilt, upright) if len(tilt) else upright


@numba.njit(cache=True, nogil=True)
def _score(  # type: ignore[no-untyped-def]
    course, row, column, features, offsets, turn, tilt, mean, variance, noise, whiten, own_share, precision
):
    """Per pose: log density up to the constant, and squared distance; a negative precision means no offset."""
    ny, nx, c = mean.shape[0] - 2, mean.shape[1] - 2, mean.shape[2]
    n, rows = features.shape[1], whiten.shape[0]
    log_l, distance2 = np.empty(len(course)), np.empty(len(course))
    white, r, shared = np.empty((n, c + 1)), np.empty(c), np.empty(c)
    for p in range(len(course)):
        h = course[p]
        logs, squares, total = 0.0, 0.0, max(precision, 0.0)
        shared[:] = 0.0
        for k in range(n):
            a = min(max(row[p] + offsets[h, k, 0] + 1, 0), ny + 1)
            b = min(max(column[p] + offsets[h, k, 1] + 1, 0), nx + 1)
            v = own_share * variance[a, b] + noise[k]
            logs += math.log(v)
            root = 1.0 / math.sqrt(v)
            for m in range(c):
                r[m] = (features[h, k, m] - mean[a, b, m]) * root
            if c == 3:
                x = turn[h, k, 0] * r[0] + turn[h, k, 1] * r[1]
                y = turn[h, k, 0] * r[1] - turn[h, k, 1] * r[0]
                z = r[2]
                r[0], r[1] = x, y
                if len(tilt):
                    for m in range(3):
                        r[m] = tilt[k, m, 0] * x + tilt[k, m, 1] * y + tilt[k, m, 2] * z
            for m in range(c):
                white[k, m] = r[m]
            white[k, c] = root
        for i in range(rows):
            one = 0.0
            for k in range(n):
                one += whiten[i, k] * white[k, c]
            total += one * one
            for m in range(c):
                e = 0.0
                for k in range(n):
                    e += whiten[i, k] * white[k, m]
                squares += e * e
                shared[m] += one * e
        log_l[p] = -0.5 * c * logs
        if precision >= 0.0:
            for m in range(c):
                squares -= shared[m] * shared[m] / total
            squares = max(squares, 0.0)
            log_l[p] -= 0.5 * c * math.log(total / (precision if precision > 0.0 else 2.0 * math.pi))
        distance2[p] = squares
        log_l[p] -= 0.5 * squares
    return log_l, distance2
