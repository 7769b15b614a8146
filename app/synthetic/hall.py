"""A hall of 12 m by 8 m whose field is three waves: the smallest world in which everything can be asked."""

import numpy as np

from app.field.error_structure import ErrorStructure
from app.field.grid import FieldGrid
from app.geometry import Array

__all__ = ["HALL_CORNERS_M", "hall_map", "hall_uT"]

HALL_CORNERS_M = np.array([[1.0, 1.0], [10.5, 6.5], [10.5, 2.0], [2.0, 5.5], [9.0, 1.0], [2.0, 2.0], [10.0, 7.0]])
"""Of a walk of 48 m through it."""
CELL_M = 0.25
WHITE = ErrorStructure(0.0, 0.0, 1.0, 1.0)


def hall_uT(x_m: Array, y_m: Array) -> Array:
    """The field (..., 3), known everywhere, also outside."""
    return np.stack(
        [
            18 + 6 * np.sin(0.9 * x_m + 0.3) * np.cos(0.7 * y_m),
            3 + 5 * np.cos(0.6 * x_m - 0.8 * y_m),
            -42 + 6 * np.sin(0.5 * x_m + 1.1 * y_m),
        ],
        axis=-1,
    )


def hall_map(margin_m: float = 3.0, structure: ErrorStructure = WHITE, error_correlation_m: float = 0.0) -> FieldGrid:
    """Its map, as good as a map can be, and so much more on every side."""
    x = np.arange(-margin_m, 12.0 + margin_m + 0.01, CELL_M)
    y = np.arange(-margin_m, 8.0 + margin_m + 0.01, CELL_M)
    mean = hall_uT(*np.meshgrid(x, y))[None]
    gradient = np.stack([np.gradient(mean, CELL_M, axis=2), np.gradient(mean, CELL_M, axis=1)], axis=-1)
    return FieldGrid(
        components="vector",
        origin_m=(-margin_m, -margin_m),
        resolution_m=CELL_M,
        heights_m=np.array([1.2]),
        mean_uT=mean.astype(np.float32),
        sd_uT=np.full(mean.shape, 0.3, np.float32),
        gradient_uT_per_m=gradient.astype(np.float32),
        measured=np.ones(mean.shape[:3], dtype=np.bool_),
        ambient_uT=np.array([18.0, 3.0, -42.0]),
        prior_sd_uT=np.full(3, 5.0),
        noise_sd_uT=np.full(3, 0.4),
        error_correlation_m=error_correlation_m,
        error_structure=structure,
    )
