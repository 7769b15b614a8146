"""How well the places of a survey are told apart, with hindsight: Kuevor's GLM of its samples (Kuevor B30)."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numba import njit

from app.field.consistency import MIN_JUDGED
from app.field.grid import FieldGrid
from app.field.leave_one_out import HeldOut
from app.field.localizability import GLM_STEP_M, at_two_hertz, glm_average, glm_ratio_of_means, glm_series
from app.field.samples import Samples
from app.field.spec import ConsistencyReport, WalkLocalizability
from app.geometry import Array

__all__ = ["add_localizability", "gradient_along", "walk_localizability"]

MOST_SAMPLES = 2000
"""Of longer walks every second, third, ... sample says as much."""


def add_localizability(
    reports: Mapping[str, ConsistencyReport],
    walks: Mapping[str, Samples],
    held_out: Mapping[str, HeldOut],
    grid: FieldGrid,
) -> dict[str, ConsistencyReport]:
    """The reports with the figures of every survey that has enough judged samples: the gradient is the map's, the
    error that of the map of the others."""
    return {name: replace(report, localizability=_of_survey(walks[name], held_out[name], grid))
            for name, report in reports.items()}  # fmt: skip


def walk_localizability(t_s: Array, gradient_uT_per_m: Array, error_uT: Array) -> WalkLocalizability:
    """The figures of samples (n,), n > 0, in order of time: norms of the gradient (n,) and errors (n, c)."""
    series, at = glm_series(GLM_STEP_M * gradient_uT_per_m, error_uT), at_two_hertz(t_s)
    moving = series.glm[np.isfinite(series.glm)]
    p5, p50, p95 = np.percentile(moving, [5.0, 50.0, 95.0]).tolist() if len(moving) else (None, None, None)
    return WalkLocalizability(
        step_m=GLM_STEP_M,
        mean_signal_ut=float(series.signal_uT[at].mean()),
        mean_noise_ut=float(series.noise_uT[at].mean()),
        glm_average=_finite(glm_average(t_s, series)),
        glm_ratio_of_means=_finite(glm_ratio_of_means(t_s, series)),
        glm_p5=p5,
        glm_p50=p50,
        glm_p95=p95,
    )


def gradient_along(grid: FieldGrid, position_m: Array) -> Array:
    """(n,) norm of the map's gradient at points (n, 3), as that of `FieldGrid.at` in a tenth of the time; NaN where
    not measured."""
    cells = (position_m[:, :2] - np.asarray(grid.origin_m)) / grid.resolution_m
    layer = np.interp(position_m[:, 2], grid.heights_m, np.arange(len(grid.heights_m), dtype=np.float64))
    along = _gradient_along(grid.gradient_uT_per_m, grid.measured, cells, layer)
    return np.where(grid.between_layers(position_m), along, np.nan)


def _of_survey(samples: Samples, held_out: HeldOut, grid: FieldGrid) -> WalkLocalizability | None:
    judged = np.flatnonzero(held_out.judged)
    judged = judged[:: 1 + len(judged) // MOST_SAMPLES]
    gradient = gradient_along(grid, samples.p_building_m[judged])
    seen = np.isfinite(gradient)
    if np.count_nonzero(seen) < MIN_JUDGED:
        return None
    return walk_localizability(samples.t_s[judged[seen]], gradient[seen], held_out.error_uT[judged[seen]])


def _finite(ratio: float) -> float | None:
    return ratio if np.isfinite(ratio) else None


@njit(cache=True)
def _gradient_along(gradient, measured, cells, layer):  # type: ignore[no-untyped-def]
    _, ny, nx, c, d = gradient.shape
    norm, slope = np.full(len(cells), np.nan), np.empty((c, d))
    for s in range(len(cells)):
        u, v = cells[s]
        if not (0.0 <= u <= nx - 1 and 0.0 <= v <= ny - 1):
            continue
        k, j, i = int(layer[s]), int(v), int(u)
        slope[:], seen = 0.0, True
        for up, wz in enumerate((1.0 - (layer[s] - k), layer[s] - k)):
            for north, wy in enumerate((1.0 - (v - j), v - j)):
                for east, wx in enumerate((1.0 - (u - i), u - i)):
                    if wz * wy * wx > 0.0:
                        seen &= measured[k + up, j + north, i + east]
                        for m in range(c):
                            for a in range(d):
                                slope[m, a] += wz * wy * wx * gradient[k + up, j + north, i + east, m, a]
        if seen:
            norm[s] = np.sqrt(np.sum(slope * slope))
    return norm
