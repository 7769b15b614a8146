"""Random processes of sensors and walkers."""

import numpy as np

from app.geometry import Array

__all__ = ["ornstein_uhlenbeck"]


def ornstein_uhlenbeck(
    rng: np.random.Generator, at: Array, sd: Array | float, correlation: float, columns: int = 1
) -> Array:
    """A stationary Ornstein-Uhlenbeck process (len(at), columns), covariance sd^2 exp(-|a - b| / correlation).

    `at` increases: seconds, or metres along the path; `correlation` is in the same unit. `sd` is one number or one per
    column. The steps are exact for any spacing.
    """
    decay = np.exp(-np.diff(at) / correlation)
    kick = rng.normal(size=(len(at), columns))
    spread = np.sqrt(1.0 - decay * decay)
    out = np.empty((len(at), columns))
    out[:1] = kick[:1]
    for k, (a, b) in enumerate(zip(decay, spread, strict=True)):
        out[k + 1] = a * out[k] + b * kick[k + 1]
    return out * sd
