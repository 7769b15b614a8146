"""Positions between waypoints: dead reckoning bends to the labels, each as far as it deserves.

Waypoints are tapped on a plan and wrong by about half a metre or more; steps are wrong by a share of the distance.
Positions at steps and waypoints are the mean of the Gaussian posterior of both: a tridiagonal system, solved exactly.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded

from app.geometry import Array

__all__ = ["LABEL_SD_M", "label_positions"]

LABEL_SD_M = 0.5
STEP_VARIANCE_M2_PER_M = 0.18
"""Variance of dead reckoning per metre walked, along and across: a leg of 8 m comes out 13 % and 9 degrees off."""
DRIFT_VARIANCE_M2_PER_S = 0.01
_LEAST_VARIANCE_M2 = 1e-6


def label_positions(t_s: Array, reckoned_m: Array, distance_m: Array, waypoint_t_s: Array, waypoint_m: Array) -> Array:
    """(n, 2) positions in the building frame.

    t_s, reckoned_m (n, 2), distance_m (n,): dead reckoning already turned and scaled to the building frame, from any
    origin, and the distance walked; waypoint_t_s (k,) within t_s, waypoint_m (k, 2).
    """
    node_t_s = np.unique(np.concatenate([t_s[_nodes(distance_m)], waypoint_t_s]))
    node_m = _interpolate(node_t_s, t_s, reckoned_m)
    walked = np.diff(np.interp(node_t_s, t_s, distance_m))
    variance = STEP_VARIANCE_M2_PER_M * walked + DRIFT_VARIANCE_M2_PER_S * np.diff(node_t_s) + _LEAST_VARIANCE_M2
    labelled = np.searchsorted(node_t_s, waypoint_t_s)
    information = 1.0 / (variance * _doubt(labelled, variance, node_m[labelled], waypoint_m))
    banded = np.zeros((2, len(node_t_s)))
    banded[1, :-1] += information
    banded[1, 1:] += information
    banded[0, 1:] = -information
    np.add.at(banded[1], labelled, LABEL_SD_M**-2)
    # The unknown is the correction to dead reckoning, which is smooth; steps alone leave it constant.
    right = np.zeros((len(node_t_s), 2))
    np.add.at(right, labelled, (waypoint_m - node_m[labelled]) * LABEL_SD_M**-2)
    correction = solveh_banded(banded, right)
    return reckoned_m + _interpolate(t_s, node_t_s, correction)


def _doubt(labelled: NDArray[np.intp], variance: Array, reckoned_m: Array, waypoint_m: Array) -> Array:
    """(m,) factor of each variance: above one in legs where dead reckoning misses by more than twice its deviation.

    Steps that were missed (a trolley, a slow stroll) must not pull the labels apart.
    """
    factor = np.ones(len(variance))
    misses_m = np.linalg.norm(np.diff(waypoint_m, axis=0) - np.diff(reckoned_m, axis=0), axis=1)
    for start, stop, miss_m in zip(labelled, labelled[1:], misses_m, strict=False):
        expected = 2.0 * (variance[start:stop].sum() + 2.0 * LABEL_SD_M**2)
        factor[start:stop] = max(1.0, (miss_m**2 - 2.0 * expected) / max(variance[start:stop].sum(), 1e-9))
    return factor


def _nodes(distance_m: Array) -> Array:
    """Indices of samples about every 0.3 m walked, first and last included."""
    marks = np.arange(0.0, distance_m[-1] - distance_m[0], 0.3) + distance_m[0]
    return np.unique(np.concatenate([np.searchsorted(distance_m, marks), [0, len(distance_m) - 1]]))


def _interpolate(at_s: Array, t_s: Array, values: Array) -> Array:
    return np.stack([np.interp(at_s, t_s, column) for column in values.T], axis=1)
