"""Stretches over which the field departs from what was expected there, beyond what expectations err by.

Errors along a walk hang together (position labels times gradient, attitude, a bias of the whole walk), so a stretch is
judged by its mean departure, whose variance is that of a mean of white noise and an Ornstein-Uhlenbeck process along
the path. The walk's own median is taken off first, and its own spread widens the sds it states. Tails are heavy: the
statistic is compared with F, not with chi-square. Probabilities are Bonferroni's over all stretches of independent
length and all lengths tried.
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import f

from app.field.error_structure import UNKNOWN_STRUCTURE, ErrorStructure
from app.field.grid import FieldGrid
from app.geometry import Array

__all__ = ["Departure", "Expected", "departures", "expected_from_map", "expected_from_other_visits"]

MAP_CHANCE, VISIT_CHANCE = 1e-2, 1e-3
"""Of calling any stretch of an undisturbed walk a departure; visits of one walk know little of how their errors err."""
DURATIONS_S = (1.5, 3.0, 6.0, 12.0, 24.0, 48.0)
MAP_TAILS, VISIT_TAILS = 25.0, 12.0
"""Degrees of freedom of the denominator: the fewer, the heavier the tails that errors are taken to have."""
ROBUST_SD = 1.4826
FEWEST = 8
MOST_OF_WALK = 0.5
"""A walk that departs longer than this departs from the whole map, which is no stretch."""

REVISIT_M, REVISIT_S = 0.6, 15.0
STAY_M, STAY_S = 0.01, 1.0
"""Places this near are the same; visits this far apart in time are different ones."""


@dataclass(frozen=True, slots=True, eq=False)
class Expected:
    """What other surveys' map, or other visits, lead one to expect at every sample of a walk.

    mean_uT, sd_uT   (n, c): the expected field, and the sd of a reading about it with all its errors; not a number
                     where nothing is known. c = 3 in the frame of the readings, or 1: the norm
    structure        how those errors hang together along the walk
    chance, tails    of calling any stretch of an undisturbed walk a departure; degrees of freedom of the F distribution
    """

    mean_uT: Array
    sd_uT: Array
    structure: ErrorStructure = UNKNOWN_STRUCTURE
    chance: float = MAP_CHANCE
    tails: float = MAP_TAILS


def expected_from_map(grid: FieldGrid, p_building_m: Array, more_sd_uT: float = 0.0) -> Expected:
    """What a map leads one to expect at positions (n, 3), in its components; `more_sd_uT`: hard iron left, say.

    Positions are known here, so what errors do when a pose may take them up is no concern: they hang together over the
    distance that the map's held-out errors did.
    """
    values = grid.at(p_building_m)
    known = values.measured[:, None]
    sd_uT = np.sqrt(np.square(values.sd_uT) + np.square(grid.noise_sd_uT) + more_sd_uT**2)
    length_m = max(grid.error_structure.walk_length_m, grid.error_correlation_m)
    structure = replace(grid.error_structure, walk_length_m=length_m)
    return Expected(np.where(known, values.mean_uT, np.nan), np.where(known, sd_uT, np.nan), structure)


class Departure(NamedTuple):
    """Samples `start` to `stop` (excluded) miss what was expected by `mean_uT` (c,) on average."""

    start: int
    stop: int
    mean_uT: Array
    p_value: float

    @property
    def size_uT(self) -> float:
        return float(np.linalg.norm(self.mean_uT))


def departures(t_s: Array, path_m: Array, B_uT: Array, expected: Expected) -> list[Departure]:
    """Stretches of readings (n, c) that depart, clearest first chosen, none overlapping, in order of time.

    path_m (n,) is the distance walked.
    """
    known = np.flatnonzero(np.isfinite(expected.mean_uT).all(axis=1) & np.isfinite(expected.sd_uT).all(axis=1))
    if len(known) < 2 * FEWEST:
        return []
    miss_uT = B_uT[known] - expected.mean_uT[known]
    miss_uT = miss_uT - np.median(miss_uT, axis=0)
    z = miss_uT / expected.sd_uT[known]
    z /= np.maximum(ROBUST_SD * np.median(np.abs(z), axis=0), 1.0)
    t, path = t_s[known], path_m[known]
    spans, p_values = _judged_spans(t, path, z, expected)
    found: list[Departure] = []
    taken = np.zeros(len(known), dtype=bool)
    for k in np.argsort(p_values, kind="stable").tolist():
        if p_values[k] > expected.chance:
            break
        a, b = spans[k].tolist()
        if not taken[a:b].any():
            taken[a:b] = True
            found.append(Departure(int(known[a]), int(known[b - 1]) + 1, miss_uT[a:b].mean(axis=0), float(p_values[k])))
    return sorted(found)


def _judged_spans(t_s: Array, path_m: Array, z: Array, expected: Expected) -> tuple[NDArray[np.intp], Array]:
    """Spans (k, 2) of samples of every duration tried, a quarter of it apart, and their p-values (k,)."""
    total = np.vstack([np.zeros(z.shape[1]), np.cumsum(z, axis=0)])
    whole_s = float(t_s[-1] - t_s[0])
    durations = [d for d in DURATIONS_S if d <= MOST_OF_WALK * whole_s]
    spans, p_values = [np.empty((0, 2), np.intp)], [np.empty(0)]
    for duration in durations:
        begin = _begins_s(t_s, duration)
        start, stop = np.searchsorted(t_s, begin), np.searchsorted(t_s, begin + duration)
        filled = (stop - start >= FEWEST) & (t_s[np.maximum(stop - 1, 0)] - t_s[np.minimum(start, len(t_s) - 1)]
                                              >= 0.7 * duration)  # fmt: skip
        start, stop = start[filled], stop[filled]
        if not len(start):
            continue
        count = (stop - start)[:, None]
        mean = (total[stop] - total[start]) / count
        variance = _variance_of_mean(
            count[:, 0].astype(np.float64), path_m[stop - 1] - path_m[start], expected.structure
        )
        statistic = np.sum(np.square(mean), axis=1) / (variance * z.shape[1])
        chance = f.sf(statistic, z.shape[1], expected.tails) * len(durations) * whole_s / duration
        spans.append(np.stack([start, stop], axis=1))
        p_values.append(chance)
    return np.concatenate(spans), np.concatenate(p_values)


def _begins_s(t_s: Array, duration_s: float) -> Array:
    """Starts of spans, a quarter of a duration apart, that hold a sample: a log may be silent for years in between."""
    step_s = duration_s / 4.0
    k = np.unique(np.floor((t_s - t_s[0]) / step_s)[:, None] - np.arange(4.0))
    begin = t_s[0] + step_s * k[k >= 0.0]
    return np.asarray(begin[begin <= t_s[-1] - duration_s + 1e-9])


def _variance_of_mean(count: Array, length_m: Array, structure: ErrorStructure) -> Array:
    """Variance of the mean of that many standardised errors over that much of the path; the walk's constant is off."""
    u = np.maximum(length_m / structure.walk_length_m, 1e-3)
    walk = 2.0 * (u - 1.0 + np.exp(-u)) / u**2
    return np.asarray(structure.walk_share * walk + structure.white_share / count + 0.1 * structure.constant_share)


def _first_of_stays(t_s: Array, p_building_m: Array) -> NDArray[np.intp]:
    """Indices of samples (m,) of which none is within a centimetre and STAY_S of the one before: standing still, a
    device reads its place over and over, and every reading would be compared with every other."""
    kept = [0]
    for k in range(1, len(t_s)):
        last = kept[-1]
        if t_s[k] - t_s[last] >= STAY_S or np.abs(p_building_m[k] - p_building_m[last]).max() > STAY_M:
            kept.append(k)
    return np.array(kept, dtype=np.intp)


def expected_from_other_visits(
    t_s: Array, p_building_m: Array, B_uT: Array, noise_sd_uT: float, gradient_uT_per_m: float, attitude_sd_rad: float
) -> Expected:
    """What the other visits of each place in the same walk lead one to expect there: the reading nearest to it."""
    mean, sd = np.full(B_uT.shape, np.nan), np.full(B_uT.shape, np.nan)
    floor = attitude_sd_rad * float(np.median(np.linalg.norm(B_uT, axis=1)))
    first = _first_of_stays(t_s, p_building_m)
    tree = cKDTree(p_building_m[first])
    for k, place in enumerate(p_building_m):
        near = first[np.array(tree.query_ball_point(place, REVISIT_M), dtype=np.intp)]
        others = near[np.abs(t_s[near] - t_s[k]) > REVISIT_S]
        if len(others):
            away = np.linalg.norm(p_building_m[others] - p_building_m[k], axis=1)
            nearest = others[np.argsort(away, kind="stable")[:5]]
            distance = float(np.mean(np.sort(away)[:5])) + 0.1
            mean[k] = B_uT[nearest].mean(axis=0)
            sd[k] = np.sqrt(2.0 * (noise_sd_uT**2 + floor**2) + (gradient_uT_per_m * distance) ** 2)
    return Expected(mean, sd, chance=VISIT_CHANCE, tails=VISIT_TAILS)
