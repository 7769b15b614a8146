"""Where a map tells places apart: gradient norms, the best and the worst point, and Kuevor's GLM along a walk."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.field.grid import FieldGrid
from app.geometry import Array

__all__ = [
    "GLM_STEP_M", "Extreme", "GlmSeries", "GradientNorms", "at_two_hertz", "best_and_worst_points", "glm",
    "glm_average", "glm_ratio_of_means", "glm_series", "gradient_norms",
]  # fmt: skip

GLM_STEP_M = 0.05
GLM_WINDOW = 5
_GLM_RATE_HZ = 2.0


class GradientNorms(NamedTuple):
    """uT/m, each (...): |dm/dx|, |dm/dy|, |dm/dz| (None where the map does not know it), and ||J||_F over those known.

    Of a level or norm map, m is (horizontal, vertical) or the magnitude: what a window is compared with there.
    """

    x: Array
    y: Array
    z: Array | None
    total: Array


class Extreme(NamedTuple):
    """A cell centre (3,) and the total gradient along the floor there."""

    position_m: Array
    gradient_uT_per_m: float


class GlmSeries(NamedTuple):
    """Per sample (n,): signal and noise, uT, and their ratio over the last five samples (NaN for the first four)."""

    signal_uT: Array
    noise_uT: Array
    glm: Array


def gradient_norms(gradient_uT_per_m: Array | NDArray[np.float32]) -> GradientNorms:
    """Norms of the columns of gradients (..., c, 2 or 3), exact where they are (Kuevor B25, eq. 4.4-4.5)."""
    columns = np.linalg.norm(gradient_uT_per_m.astype(np.float64), axis=-2)
    z = columns[..., 2] if columns.shape[-1] > 2 else None
    return GradientNorms(columns[..., 0], columns[..., 1], z, np.asarray(np.linalg.norm(columns, axis=-1)))


def best_and_worst_points(grid: FieldGrid, layer: int) -> tuple[Extreme, Extreme] | None:
    """r*_max and r*_min of a layer: measured cells of largest and smallest total gradient along the floor (Kuevor B26).

    None where nothing is measured.
    """
    total, measured = gradient_norms(grid.gradient_uT_per_m[layer, ..., :2]).total, grid.measured[layer]
    if not measured.any():
        return None
    best, worst = np.argmax(np.where(measured, total, -np.inf)), np.argmin(np.where(measured, total, np.inf))
    return _extreme(grid, layer, total, int(best)), _extreme(grid, layer, total, int(worst))


def glm(
    gradient_uT_per_m: Array, error_uT: Array, *, step_m: float = GLM_STEP_M, window: int = GLM_WINDOW
) -> GlmSeries:
    """Gradient localization metric along a walk (Kuevor B30, eq. 4.13-4.15).

    gradient_uT_per_m (n, c, 2 or 3) of the map, and error_uT (n, c) map minus measurement, both at the true positions.
    """
    return glm_series(step_m * gradient_norms(gradient_uT_per_m).total, error_uT, window=window)


def glm_series(signal_uT: Array, error_uT: Array, *, window: int = GLM_WINDOW) -> GlmSeries:
    """The same from the signal (n,): gradient times step."""
    signal, noise = signal_uT, np.linalg.norm(error_uT, axis=1)
    ratio = np.full(len(signal), np.nan)
    if len(signal) >= window:
        box = np.ones(window)
        ratio[window - 1 :] = _ratio(np.convolve(signal, box, "valid"), np.convolve(noise, box, "valid"))
    return GlmSeries(signal, noise, ratio)


def glm_average(t_s: Array, series: GlmSeries) -> float:
    """GLM_avg: mean of signal / noise over samples at 2 Hz (Kuevor B30, eq. 4.16); one small noise can dominate it."""
    at = at_two_hertz(t_s)
    return float(np.mean(_ratio(series.signal_uT[at], series.noise_uT[at])))


def glm_ratio_of_means(t_s: Array, series: GlmSeries) -> float:
    """Mean signal over mean noise of the same samples: what GLM_avg means, without its weakness (Kuevor, 4.28)."""
    at = at_two_hertz(t_s)
    return float(_ratio(series.signal_uT[at].mean(), series.noise_uT[at].mean()))


def at_two_hertz(t_s: Array) -> NDArray[np.int64]:
    """Indices of the first sample at or after every half second."""
    wanted = np.arange(t_s[0], t_s[-1] + 1e-9, 1.0 / _GLM_RATE_HZ)
    return np.unique(np.minimum(np.searchsorted(t_s, wanted - 1e-9), len(t_s) - 1))


def _ratio(signal: Array, noise: Array) -> Array:
    """signal / noise; no noise is infinitely good, but no signal is worth nothing whatever the noise."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.where(np.asarray(signal) == 0.0, 0.0, np.divide(signal, noise)))


def _extreme(grid: FieldGrid, layer: int, total: Array, flat: int) -> Extreme:
    j, i = np.unravel_index(flat, total.shape)
    x0, y0 = grid.origin_m
    position = np.array([x0 + i * grid.resolution_m, y0 + j * grid.resolution_m, grid.heights_m[layer]])
    return Extreme(position, float(total[j, i]))
