"""How well a window will be located, from the map alone: Fisher information and the Cramer-Rao bound it sets.

A window is a stretch of path whose last point p is asked for. Its readings tell of p, and of nuisances: the heading
theta of the whole stretch (a vector map also sees the readings turn) and a constant sensor offset b per component.
With the exact gradient J of the map's mean, a reading at q from p moves by `J (dp + q' dtheta + q eps) - t dtheta - b`,
q' and t being q and the mean field turned by +90 degrees. Heading, offset and the scale eps of the displacements are
eliminated by Schur complements, each under its Gaussian prior, as positioning estimates them. It is the predictive,
directional measure that (Kuevor B30) asks for and that its GLM, which needs the true position, is not.

Errors that stay alike along the path (the map's own, and what surveys showed of every other cause) are worth one
independent reading per DECORRELATED_SHARE of their correlation length: less than the covariance a window is matched
with, but one figure for a whole floor at once. White noise averages out.
"""

from dataclasses import dataclass

import numba
import numpy as np
from numpy.typing import NDArray

from app.field.grid import FieldGrid
from app.geometry import Array

__all__ = [
    "DECORRELATED_SHARE",
    "UNKNOWN_CORRELATION_M",
    "UNKNOWN_HEADING_SD_RAD",
    "WindowModel",
    "expected_error_m",
    "point_information",
    "window_covariance_m2",
]

UNKNOWN_HEADING_SD_RAD = float(np.pi / np.sqrt(3.0))  # uniform on the circle
DECORRELATED_SHARE = 0.12
UNKNOWN_CORRELATION_M = 2.0  # what errors of a map are taken to correlate over when a single survey cannot tell
LEAST_STEP_M = 0.5  # fields of buildings vary over metres: a finer walk over the map tells nothing new
LEAST_MEASURED_SHARE = 0.5
DIRECTIONS = 8
_LEAST_DENSITY_UT2_M = 1e-6


@dataclass(frozen=True, slots=True)
class WindowModel:
    """A window before anybody walked it, and the sensor.

    noise_uT           sd of white noise of one reading, per axis; one reading every `spacing_m` walked
    bias_sd_uT         sd of a constant offset per component: 0 calibrated, inf unknown (a demeaned window)
    heading_sd_rad     of the window's frame: 0 known, UNKNOWN_HEADING_SD_RAD unknown
    scale_sd           relative sd of the displacements' scale
    """

    length_m: float = 10.0
    noise_uT: float = 0.5
    spacing_m: float = 0.25
    bias_sd_uT: float = 0.0
    heading_sd_rad: float = UNKNOWN_HEADING_SD_RAD
    scale_sd: float = 0.05


def point_information(grid: FieldGrid, layer: int, noise_uT: float) -> Array:
    """(ny, nx) trace of `sum_c g_c g_c' / var_c`, 1/m2: what one reading tells, all else known (Kuevor B30)."""
    slope = grid.gradient_uT_per_m[layer, ..., :2].astype(np.float64)
    variance = np.maximum(_map_variance(grid.sd_uT[layer], grid) + noise_uT**2, _LEAST_DENSITY_UT2_M)
    return np.asarray(np.sum(np.square(slope).sum(axis=-1) / variance, axis=-1))


def window_covariance_m2(grid: FieldGrid, position_m: Array, window: WindowModel) -> Array:
    """(2, 2) covariance at best of the last of positions (n, 2 or 3) along a path; `length_m` is not used.

    Readings off the measured map count for nothing. Whoever asks knows at least that the device is on the map.
    """
    values = grid.at(position_m)
    from_last = position_m[:, :2] - position_m[-1, :2]
    steps_m = np.linalg.norm(np.diff(from_last, axis=0), axis=1) if len(from_last) > 1 else np.array([window.spacing_m])
    walked_m = 0.5 * (np.append(steps_m[0], steps_m) + np.append(steps_m, steps_m[-1]))[: len(from_last)]
    weight = _weight_per_m(values.sd_uT, grid, window) * (walked_m * values.measured)[:, None]
    slope, turn = values.gradient_uT_per_m[..., :2], _turn(values.mean_uT, grid)
    ahead = np.einsum("nca,na->nc", slope, from_last)
    across = np.einsum("nca,na->nc", slope, np.stack([-from_last[:, 1], from_last[:, 0]], axis=1)) - turn
    jacobian = np.concatenate([slope, across[..., None], ahead[..., None]], axis=-1)
    information = np.einsum("nc,nca,ncb->ab", weight, jacobian, jacobian)
    told = np.einsum("nc,nca->ca", weight, jacobian)
    known = weight.sum(axis=0) + _precision(window.bias_sd_uT)
    information -= np.einsum("ca,cb,c->ab", told, told, 1.0 / np.maximum(known, 1e-300))
    known_before = [*_extent_precision(grid), _precision(window.heading_sd_rad), _precision(window.scale_sd)]
    return np.asarray(np.linalg.inv(information + np.diag(known_before))[:2, :2])


def expected_error_m(grid: FieldGrid, layer: int, window: WindowModel) -> Array:
    """(ny, nx) rms horizontal error, m, of straight windows that end at a cell, over eight directions.

    A direction counts where at least half of its window is measured; NaN where none does. Cells finer than half a
    metre are taken together.
    """
    stride = max(1, round(LEAST_STEP_M / grid.resolution_m))
    step_m = stride * grid.resolution_m
    coarse = (slice(None, None, stride), slice(None, None, stride))
    mean, measured = grid.mean_uT[layer][coarse].astype(np.float64), grid.measured[layer][coarse]
    weight = _weight_per_m(grid.sd_uT[layer][coarse].astype(np.float64), grid, window) * step_m * measured[..., None]
    slope = np.ascontiguousarray(grid.gradient_uT_per_m[layer][coarse][..., :2], dtype=np.float64)
    behind_m = step_m * np.arange(int(window.length_m / step_m + 1e-9) + 1)
    angle = 2.0 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    from_last_m = -behind_m[None, :, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)[:, None]
    cells = np.rint(from_last_m[..., ::-1] / step_m).astype(np.int64)
    prior = np.array([*_extent_precision(grid), _precision(window.scale_sd), _precision(window.heading_sd_rad)])
    error = _expected_error(
        slope, _turn(mean, grid), weight, measured, cells, from_last_m, prior, _precision(window.bias_sd_uT)
    )
    ny, nx = grid.measured.shape[1:]
    whole = np.repeat(np.repeat(error, stride, axis=0), stride, axis=1)[:ny, :nx]
    return np.asarray(np.where(grid.measured[layer], whole, np.nan))


def _map_variance(sd_uT: Array | NDArray[np.float32], grid: FieldGrid) -> Array:
    return np.asarray(np.square(sd_uT, dtype=np.float64) + np.square(grid.noise_sd_uT))


def _weight_per_m(sd_uT: Array, grid: FieldGrid, window: WindowModel) -> Array:
    """Inverse variance per metre walked (..., c): correlated errors and white noise each at their own spacing."""
    correlation_m = grid.error_correlation_m if grid.error_correlation_m > 0.0 else UNKNOWN_CORRELATION_M
    spacing_m = max(window.spacing_m, DECORRELATED_SHARE * correlation_m)
    density = spacing_m * _map_variance(sd_uT, grid) + window.spacing_m * window.noise_uT**2
    return np.asarray(1.0 / np.maximum(density, _LEAST_DENSITY_UT2_M))


def _turn(mean_uT: Array, grid: FieldGrid) -> Array:
    """Derivative of readings (..., c) with the heading they are turned by: only vectors turn."""
    turn = np.zeros(mean_uT.shape)
    if grid.components == "vector":
        turn[..., 0], turn[..., 1] = -mean_uT[..., 1], mean_uT[..., 0]
    return turn


def _extent_precision(grid: FieldGrid) -> tuple[float, float]:
    """Precision of a position uniform over the map's extent, along x and y."""
    ny, nx = grid.measured.shape[1:]
    return 12.0 / (nx * grid.resolution_m) ** 2, 12.0 / (ny * grid.resolution_m) ** 2


def _precision(sd: float) -> float:
    return 1e12 if sd < 1e-6 else sd**-2


@numba.njit(cache=True, nogil=True)
def _expected_error(slope, turn, weight, measured, cells, from_last_m, prior, bias_precision):  # type: ignore[no-untyped-def]
    """(ny, nx) rms over directions, by the formulae of `window_covariance_m2`; columns: x, y, scale, heading."""
    ny, nx, c = turn.shape
    directions, n, _ = cells.shape
    error = np.full((ny, nx), np.nan)
    row, told, known = np.empty(4), np.empty((c, 4)), np.empty(c)
    information = np.empty((4, 4))
    for j in range(ny):
        for i in range(nx):
            if not measured[j, i]:
                continue
            total, judged = 0.0, 0
            for d in range(directions):
                information[:], told[:], known[:], seen = 0.0, 0.0, bias_precision, 0
                for k in range(n):
                    jj, ii = j + cells[d, k, 0], i + cells[d, k, 1]
                    if jj < 0 or ii < 0 or jj >= ny or ii >= nx or not measured[jj, ii]:
                        continue
                    seen += 1
                    x, y = from_last_m[d, k, 0], from_last_m[d, k, 1]
                    for m in range(c):
                        w, gx, gy = weight[jj, ii, m], slope[jj, ii, m, 0], slope[jj, ii, m, 1]
                        row[0], row[1], row[2], row[3] = gx, gy, gx * x + gy * y, gy * x - gx * y - turn[jj, ii, m]
                        known[m] += w
                        for a in range(4):
                            told[m, a] += w * row[a]
                            for b in range(a + 1):
                                information[a, b] += w * row[a] * row[b]
                if seen < LEAST_MEASURED_SHARE * n:
                    continue
                for a in range(4):
                    for b in range(a + 1):
                        for m in range(c):
                            information[a, b] -= told[m, a] * told[m, b] / max(known[m], 1e-300)
                    information[a, a] += prior[a]
                for last in (3, 2):  # eliminate the heading, then the scale
                    for a in range(last):
                        for b in range(a + 1):
                            information[a, b] -= information[last, a] * information[last, b] / information[last, last]
                xx, xy, yy = information[0, 0], information[1, 0], information[1, 1]
                total += (xx + yy) / (xx * yy - xy**2)
                judged += 1
            if judged:
                error[j, i] = np.sqrt(total / judged)
    return error
