"""How well a floor can be positioned on, in a few numbers, from its map alone: before anybody asks where they are."""

from dataclasses import dataclass

import numpy as np

from app.field.expected_error import WindowModel, expected_error_m
from app.field.grid import FieldGrid
from app.field.localizability import Extreme, best_and_worst_points, gradient_norms
from app.geometry import Array

__all__ = ["PERCENTILES", "JudgedPoint", "LocalizabilitySummary", "summarise_localizability"]

PERCENTILES = (5, 25, 50, 75, 95)
Percentiles = dict[str, float]  # "p5" to "p95"


@dataclass(frozen=True, slots=True)
class JudgedPoint:
    """A measured cell, its gradient along the floor, its expected error (None: no window that ends there is mapped)."""

    position_m: tuple[float, float, float]
    gradient_uT_per_m: float
    expected_error_m: float | None


@dataclass(frozen=True, slots=True)
class LocalizabilitySummary:
    """Of the measured cells at one height. Shares are of all of them; cells without an expected error are in none.

    gradient_uT_per_m   percentiles of "total" (along the floor), "x" and "y"; empty where nothing is measured
    """

    height_m: float
    measured_area_m2: float
    gradient_uT_per_m: dict[str, Percentiles]
    best: JudgedPoint | None
    worst: JudgedPoint | None
    expected_error_m: Percentiles | None
    judged_share: float
    share_within_1_m: float
    share_within_5_m: float


def summarise_localizability(grid: FieldGrid, height_index: int, window: WindowModel) -> LocalizabilitySummary:
    """Summarise one height of a map for a window and sensor."""
    measured = grid.measured[height_index]
    error_m = expected_error_m(grid, height_index, window)
    judged_m = error_m[np.isfinite(error_m)]
    norms = gradient_norms(grid.gradient_uT_per_m[height_index, ..., :2])
    named = {"total": norms.total, "x": norms.x, "y": norms.y}
    extremes = best_and_worst_points(grid, height_index)
    best, worst = (_judge(grid, error_m, point) for point in extremes) if extremes else (None, None)
    return LocalizabilitySummary(
        height_m=float(grid.heights_m[height_index]),
        measured_area_m2=float(measured.sum() * grid.resolution_m**2),
        gradient_uT_per_m={name: _percentiles(v[measured]) for name, v in named.items() if extremes},
        best=best,
        worst=worst,
        expected_error_m=_percentiles(judged_m) if len(judged_m) else None,
        judged_share=len(judged_m) / max(int(measured.sum()), 1),
        share_within_1_m=float(np.sum(judged_m <= 1.0)) / max(int(measured.sum()), 1),
        share_within_5_m=float(np.sum(judged_m <= 5.0)) / max(int(measured.sum()), 1),
    )


def _judge(grid: FieldGrid, error_m: Array, point: Extreme) -> JudgedPoint:
    x, y, z = (float(v) for v in point.position_m)
    i, j = round((x - grid.origin_m[0]) / grid.resolution_m), round((y - grid.origin_m[1]) / grid.resolution_m)
    error = float(error_m[j, i])
    return JudgedPoint((x, y, z), point.gradient_uT_per_m, error if np.isfinite(error) else None)


def _percentiles(values: Array) -> Percentiles:
    return {f"p{q}": float(v) for q, v in zip(PERCENTILES, np.percentile(values, PERCENTILES), strict=True)}
