"""Readings that no place of the belief explains: something passed by, was switched on, or is held near.

A converged track that is right meets such readings rarely and one that is wrong meets them for long. So they count for
little, by the variance that makes the innovation one of one sigma (Brommer, L193, Eq. 17), and say nothing for or
against the place, as long as there is patience: PATIENCE_M of the way, which come back three times as slowly on
readings that fit. Without it they count as all others, and the track may find that it is lost.
"""

from dataclasses import replace

import numpy as np
from scipy.special import chdtri

from app.geometry import Array
from app.tracking.particle_filter import normalise
from app.tracking.particles import Advance

__all__ = ["PATIENCE_M", "RECOVERS", "is_disturbed", "softened"]

PATIENCE_M, RECOVERS = 8.0, 1.0 / 3.0
CHANCE = 1e-4
"""Of an innovation beyond it, by the variance it should have."""
LIMIT = {components: float(chdtri(components, CHANCE)) for components in (1, 2, 3)}
"""What chi-square exceeds with that chance, by its degrees of freedom."""
PLAUSIBLE_SHARE = 0.05
"""Of the belief, for which the reading is no surprise: with less it is disturbed."""


def is_disturbed(innovation: Array, log_weight: Array, components: int) -> bool:
    """innovation (n, 2): squares and variance of each particle's, of so many components; log_weight (n,) before it."""
    plausible = innovation[:, 0] <= LIMIT[components] * innovation[:, 1]
    if plausible.all():
        return False
    return float(normalise(log_weight).weight[plausible].sum()) < PLAUSIBLE_SHARE


def softened(move: Advance, innovation: Array, components: int) -> Advance:
    """The same move with a reading of which the middle one of the innovations is one sigma."""
    missing = float(np.median(innovation[:, 0] / components - innovation[:, 1]))
    return replace(move, noise_uT2=move.noise_uT2 + max(missing, 0.0))
