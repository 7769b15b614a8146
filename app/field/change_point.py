"""Where in the log did it go wrong? The stretch of a walk whose errors differ most clearly from the rest (Kuevor B14).

Three things happen to real logs (Kuevor B17): an offset switches and stays, a stretch is disturbed, nothing. So every
stretch [a, b) of the walk is compared with all the rest; one that reaches an end of the walk is a switch. A change of
mean shows in the standardised errors, a change of spread in their magnitudes. Both means are compared by a likelihood
ratio (the square of a difference in its sds) in which a metre walked counts as 1 / (2 correlation lengths) of an
independent error, and the sd is at least what calibrated errors have. The probability is Bonferroni's over components,
both tests and all stretches of independent length; a stretch pays for more places it could have been than a switch.
"""

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.special import log_ndtr

from app.field.leave_one_out import HeldOut
from app.field.spec import ChangePoint, ComponentChange
from app.geometry import Array

__all__ = ["CHANGE_CHANCE", "find_change"]

CHANGE_CHANCE = 1e-3
"""A change less clear than this in a steady walk is not reported."""

MOST_CELLS = 250
CELL_M = 0.5
SHORTEST_M = 2.0
CORRELATION_LENGTHS = 4.0
"""A change lasts at least this many: less is one odd error, and errors have heavy tails."""
CLIP_SD = 5.0
CALIBRATED_SD, CALIBRATED_MAGNITUDE_SD = 1.0, 0.603
"""Of a standard Gaussian and of its magnitude."""
LEAST_MAGNITUDE_CORRELATION_M = 1.0
"""However fast errors change sign, how large they are depends on the place."""
LEAST_CHANGE = 0.8
"""Predictive sds by which the mean, or the mean magnitude, must change to matter: rms errors double."""


class _Split(NamedTuple):
    start: int
    stop: int
    log_p: Array  # (2 c,) of the mean of every component, then of every magnitude


def find_change(held_out: HeldOut, names: tuple[str, ...], correlation_m: float) -> ChangePoint | None:
    """The clearest change in the errors of the judged samples, or None when none is significant and large enough.

    correlation_m: distance walked over which errors of ordinary surveys stay correlated.
    """
    judged = np.flatnonzero(held_out.judged)
    if not len(judged):
        return None
    path_m = held_out.path_m[judged] - held_out.path_m[judged[0]]
    cell_m = max(CELL_M, float(path_m[-1]) / MOST_CELLS)
    _, first = np.unique(np.floor(path_m / cell_m), return_index=True)
    split = _clearest(held_out.standardised, first, cell_m, max(correlation_m, cell_m / 2.0))
    if split is None or split.log_p.min() > np.log(CHANGE_CHANCE):
        return None
    bounds = np.append(judged[first], judged[-1] + 1)
    start, stop, end = int(bounds[split.start]), int(bounds[split.stop]), int(bounds[-1])
    if split.start == 0:  # the walk changed where the stretch ended
        after, start, stop = judged >= stop, stop, end
    else:
        after = (judged >= start) & (judged < stop)
    changed = np.flatnonzero(split.log_p.reshape(2, -1).min(axis=0) <= np.log(CHANGE_CHANCE)).tolist()
    error_uT, lasts = held_out.error_uT[judged], stop == end
    return ChangePoint(
        sample=start,
        path_m=float(held_out.path_m[start]),
        until_sample=None if lasts else stop,
        until_path_m=None if lasts else float(held_out.path_m[stop]),
        p_value=float(np.exp(split.log_p.min())),
        components=tuple(_component(names[c], error_uT[~after, c], error_uT[after, c]) for c in changed),
    )


def _component(name: str, before_uT: Array, after_uT: Array) -> ComponentChange:
    means = float(before_uT.mean()), float(after_uT.mean())
    return ComponentChange(name, *means, float(before_uT.std()), float(after_uT.std()))


def _clearest(standardised: Array, first: NDArray[np.intp], cell_m: float, correlation_m: float) -> _Split | None:
    """The stretch of cells that differs most clearly from the rest; None when none differs by enough to matter."""
    z = np.clip(standardised, -CLIP_SD, CLIP_SD)
    features = np.hstack([z, np.abs(z)])
    samples = np.diff(np.append(first, len(z)))[:, None]
    cells, count = len(first), features.shape[1]
    mean, square = (np.add.reduceat(f, first, axis=0) / samples for f in (features, np.square(features)))
    total = np.vstack([np.zeros(count), np.cumsum(mean, axis=0)])
    least = np.repeat([CALIBRATED_SD, CALIBRATED_MAGNITUDE_SD], count // 2)
    lengths_m = np.repeat([correlation_m, max(correlation_m, LEAST_MAGNITUDE_CORRELATION_M)], count // 2)
    shortest = int(np.ceil(max(SHORTEST_M, CORRELATION_LENGTHS * correlation_m) / cell_m))
    independent = max(2.0, cells * cell_m / (2.0 * correlation_m))
    clearest = None
    for switch, places in ((True, independent), (False, independent**2 / 2.0)):
        arguments = square.sum(axis=0), np.square(least), 2.0 * lengths_m / cell_m, shortest, switch
        start, stop, statistic = _largest_statistic(total, *arguments)
        log_p = np.minimum(log_ndtr(-statistic) + np.log(2.0 * count * places), 0.0)
        if stop and (clearest is None or log_p.min() < clearest.log_p.min()):
            clearest = _Split(start, stop, log_p)
    return clearest


@njit(cache=True)
def _largest_statistic(
    total: Array, square: Array, least_square: Array, cells_per_error: Array, shortest: int, switch: bool
) -> tuple[int, int, Array]:
    """Over stretches of at least `shortest` cells, the start, stop and statistics (f,) of the clearest; stop 0: none.

    total (n + 1, f): cumulated features of the cells; square (f,): their summed squares; switch: only stretches that
    reach an end of the walk, or only those that do not. A feature that changes too little to matter has statistic 0.
    """
    cells, features = len(total) - 1, total.shape[1]
    best, best_start, best_stop = 0.0, 0, 0
    here, chosen = np.zeros(features), np.zeros(features)
    for start in range(cells):
        for stop in range(start + shortest, cells + 1):
            inside, outside = stop - start, cells - stop + start
            if outside < shortest or (start == 0 or stop == cells) != switch:
                continue
            largest = 0.0
            for f in range(features):
                part = total[stop, f] - total[start, f]
                inner, outer = part / inside, (total[cells, f] - part) / outside
                within = (square[f] - inside * inner**2 - outside * outer**2) / cells
                variance = max(within, least_square[f]) * cells_per_error[f] * (1.0 / inside + 1.0 / outside)
                difference = abs(inner - outer)
                here[f] = difference / np.sqrt(variance) if difference >= LEAST_CHANGE else 0.0
                largest = max(largest, here[f])
            if largest > best:
                best, best_start, best_stop = largest, start, stop
                chosen[:] = here
    return best_start, best_stop, chosen
