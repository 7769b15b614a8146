"""The field while a device stands still: it may change by noise, by turning, by the hand that holds it, by no more."""

from typing import NamedTuple

import numpy as np
from scipy.stats import f

from app.attitude.sudden_changes import runs_of, typical_interval_s
from app.geometry import Array

__all__ = ["StillChange", "find_changes_at_rest", "typical_gradient_uT_per_m"]

STILL_M_S = 0.15
SHORTEST_S = 2.0
BLOCK_S = 0.5
HAND_M = 0.1
SHARE_OF_WANDER = 0.5
"""Who stands still does not swing the device: its attitude wanders less than along a walk."""
REST_CHANCE = 1e-2
TAIL_FREEDOM = 25.0
GRADIENT_OVER_M = 0.5


class StillChange(NamedTuple):
    """Samples `start` to `stop` (excluded) differ by `size_uT` from the rest of the same standstill."""

    start: int
    stop: int
    size_uT: float
    p_value: float


def typical_gradient_uT_per_m(path_m: Array, B_uT: Array) -> float:
    """The walk's own: the 75th percentile of changes over half a metre, per metre; 0 for a walk that does not move."""
    ahead = np.searchsorted(path_m, path_m + GRADIENT_OVER_M)
    here = np.flatnonzero(ahead < len(path_m))
    if not len(here):
        return 0.0
    change = np.linalg.norm(B_uT[ahead[here]] - B_uT[here], axis=1) / (path_m[ahead[here]] - path_m[here])
    return float(np.quantile(change, 0.75))


def find_changes_at_rest(
    t_s: Array,
    p_building_m: Array,
    B_uT: Array,
    noise_sd_uT: float,
    gradient_uT_per_m: float,
    attitude_sd_rad: float,
) -> list[StillChange]:
    """Changes within standstills of two seconds and more: blocks of half a second against the standstill's median."""
    interval_s = typical_interval_s(t_s)
    block = max(2, round(BLOCK_S / interval_s))
    width = 2 * block
    ahead = np.minimum(np.arange(len(t_s)) + block, len(t_s) - 1)
    back = np.maximum(np.arange(len(t_s)) - block, 0)
    speed = np.linalg.norm(p_building_m[ahead] - p_building_m[back], axis=1) / np.maximum(t_s[ahead] - t_s[back], 1e-9)
    out: list[StillChange] = []
    for a, b in runs_of(speed < STILL_M_S):
        if t_s[b - 1] - t_s[a] < SHORTEST_S or b - a < 2 * width:
            continue
        starts = np.arange(a, b - block + 1, block)
        mean = np.stack([B_uT[s : s + block].mean(axis=0) for s in starts])
        place = np.stack([p_building_m[s : s + block].mean(axis=0) for s in starts])
        off = np.linalg.norm(mean - np.median(mean, axis=0), axis=1)
        moved = np.linalg.norm(place - np.median(place, axis=0), axis=1) + HAND_M
        turned = SHARE_OF_WANDER * attitude_sd_rad * float(np.linalg.norm(np.median(mean, axis=0)))
        variance = noise_sd_uT**2 / block + (gradient_uT_per_m * moved) ** 2 / 3.0 + turned**2
        c = B_uT.shape[1]
        p_value = f.sf(np.square(off) / (c * variance), c, TAIL_FREEDOM) * max((t_s[-1] - t_s[0]) / BLOCK_S, 1.0)
        for i, j in runs_of(p_value < REST_CHANCE):
            if j - i >= 2:
                stop = int(starts[j - 1]) + block
                out.append(StillChange(int(starts[i]), stop, float(off[i:j].max()), float(p_value[i:j].min())))
    return out
