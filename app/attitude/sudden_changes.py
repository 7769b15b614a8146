"""Changes of the field too sudden for walking: steps, hum, and a sensor that is stuck.

A walker takes the field of a building in along a smooth path: over a second a cubic in time follows it. A step is a
change that the cubic needs besides (an F test against what is left of the window, so that a window that no cubic
follows, beside steel, proves nothing) and that stands out from the changes of the seconds around it. Hum is what is
left of the readings when everything smooth is differenced away. Real phones now and then repeat one reading for a
second while they are carried on; such a stretch has no noise in its magnitude, and ends with a step that is none.
"""

from typing import NamedTuple

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.special import comb
from scipy.stats import chi2, f

from app.geometry import Array

__all__ = ["Hum", "Step", "find_hum", "find_steps", "find_stuck", "white_noise_sd_uT"]

STEP_CHANCE = 1e-4
"""Of calling a step somewhere in a walk of white noise about cubics."""
SIDE_S = 0.6
"""How much of the walk before and after a step is looked at."""
GAPS_S = (0.0, 0.3)
"""How long a step may take."""
LEAST_STEP_SD = 5.0
"""A step below this many sds of the noise matters to nobody."""
CUBIC = 4
STANDS_OUT = 2.0
"""Times the largest change over as many samples within `AROUND_S` of it."""
AROUND_S = 1.2

STUCK_SHARE = 0.1
"""Of what the magnitude's noise differs by between two readings: less, and they are one reading given twice."""
STUCK_READINGS = 7
REPEATS_CHANCE = 1e-4

ORDER = 5
_BINOMIALS = comb(ORDER, np.arange(ORDER + 1)) * (-1.0) ** np.arange(ORDER + 1)
_GAIN = float(np.sqrt(np.sum(_BINOMIALS**2)))
_SHARED = float(np.sum((comb(2 * ORDER, np.arange(2 * ORDER + 1)) / comb(2 * ORDER, ORDER)) ** 2))
"""How many neighbouring differences are worth one independent one."""
HUM_S = 1.0
HUM_CHANCE = 1e-6
LEAST_HUM_RATIO = 6.25
"""Of the variance: two and a half times the walk's ordinary sd."""


class Step(NamedTuple):
    """Between samples `before` and `after` the field changed by `change_uT` (c,); p-value over the whole walk.

    `stands_out`: how many times larger it is than any other change as fast within a second.
    """

    before: int
    after: int
    change_uT: Array
    p_value: float
    stands_out: float

    @property
    def size_uT(self) -> float:
        return float(np.linalg.norm(self.change_uT))


class Hum(NamedTuple):
    """Samples `start` to `stop` (excluded) rattle with this sd per component; p-value over the whole walk."""

    start: int
    stop: int
    sd_uT: float
    p_value: float


def _differences(B_uT: Array) -> Array:
    """(n - 5, c) fifth differences, scaled to keep the sd of white noise. Smooth fields vanish from them."""
    return np.asarray(np.tensordot(sliding_window_view(B_uT, ORDER + 1, axis=0), _BINOMIALS[::-1], axes=1) / _GAIN)


def white_noise_sd_uT(B_uT: Array) -> float:
    """Sd per component of the readings' white noise, by the median of fifth differences; B (n, c), n > 5."""
    squared = np.sum(np.square(_differences(B_uT)), axis=1)
    return float(np.sqrt(np.median(squared) / chi2.median(B_uT.shape[1])))


def typical_interval_s(t_s: Array) -> float:
    """The median; at least a nanosecond, so that a log of any times has windows of a countable length."""
    return max(float(np.median(np.diff(t_s))), 1e-9)


def find_steps(t_s: Array, B_uT: Array, noise_sd_uT: float) -> list[Step]:
    """Steps of readings (n, c) at about even times (n,), the clearest of every neighbourhood, in order of time."""
    interval_s = typical_interval_s(t_s)
    side = max(5, round(SIDE_S / interval_s))
    found = [
        step
        for gap in dict.fromkeys(max(1, round(gap_s / interval_s)) for gap_s in GAPS_S)
        for step in _steps(t_s, B_uT, side, gap, noise_sd_uT)
    ]
    chosen: list[Step] = []
    for step in sorted(found, key=lambda each: each.p_value):
        if step.stands_out >= STANDS_OUT and all(
            step.after <= other.before - side // 2 or step.before >= other.after + side // 2 for other in chosen
        ):
            chosen.append(step)
    return sorted(chosen, key=lambda each: each.before)


def _steps(t_s: Array, B_uT: Array, side: int, gap: int, noise_sd_uT: float) -> list[Step]:
    """Of windows of `side` samples, `gap` that are left out, and as many again, those that need a step."""
    n, c = B_uT.shape
    length = 2 * side + gap
    if n < length:
        return []
    place = np.concatenate([np.arange(side), np.arange(side + gap, length)])
    smooth = np.linalg.qr(np.vander((place - place.mean()) / length, CUBIC))[0]
    after = (place >= side) - smooth @ (smooth.T @ (place >= side))
    worth = float(after @ after)
    windows = sliding_window_view(B_uT, length, axis=0)[:, :, place]
    even = np.ptp(sliding_window_view(t_s, length), axis=1) < 1.5 * (length - 1) * np.median(np.diff(t_s))
    change = windows @ after / worth
    left = windows - (windows @ smooth) @ smooth.T
    rest = np.sum(np.square(left), axis=(1, 2)) - worth * np.sum(np.square(change), axis=1)
    freedom = c * (len(place) - CUBIC - 1)
    variance = np.maximum(rest / freedom, noise_sd_uT**2)
    p_value = f.sf(worth * np.sum(np.square(change), axis=1) / (c * variance), c, freedom) * n
    large = np.linalg.norm(change, axis=1) >= LEAST_STEP_SD * noise_sd_uT
    return [
        Step(a := k + side - 1, b := k + side + gap, change[k], float(p_value[k]), _stands_out(t_s, B_uT, a, b))
        for k in np.flatnonzero((p_value < STEP_CHANCE) & large & even).tolist()
    ]


def _stands_out(t_s: Array, B_uT: Array, before: int, after: int) -> float:
    lag = after - before
    first, last = np.searchsorted(t_s, [t_s[before] - AROUND_S, t_s[after] + AROUND_S])
    changes = np.linalg.norm(B_uT[first + lag : last] - B_uT[first : last - lag], axis=1)
    at = np.arange(first, last - lag)
    others = changes[(at + lag <= before) | (at >= after)]
    return float(changes[before - first] / max(others.max(initial=0.0), 1e-9))


def find_hum(t_s: Array, B_uT: Array, noise_sd_uT: float, known: list[tuple[int, int]]) -> list[Hum]:
    """Stretches whose fifth differences are too large for the walk's ordinary noise.

    `known` are samples, first and last, whose sudden changes have another name: steps, and a sensor that was stuck.
    """
    n, c = B_uT.shape
    interval_s = typical_interval_s(t_s)
    length = max(8, round(HUM_S / interval_s))
    if n < length + ORDER:
        return []
    squared = np.sum(np.square(_differences(B_uT)), axis=1) / c
    usable = np.ptp(sliding_window_view(t_s, ORDER + 1), axis=1) < 2.0 * ORDER * interval_s
    for first, last in known:
        usable[max(first - ORDER, 0) : last + 1] = False
    count = np.convolve(usable, np.ones(length), "valid")
    ratio = np.convolve(squared * usable, np.ones(length), "valid") / np.maximum(count, 1.0) / noise_sd_uT**2
    freedom = np.maximum(c * count / _SHARED, 1.0)
    p_value = chi2.sf(ratio * freedom, freedom) * n / length
    loud = (p_value < HUM_CHANCE) & (ratio > LEAST_HUM_RATIO) & (count >= length / 2)
    return [
        Hum(
            start,
            stop + length - 1 + ORDER,
            float(np.sqrt(ratio[start:stop].max()) * noise_sd_uT),
            float(p_value[start:stop].min()),
        )
        for start, stop in runs_of(loud)
    ]


def find_stuck(B_uT: Array, noise_sd_uT: float) -> list[tuple[int, int]]:
    """Start and stop (excluded) of stretches that repeat one reading, however the device turns meanwhile.

    A sensor of coarse steps repeats itself all the time: a run has to be longer than chance makes any in the walk.
    """
    repeated = np.abs(np.diff(np.linalg.norm(B_uT, axis=1))) < STUCK_SHARE * np.sqrt(2.0) * noise_sd_uT
    share = float(np.clip(repeated.mean(), 1e-9, 1.0 - 1e-6)) if len(repeated) else 0.5
    by_chance = np.log(REPEATS_CHANCE / max(len(repeated), 1)) / np.log(share)
    return [(a, b + 1) for a, b in runs_of(repeated) if b + 1 - a >= max(STUCK_READINGS, by_chance)]


def runs_of(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """Start and stop (excluded) of every run of True."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]
