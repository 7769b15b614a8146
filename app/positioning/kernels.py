"""Compiled inner loops of the search: the cost of a pose and the bound of a block of poses.

cost = -2 log L + constant = sum_i sum_c [(z_ic - m_ic)^2 / v_ic + log(v_ic / v_min,c)] + prior terms. With a constant
offset b integrated out under a flat prior (demeaned), per component
    cost_c = min_b sum_i (r_i - b)^2 / v_i + sum_i log(v_i / v_min,i) + log sum_i (v_ref / v_i),     r_i = z_i - m_i.

A block holds 2^l x 2^l poses of one heading. Its bound takes for every sample the interval of the map over the
displaced block: the squared distance of the sample to that interval, at the variance of the block's range that makes
the term smallest. Every operation is monotone, so the bound of a block never exceeds the cost of a pose in it.
Demeaned, the intervals of r_i shift together: the smallest sum of squared distances to them over one common offset is
a convex problem in one unknown, and a tangent certifies its value from below.
"""

import math

import numba
import numpy as np

__all__ = ["block_bounds", "pose_costs"]

_SLACK = 1e-9  # relative: what rounding may add to a bound


@numba.njit(cache=True, nogil=True, inline="always")
def _term(squared, low, high, ladder):  # type: ignore[no-untyped-def]
    """Smallest squared / v + log(v / v_min) over the variances between two steps of `ladder` (steps, 2)."""
    v_high = ladder[high, 0]
    if squared >= v_high:
        return squared / v_high + ladder[high, 1]
    v_low = ladder[low, 0]
    if squared <= v_low:
        return squared / v_low + ladder[low, 1]
    return 1.0 + math.log(squared / ladder[0, 0])


@numba.njit(cache=True, nogil=True, inline="always")
def _record(j, i, base, shift, height, width):  # type: ignore[no-untyped-def]
    """Index of the record that covers the square at (j, i)."""
    a = min(max((j + base) >> shift, 0), height - 1)
    b = min(max((i + base) >> shift, 0), width - 1)
    return a * width + b


@numba.njit(cache=True, nogil=True)
def _raw_bound(j, i, z, row, column, kind, ladder, level, records, codes, cost, stop):  # type: ignore[no-untyped-def]
    """`cost` plus the bound of the block at (j, i); given up as soon as it exceeds `stop`."""
    n, c = z.shape
    base, shift, height, width = level
    for k in range(n):
        at = _record(j + row[k], i + column[k], base, shift, height, width)
        for m in range(c):
            d = max(max(z[k, m] - records[at, c + m], records[at, m] - z[k, m]), 0.0)
            cost += _term(d * d, codes[at, 8 * c + m], codes[at, 9 * c + m], ladder[kind[k], m])
        if cost > stop:
            return cost
    return cost


@numba.njit(cache=True, nogil=True)
def _raw_cost(ny, nx, j, i, z, row, column, noise, floor_variance, mean, variance, cost, stop):  # type: ignore[no-untyped-def]
    """`cost` plus the cost of the pose at (j, i), given up beyond `stop`. Arrays carry one cell of prior around."""
    n, c = z.shape
    for k in range(n):
        a = min(max(j + row[k] + 1, 0), ny + 1)
        b = min(max(i + column[k] + 1, 0), nx + 1)
        ratio = 1.0
        for m in range(c):
            v = variance[a, b, m] + noise[k]
            r = z[k, m] - mean[a, b, m]
            cost += r * r / v
            ratio *= v / (floor_variance[m] + noise[k])
        cost += math.log(ratio)
        if cost > stop:
            return cost
    return cost


@numba.njit(cache=True, nogil=True)
def _least_spread(low, high, weight, n):  # type: ignore[no-untyped-def]
    """A certified lower bound of min_b sum_k weight_k dist(b, [low_k, high_k])^2, tight to rounding."""
    left, right = high[0], low[0]
    for k in range(1, n):
        left, right = min(left, high[k]), max(right, low[k])
    if right <= left:  # one offset lies in every interval
        return 0.0
    offset, best = 0.5 * (left + right), 0.0
    for _ in range(24):
        value, slope, curvature = 0.0, 0.0, 0.0
        for k in range(n):
            d = max(offset - high[k], 0.0) - max(low[k] - offset, 0.0)
            if d != 0.0:
                value += weight[k] * d * d
                slope += weight[k] * d
                curvature += weight[k]
        if slope > 0.0:
            right = offset
        else:
            left = offset
        best = max(best, value - 2.0 * abs(slope) * (right - left))
        step = offset - slope / curvature if curvature > 0.0 else offset
        if value - best <= 0.02 * value or abs(step - offset) <= 1e-12 * (1.0 + abs(offset)):
            break
        offset = step if left < step < right else 0.5 * (left + right)
    return best


@numba.njit(cache=True, nogil=True)
def _demeaned_bound(j, i, z, row, column, kind, ladder, level, records, codes, cost, stop, scratch):  # type: ignore[no-untyped-def]
    """The bound of a block with an offset per component integrated out, compared with `stop` now and then."""
    n, c = z.shape
    base, shift, height, width = level
    low, high, weight, ratios = scratch[0], scratch[1], scratch[2], scratch[3, :, 0]
    logs = 0.0
    ratios[:] = 0.0
    check, total = 3, cost
    for k in range(n):
        at = _record(j + row[k], i + column[k], base, shift, height, width)
        for m in range(c):
            steps = ladder[kind[k], m]
            low[m, k], high[m, k] = z[k, m] - records[at, c + m], z[k, m] - records[at, m]
            weight[m, k] = 1.0 / steps[codes[at, 9 * c + m], 0]
            logs += steps[codes[at, 8 * c + m], 1]
            ratios[m] += ladder[0, m, 0, 0] * weight[m, k]
        if k + 1 == check or k + 1 == n:
            check *= 2
            total = cost + logs
            for m in range(c):
                total += _least_spread(low[m], high[m], weight[m], k + 1) + math.log(ratios[m])
            if total > stop:
                return total
    return total


@numba.njit(cache=True, nogil=True)
def _demeaned_cost(ny, nx, j, i, z, row, column, noise, floor_variance, mean, variance, cost):  # type: ignore[no-untyped-def]
    """`cost` plus the cost of a pose with an offset per component integrated out."""
    n, c = z.shape
    least_noise = noise.min()
    for m in range(c):
        sum_w, sum_wr, sum_wrr, ratio = 0.0, 0.0, 0.0, 0.0
        for k in range(n):
            a = min(max(j + row[k] + 1, 0), ny + 1)
            b = min(max(i + column[k] + 1, 0), nx + 1)
            v = variance[a, b, m] + noise[k]
            r = z[k, m] - mean[a, b, m]
            least = floor_variance[m] + noise[k]
            sum_w += 1.0 / v
            sum_wr += r / v
            sum_wrr += r * r / v
            ratio += (floor_variance[m] + least_noise) / v
            cost += math.log(v / least)
        cost += max(sum_wrr - sum_wr * sum_wr / sum_w, 0.0) + math.log(ratio)
    return cost


@numba.njit(cache=True, nogil=True, inline="always")
def _distance_cost(j, i, side, prior):  # type: ignore[no-untyped-def]
    """Least prior cost of a block: `prior` = (row, column, weight) of the expected cell, weight per squared cell."""
    dj = max(max(j - prior[0], prior[0] - (j + side - 1)), 0.0)
    di = max(max(i - prior[1], prior[1] - (i + side - 1)), 0.0)
    return prior[2] * (dj * dj + di * di)


@numba.njit(cache=True, nogil=True)
def pose_costs(  # type: ignore[no-untyped-def]
    poses, demeaned, z, row, column, noise, floor_variance, mean, variance, heading_cost, prior, stop
):
    """Costs (p,) of poses (p, 3) given as (heading, row, column); beyond `stop` only a lower bound of the cost."""
    ny, nx = mean.shape[0] - 2, mean.shape[1] - 2
    costs = np.empty(len(poses))
    for p in range(len(poses)):
        h, j, i = poses[p, 0], poses[p, 1], poses[p, 2]
        base = heading_cost[h] + _distance_cost(j, i, 1, prior)
        if demeaned:
            costs[p] = _demeaned_cost(
                ny, nx, j, i, z[h], row[h], column[h], noise, floor_variance, mean, variance, base
            )
        else:
            costs[p] = _raw_cost(
                ny, nx, j, i, z[h], row[h], column[h], noise, floor_variance, mean, variance, base, stop
            )
    return costs


@numba.njit(cache=True, nogil=True)
def block_bounds(  # type: ignore[no-untyped-def]
    blocks, side, demeaned, z, row, column, kind, ladder, level, records, codes, heading_cost, prior, stop
):
    """Lower bounds (p,) of the costs in blocks (p, 3) of (heading, first row, first column), given up beyond `stop`.

    ladder (kinds of noise, c, steps, 2) variances and their logs; level = (base, shift, height, width) of the records.
    """
    found, scratch = np.empty(len(blocks)), np.empty((4, z.shape[2], z.shape[1]))
    for p in range(len(blocks)):
        h, j, i = blocks[p, 0], blocks[p, 1], blocks[p, 2]
        base = heading_cost[h] + _distance_cost(j, i, side, prior)
        if demeaned:
            bound = _demeaned_bound(
                j, i, z[h], row[h], column[h], kind, ladder, level, records, codes, base, stop, scratch
            )
        else:
            bound = _raw_bound(j, i, z[h], row[h], column[h], kind, ladder, level, records, codes, base, stop)
        found[p] = bound - _SLACK * (1.0 + abs(bound))
    return found
