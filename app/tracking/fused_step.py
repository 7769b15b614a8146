"""One step of a particle filter in one compiled pass over the particles; `app.tracking.plain_step` is the plain twin.

The common case: particles on one floor moved by `app.tracking.motion.Displacement`, a map of three components with one
variance per cell, a reading in the teller's level frame, one sensor variance. Single precision and rows of particles
throughout; the heading is kept as cosine and sine and turned by small angles; random numbers are counted, not drawn
from a state (`app.tracking.random_numbers`), so a step is replayed from seed and number alone. Cells nobody measured
tell nothing: particles there keep together the share of the weight they had (`field_likelihood.neutral`).

Particles are resampled at the beginning of the step after the one that made them unequal: copying them is then part of
moving them, and between steps the cloud is the weighted one that estimates are made from.
"""

import numba
import numpy as np

from app.tracking.cloud import EXACTLY, UNMAPPED_UT2, CellTable, Cloud, Step, Stepped, moments_of
from app.tracking.particle_filter import RESAMPLE_BELOW
from app.tracking.random_numbers import BLOCK, exp_of, fill_normals, log_of, uniform

__all__ = ["step_fused"]

_NO_FIT, _UNKNOWN, _LOST = np.float32(-np.inf), np.float32(np.inf), np.float32(-87.0)
_F0, _F1, _F2, _F3, _HALF = (np.float32(v) for v in (0.0, 1.0, 2.0, 3.0, 0.5))
_U1, _U2, _U3, _FOUR = (np.uint64(v) for v in (1, 2, 3, 4))
_SIXTH, _TWENTY_FOURTH, _ONE_AND_HALF = np.float32(1.0 / 6.0), np.float32(1.0 / 24.0), np.float32(1.5)

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
_reordered = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract"})
"""For sums: the same bits on the same kind of processor."""


def step_fused(
    cloud: Cloud, table: CellTable, step: Step, number: int, seed: int, resample_below: float = RESAMPLE_BELOW
) -> Stepped:
    """Resample below that share of n, move, look up and weigh; the random numbers are those of (number, seed)."""
    state, weight = np.empty_like(cloud.state), np.empty_like(cloud.weight)
    key = np.uint64(number), np.uint64(seed)
    resampled, diverged, sums = _step(
        cloud.state, cloud.weight, state, weight, table, step.numbers(), *key, resample_below
    )
    return Stepped(Cloud(state, weight), moments_of(sums), sums[0] ** 2 / sums[9], resampled, diverged)


@_compiled
def _step(state, weight, new_state, new_weight, table, told, number, seed, resample_below):  # type: ignore[no-untyped-def]
    """Returns whether resampled, whether diverged, and `_sums`; fills the new state and weight."""
    n = state.shape[1]
    words, noise = np.empty((4, BLOCK), dtype=np.uint32), np.empty((4, BLOCK), dtype=np.float32)
    place, share = np.zeros(BLOCK, dtype=np.int32), np.zeros((3, BLOCK), dtype=np.float32)
    here, found = np.zeros((5, BLOCK), dtype=np.float32), np.empty((BLOCK, 4), dtype=np.float32)
    fit = np.empty(BLOCK, dtype=np.float32)
    flat, row = table.record.ravel(), np.uint64(4 * table.record.shape[1])
    total, squares = _total(weight)
    resampled = total * total < resample_below * n * squares * EXACTLY
    ancestor = _ancestors(weight, total, uniform(number, seed)) if resampled else np.empty(0, dtype=np.uint32)
    greatest = _NO_FIT
    for first in range(0, n, BLOCK):  # arrays of one block stay in the first cache, and their loops become vectors
        count = min(BLOCK, n - first)
        _take(state, ancestor, first, count, here)
        fill_normals(noise, words, first, number, seed)
        _move(here, noise, told)
        _place(here, place, share, table)
        _look_up(place, share, found, flat, row)
        _fit(here, found, share, fit, told)
        new_state[:, first : first + count] = here[:, :count]
        new_weight[first : first + count] = fit[:count]
        for k in range(count):
            if fit[k] > greatest and fit[k] < _UNKNOWN and (resampled or weight[first + k] > _F0):
                greatest = fit[k]
    _weigh(weight, new_weight, greatest, resampled)
    total, squares = _total(new_weight)
    diverged = not (total > 0.0 and total < np.inf)
    if diverged:
        new_weight[:] = _F1 / np.float32(n)
    else:
        new_weight *= np.float32(1.0 / total)
    return resampled, diverged, _sums(new_state, new_weight)


@_compiled
def _ancestors(weight, total, draw):  # type: ignore[no-untyped-def]
    """Systematic, without a branch to guess: the copies of particle i begin at number ceil(n edge - draw).

    `edge` is the share of those before it. Later particles overwrite earlier ones that have no copy, and a running
    maximum fills in the further copies.
    """
    n = len(weight)
    ancestor, share, most = np.zeros(n + 1, dtype=np.uint32), n / total, np.float64(n)
    edge = 0.0
    for i in range(n - 1):
        edge += np.float64(weight[i])
        start = np.uint32(np.int64(min(np.ceil(edge * share - draw), most)))
        if weight[i + 1] > _F0:
            ancestor[start] = i + 1
    newest = np.uint32(0)
    for k in range(n):
        newest = max(newest, ancestor[k])
        ancestor[k] = newest
    return ancestor


@_compiled
def _take(state, ancestor, first, count, here):  # type: ignore[no-untyped-def]
    """The rows of particles `first` on, or of their ancestors."""
    if len(ancestor) == 0:
        here[:, :count] = state[:, first : first + count]
        return
    for row in range(5):
        for k in range(count):
            here[row, k] = state[row, ancestor[first + k]]


@_compiled
def _move(here, noise, told):  # type: ignore[no-untyped-def]
    """Move states (5, k) in place, with normals (4, k)."""
    dx, dy, position_sd, heading_sd, scale_sd = told[0], told[1], told[2], told[3], told[4]
    for k in range(here.shape[1]):
        turn = heading_sd * noise[2, k]
        square = turn * turn
        sine, cosine = turn - turn * square * _SIXTH, _F1 - square * _HALF + square * square * _TWENTY_FOURTH
        c = here[2, k] * cosine - here[3, k] * sine
        s = here[3, k] * cosine + here[2, k] * sine
        unit = _ONE_AND_HALF - _HALF * (c * c + s * s)
        c, s = c * unit, s * unit
        scale = here[4, k] + scale_sd * noise[3, k]
        here[0, k] += scale * (c * dx - s * dy) + position_sd * noise[0, k]
        here[1, k] += scale * (s * dx + c * dy) + position_sd * noise[1, k]
        here[2, k], here[3, k], here[4, k] = c, s, scale


@_compiled
def _place(here, place, share, table):  # type: ignore[no-untyped-def]
    """The number (k,) of the cell below left, and shares (3, k) of the way to the next; the third is 1 on the map."""
    ny, nx = table.record.shape[0], table.record.shape[1]
    right, top = np.float32(nx - 1), np.float32(ny - 1)
    last_i, last_j, row = np.int32(nx - 2), np.int32(ny - 2), np.int32(nx)
    for k in range(here.shape[1]):
        u, v = (here[0, k] - table.x0_m) * table.cells_per_m, (here[1, k] - table.y0_m) * table.cells_per_m
        share[2, k] = _F1 if (u >= _F0) & (u <= right) & (v >= _F0) & (v <= top) else _F0
        u, v = min(max(u, _F0), right), min(max(v, _F0), top)
        i, j = min(np.int32(u), last_i), min(np.int32(v), last_j)
        place[k] = np.int32(j * row + i)
        share[0, k], share[1, k] = u - np.float32(i), v - np.float32(j)


@_compiled
def _look_up(place, share, found, record, row):  # type: ignore[no-untyped-def]
    """Fill found (k, 4): the record (flat, its rows `row` apart) between the four cells around each place."""
    for k in range(place.shape[0]):
        fu, fv = share[0, k], share[1, k]
        a, b = (_F1 - fu) * (_F1 - fv), fu * (_F1 - fv)
        c, d = (_F1 - fu) * fv, fu * fv
        p = _FOUR * np.uint64(place[k])
        q, r, s = p + _FOUR, p + row, p + row + _FOUR  # written out: four at a time become one vector
        found[k, 0] = (a * record[p] + b * record[q]) + (c * record[r] + d * record[s])
        found[k, 1] = (a * record[p + _U1] + b * record[q + _U1]) + (c * record[r + _U1] + d * record[s + _U1])
        found[k, 2] = (a * record[p + _U2] + b * record[q + _U2]) + (c * record[r + _U2] + d * record[s + _U2])
        found[k, 3] = (a * record[p + _U3] + b * record[q + _U3]) + (c * record[r + _U3] + d * record[s + _U3])


@_compiled
def _fit(here, found, share, fit, told):  # type: ignore[no-untyped-def]
    """Log likelihood (k,) up to a constant, and infinity where nobody measured. Uses up the first rows of share."""
    bx, by, bz, sensor = told[5], told[6], told[7], told[8]
    for k in range(here.shape[1]):
        c, s = here[2, k], here[3, k]
        x, y, z = found[k, 0] - (c * bx - s * by), found[k, 1] - (s * bx + c * by), found[k, 2] - bz
        share[0, k], share[1, k] = x * x + y * y + z * z, found[k, 3] + sensor
    for k in range(here.shape[1]):  # apart, for this one becomes vectors
        variance = share[1, k]
        known = -_HALF * (share[0, k] / variance + _F3 * log_of(variance))
        known = known if variance < UNMAPPED_UT2 else _UNKNOWN
        fit[k] = known if share[2, k] > _F0 else _UNKNOWN


@_compiled
def _weigh(weight, new_weight, greatest, equal):  # type: ignore[no-untyped-def]
    """From log likelihoods to weights up to a constant, in place: the unmapped by the mean likelihood of the mapped."""
    n = len(new_weight)
    before, after, unknown = 0.0, 0.0, np.float32(-1.0)
    for i in range(n):
        off = new_weight[i] - greatest
        likely = exp_of(min(off, _F0)) if off > _LOST else _F0
        new_weight[i] = unknown if new_weight[i] == _UNKNOWN else likely
    if not equal:
        for i in range(n):
            new_weight[i] = new_weight[i] * weight[i] if new_weight[i] >= _F0 else -weight[i]
    before, after = _shares(new_weight, weight, equal)
    mean = np.float32(after / before) if before > 0.0 else _F1
    for i in range(n):
        new_weight[i] = new_weight[i] if new_weight[i] >= _F0 else -mean * new_weight[i]


@_reordered
def _shares(new_weight, weight, equal):  # type: ignore[no-untyped-def]
    """The mapped particles' weights before and after, summed; new weights of the others are below zero."""
    before, after = 0.0, 0.0
    for i in range(len(new_weight)):
        old = _F1 if equal else weight[i]
        before += np.float64(old if new_weight[i] >= _F0 else _F0)
        after += np.float64(max(new_weight[i], _F0))
    return before, after


@_reordered
def _total(weight):  # type: ignore[no-untyped-def]
    total, squares = 0.0, 0.0
    for i in range(len(weight)):
        w = np.float64(weight[i])
        total += w
        squares += w * w
    return total, squares


@_reordered
def _sums(moved, weight):  # type: ignore[no-untyped-def]
    """(12,) sums of w, w times each row, w x x, w x y, w y y, w w; x and y are about the first particle's, the last."""
    x0, y0 = np.float64(moved[0, 0]), np.float64(moved[1, 0])
    s0 = s1 = s2 = s3 = s4 = s5 = s6 = s7 = s8 = s9 = 0.0
    for i in range(len(weight)):
        w, x, y = np.float64(weight[i]), np.float64(moved[0, i]) - x0, np.float64(moved[1, i]) - y0
        s0 += w
        s1 += w * x
        s2 += w * y
        s3 += w * np.float64(moved[2, i])
        s4 += w * np.float64(moved[3, i])
        s5 += w * np.float64(moved[4, i])
        s6 += w * x * x
        s7 += w * x * y
        s8 += w * y * y
        s9 += w * w
    return np.array([s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, x0, y0])
