"""Minimising a smooth function of a few bounded variables that is dear to evaluate: projected BFGS.

The curvature found is handed back, so that a search of a similar function starts with it: two or three evaluations
then do where ten were needed. Nocedal & Wright 2006, 6.1 and 16.7.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.optimize import lsq_linear

from app.geometry import Array

__all__ = ["Minimum", "descend"]

MAX_EVALUATIONS = 60
LONGEST_STEP = 1.5
"""In the largest variable: farther than this a parabola says nothing about a likelihood of logarithms."""
TRUSTED = 0.25
"""A step that gains less than this share of what the parabola promised shortens the next ones."""
SHORTENED = 0.3


class Minimum(NamedTuple):
    """Where a search ended: point (p,), value there, and the curvature (p, p) it had learned by then."""

    point: Array
    value: float
    curvature: Array


def descend(
    objective: Callable[[Array], tuple[float, Array]], start: Array, bounds: Array, curvature: Array, tolerance: float
) -> Minimum:
    """The nearest minimum of value and gradient `objective`; bounds (p, 2), curvature (p, p) a guess, not too high.

    Ends when a step promises, or has gained, less than `tolerance`.
    """
    point, curvature = np.clip(start, bounds[:, 0], bounds[:, 1]), curvature.copy()
    value, slope = objective(point)
    longest = LONGEST_STEP
    for _ in range(MAX_EVALUATIONS):
        step = _step(point, slope, bounds, curvature, longest)
        promised = _promise(step, slope, curvature)
        if promised < tolerance:
            break
        next_point = np.clip(point + step, bounds[:, 0], bounds[:, 1])  # but for rounding it is within
        next_value, next_slope = objective(next_point)
        gained, trusted = value - next_value, value - next_value > TRUSTED * promised
        curvature = _updated(curvature, step, next_slope - slope)
        longest = min(2.0 * longest, LONGEST_STEP) if trusted else SHORTENED * float(np.max(np.abs(step)))
        if gained > 0.0:
            point, value, slope = next_point, next_value, next_slope
        if trusted and gained < tolerance:
            break
    return Minimum(point, value, curvature)


def _step(point: Array, slope: Array, bounds: Array, curvature: Array, longest: float) -> Array:
    """Towards the bottom of the parabola within the bounds, shortened as a whole."""
    step, free = np.zeros(len(point)), bounds[:, 0] < bounds[:, 1]
    size, axes = np.linalg.eigh(curvature[np.ix_(free, free)])
    size = np.sqrt(np.maximum(size, 1e-14 * size[-1]))  # rounding may leave it flat
    low, high = (bounds - point[:, None])[free].T
    step[free] = lsq_linear((axes * size).T, -(axes.T @ slope[free]) / size, (low, high), method="bvls", tol=1e-14).x
    return np.asarray(step * min(1.0, longest / max(float(np.max(np.abs(step))), longest)))


def _promise(step: Array, slope: Array, curvature: Array) -> float:
    """What a step gains on the parabola."""
    return float(-(slope @ step) - 0.5 * step @ curvature @ step)


def _updated(curvature: Array, step: Array, change: Array) -> Array:
    """BFGS, damped (Powell) so that it stays positive definite."""
    bent = curvature @ step
    expected, seen = step @ bent, step @ change
    if expected <= 0.0:
        return curvature
    share = 1.0 if seen >= 0.2 * expected else 0.8 * expected / (expected - seen)
    damped = share * change + (1.0 - share) * bent
    return np.asarray(curvature - np.outer(bent, bent) / expected + np.outer(damped, damped) / (step @ damped))
