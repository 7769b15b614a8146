"""What a curl-free map says of its own errors where nobody walked: above and below the surveys, and far from them.

A potential is learned given that there are no sources in the air around the walks, so its signal is that of a field
with sources everywhere: larger, by a factor of two or more, than the field is found to be. What it is taken to be where
nothing was measured is therefore how much it was found to vary. And its posterior knows one length, whereas steel just
above the ceiling bends the field faster than steel afar: beyond the heights walked errors grow with the field's own
slope.
"""

from collections.abc import Sequence

import numpy as np

from app.field.observations import Walk
from app.field.raster import Blended
from app.geometry import Array

__all__ = ["in_terms_of", "spread_uT", "with_continuation"]

SLOPE_ERROR = 0.2
"""Error of the slope along which the field is continued up and down, over the slope itself."""
LEAST_SPREAD_UT = 1e-3


def spread_uT(walks: Sequence[Walk], ambient_uT: Array) -> Array:
    """(c,) root mean square of what was measured about the ambient field."""
    deviation_uT = np.concatenate([walk.field_uT for walk in walks]) - ambient_uT
    return np.asarray(np.maximum(np.sqrt(np.mean(np.square(deviation_uT), axis=0)), LEAST_SPREAD_UT))


def in_terms_of(factor: Array, variance_ratio: Array) -> Array:
    """(c, ...) variances over the prior's of those (c, ...) over the signal's, by a factor (c,); never above one."""
    return np.minimum(variance_ratio * factor.reshape(-1, *[1] * (variance_ratio.ndim - 1)), 1.0)


def with_continuation(blended: Blended, layers_m: Array, walks: Sequence[Walk], signal_sd_uT: Array) -> Array:
    """(c, nz, ny, nx) variance over the signal's, with that of continuing the field beyond the heights walked."""
    z_m = np.concatenate([walk.position_m[:, 2] for walk in walks])
    past_m = np.maximum(0.0, np.maximum(z_m.min() - layers_m, layers_m - z_m.max()))
    error_uT = SLOPE_ERROR * past_m[:, None, None] * blended.gradient_uT_per_m[2]
    return np.asarray(blended.variance_ratio + np.square(error_uT / signal_sd_uT[0]))
