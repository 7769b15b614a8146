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
    first = np.append(0, np.flatnonzero(np.diff(np.floor(path_m / cell_m))) + 1)
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
    mean, square = _cell_means(standardised, np.append(first, len(standardised)))
    cells, count = mean.shape
    total = np.vstack([np.zeros(count), np.cumsum(mean, axis=0)])
    least = np.repeat([CALIBRATED_SD, CALIBRATED_MAGNITUDE_SD], count // 2)
    lengths_m = np.repeat([correlation_m, max(correlation_m, LEAST_MAGNITUDE_CORRELATION_M)], count // 2)
    shortest = int(np.ceil(max(SHORTEST_M, CORRELATION_LENGTHS * correlation_m) / cell_m))
    independent = max(2.0, cells * cell_m / (2.0 * correlation_m))
    clearest = None
    splits = _clearest_splits(total, square.sum(axis=0), np.square(least), 2.0 * lengths_m / cell_m, shortest)
    for (start, stop, statistic), places in zip(splits, (independent, independent**2 / 2.0), strict=True):
        log_p = np.minimum(log_ndtr(-statistic) + np.log(2.0 * count * places), 0.0)
        if stop and (clearest is None or log_p.min() < clearest.log_p.min()):
            clearest = _Split(start, stop, log_p)
    return clearest


@njit(cache=True)
def _cell_means(standardised: Array, bounds: NDArray[np.intp]) -> tuple[Array, Array]:
    """(cells, 2 c) mean of the clipped errors (n, c) of every cell and of their magnitudes, and of their squares."""
    components = standardised.shape[1]
    mean, square = np.zeros((len(bounds) - 1, 2 * components)), np.zeros((len(bounds) - 1, 2 * components))
    for cell in range(len(mean)):
        for i in range(bounds[cell], bounds[cell + 1]):
            for c in range(components):
                z = min(max(standardised[i, c], -CLIP_SD), CLIP_SD)
                mean[cell, c] += z
                mean[cell, components + c] += abs(z)
                square[cell, c] += z * z
        mean[cell] /= bounds[cell + 1] - bounds[cell]
        square[cell] /= bounds[cell + 1] - bounds[cell]
    square[:, components:] = square[:, :components]
    return mean, square


def _clearest_splits(
    total: Array, square: Array, least_square: Array, cells_per_error: Array, shortest: int
) -> tuple[tuple[int, int, Array], tuple[int, int, Array]]:
    """Over stretches of at least `shortest` cells, the start, stop and statistics (f,) of the clearest that reaches an

    end of the walk and of the clearest that does not; stop 0: none. total (n + 1, f): cumulated features of the cells;
    square (f,): their summed squares. A feature that changes too little to matter has statistic 0.

    Means of a stretch of k of n cells and of the rest differ by n / k (n - k) of what the centred sums do between its
    ends: lengths of which no stretch can differ by enough are passed over.
    """
    cells = len(total) - 1
    centred = total - np.linspace(0.0, 1.0, cells + 1)[:, None] * total[-1]
    inside = np.arange(cells + 1)
    enough: Array = (LEAST_CHANGE * (1.0 - 1e-9) / cells) * np.asarray(inside * (cells - inside), np.float64)
    lengths = np.flatnonzero(enough <= np.ptp(centred, axis=0).max())
    lengths = lengths[(lengths >= shortest) & (lengths <= cells - shortest)]
    switch, other = _splits(total, centred, enough, lengths, square, least_square, cells_per_error)
    return switch, other


@njit(cache=True)
def _splits(
    total: Array,
    centred: Array,
    enough: Array,
    lengths: NDArray[np.int64],
    square: Array,
    least_square: Array,
    cells_per_error: Array,
) -> tuple[tuple[int, int, Array], tuple[int, int, Array]]:
    cells, features = len(total) - 1, total.shape[1]
    best, ends = np.zeros(2), np.zeros((2, 2), dtype=np.int64)
    here, chosen = np.zeros(features), np.zeros((2, features))
    for inside in lengths:
        outside = cells - inside
        for start in range(outside + 1):
            stop, largest = start + inside, 0.0
            for f in range(features):
                here[f] = 0.0
                if abs(centred[stop, f] - centred[start, f]) < enough[inside]:
                    continue
                part = total[stop, f] - total[start, f]
                inner, outer = part / inside, (total[cells, f] - part) / outside
                difference = abs(inner - outer)
                if difference >= LEAST_CHANGE:
                    within = (square[f] - inside * inner**2 - outside * outer**2) / cells
                    variance = max(within, least_square[f]) * cells_per_error[f] * (1.0 / inside + 1.0 / outside)
                    here[f] = difference / np.sqrt(variance)
                    largest = max(largest, here[f])
            k = 0 if start == 0 or stop == cells else 1
            if largest > best[k] or (largest == best[k] > 0.0 and start < ends[k, 0]):
                best[k], ends[k, 0], ends[k, 1] = largest, start, stop
                chosen[k] = here
    return (ends[0, 0], ends[0, 1], chosen[0]), (ends[1, 0], ends[1, 1], chosen[1])
