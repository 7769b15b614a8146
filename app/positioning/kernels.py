"""Compiled inner loops of the search: the cost of a pose and the bound of a block of poses.

cost = -2 log L + constant = sum_i [|z_i - m_i|^2 / (f v_i) + c log(v_i / v_min)] + prior terms, v_i the variance of the
cell and the sensor, f the inflation that stands for errors alike along the walk. With a constant offset b of the sensor
integrated out under a Gaussian prior of precision p (zero: flat), and residuals r_i turned to the sensor's axes,
    min_b sum_i |r_i - b|^2 / (f v_i) + p |b|^2  =  sum w_i |r_i|^2 - |sum w_i r_i|^2 / (sum w_i + p),   w_i = 1 / (f v_i),
and a term c log(sum w_i + p).

A block holds 2^l x 2^l poses of one course. Without an offset its bound takes for every sample the squared distance to
the box of map values over the displaced block, at the variance of the block's range that makes the term smallest: every
operation is monotone. With an offset the boxes shift together, so the bound takes residuals from the middles of the
boxes: the root of the cost above is a seminorm, no larger than that of the plain weighted sum, so by the triangle
inequality it falls short of the middle's by at most the root of the weighted sum of the boxes' squared half diagonals.
"""

import math

import numba
import numpy as np

__all__ = ["block_bounds", "pose_costs"]

_SLACK = 1e-9  # relative: what rounding may add to a bound


@numba.njit(cache=True, nogil=True, inline="always")
def _term(squared, low, high, ladder, c):  # type: ignore[no-untyped-def]
    """Smallest squared / v + c log(v / v_min) over the variances between two steps of `ladder` (steps, 2)."""
    v_high = ladder[high, 0]
    if squared >= c * v_high:
        return squared / v_high + ladder[high, 1]
    v_low = ladder[low, 0]
    if squared <= c * v_low:
        return squared / v_low + ladder[low, 1]
    return c * (1.0 + math.log(squared / (c * ladder[0, 0])))


@numba.njit(cache=True, nogil=True, inline="always")
def _record(j, i, base, shift, height, width):  # type: ignore[no-untyped-def]
    """Index of the record that covers the square at (j, i)."""
    a = min(max((j + base) >> shift, 0), height - 1)
    b = min(max((i + base) >> shift, 0), width - 1)
    return a * width + b


@numba.njit(cache=True, nogil=True)
def _plain_bound(j, i, z, row, column, kind, ladder, level, records, codes, cost, stop):  # type: ignore[no-untyped-def]
    """`cost` plus the bound of the block at (j, i); given up as soon as it exceeds `stop`."""
    n, c = z.shape
    base, shift, height, width = level
    for k in range(n):
        at = _record(j + row[k], i + column[k], base, shift, height, width)
        squared = 0.0
        for m in range(c):
            d = max(max(z[k, m] - records[at, c + m], records[at, m] - z[k, m]), 0.0)
            squared += d * d
        cost += _term(squared, codes[at, 8 * c], codes[at, 8 * c + 1], ladder[kind[k]], c)
        if cost > stop:
            return cost
    return cost


@numba.njit(cache=True, nogil=True)
def _plain_cost(ny, nx, j, i, z, row, column, noise, floor_variance, inflation, mean, variance, cost, stop):  # type: ignore[no-untyped-def]
    """`cost` plus the cost of the pose at (j, i), given up beyond `stop`. Arrays carry one cell of prior around."""
    n, c = z.shape
    for k in range(n):
        a = min(max(j + row[k] + 1, 0), ny + 1)
        b = min(max(i + column[k] + 1, 0), nx + 1)
        squared = 0.0
        for m in range(c):
            r = z[k, m] - mean[a, b, m]
            squared += r * r
        v = variance[a, b] + noise[k]
        cost += squared / (inflation * v) + c * math.log(v / (floor_variance + noise[k]))
        if cost > stop:
            return cost
    return cost


@numba.njit(cache=True, nogil=True, inline="always")
def _to_sensor(x, y, z, turn, tilt, k):  # type: ignore[no-untyped-def]
    """Turn a residual to the sensor's axes: by the yaw of sample k, then by its tilt if it has one."""
    x, y = turn[k, 0] * x + turn[k, 1] * y, turn[k, 0] * y - turn[k, 1] * x
    if len(tilt):
        return (
            tilt[k, 0, 0] * x + tilt[k, 0, 1] * y + tilt[k, 0, 2] * z,
            tilt[k, 1, 0] * x + tilt[k, 1, 1] * y + tilt[k, 1, 2] * z,
            tilt[k, 2, 0] * x + tilt[k, 2, 1] * y + tilt[k, 2, 2] * z,
        )
    return x, y, z


@numba.njit(cache=True, nogil=True)
def _offset_bound(  # type: ignore[no-untyped-def]
    j, i, z, row, column, turn, tilt, kind, ladder, offset, level, records, codes, cost, stop
):
    """The bound of a block with an offset integrated out, compared with `stop` sample after sample.

    Components that features of one or two do not have stay zero.
    """
    n, c = z.shape
    base, shift, height, width = level
    gx, gy, gz, ry, rz, half_y, half_z = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    squares, spread, total_weight = 0.0, 0.0, offset[1]
    logs = cost + offset[3]
    for k in range(n):
        at = _record(j + row[k], i + column[k], base, shift, height, width)
        low, high = records[at, 0], records[at, c]
        rx, half_x = z[k, 0] - 0.5 * (high + low), 0.5 * (high - low)
        if c > 1:
            low, high = records[at, 1], records[at, c + 1]
            ry, half_y = z[k, 1] - 0.5 * (high + low), 0.5 * (high - low)
        if c > 2:
            low, high = records[at, 2], records[at, c + 2]
            rz, half_z = z[k, 2] - 0.5 * (high + low), 0.5 * (high - low)
        w = 1.0 / ladder[kind[k], codes[at, 8 * c + 1], 0]
        logs += ladder[kind[k], codes[at, 8 * c], 1]
        x, y, up = _to_sensor(rx, ry, rz, turn, tilt, k)
        gx, gy, gz = gx + w * x, gy + w * y, gz + w * up
        squares += w * (rx * rx + ry * ry + rz * rz)
        spread += w * (half_x * half_x + half_y * half_y + half_z * half_z)
        total_weight += w
        room = stop - logs
        if room < 0.0:
            return logs
        apart = squares - (gx * gx + gy * gy + gz * gz) / total_weight
        if apart > spread + room + 2.0 * math.sqrt(spread * room):
            short = math.sqrt(apart) - math.sqrt(spread)
            return logs + short * short
    logs += c * math.log(total_weight / offset[2]) - offset[3]
    short = math.sqrt(max(squares - (gx * gx + gy * gy + gz * gz) / total_weight, 0.0)) - math.sqrt(spread)
    return logs + short * short if short > 0.0 else logs


@numba.njit(cache=True, nogil=True)
def _offset_cost(  # type: ignore[no-untyped-def]
    ny, nx, j, i, z, row, column, turn, tilt, noise, floor_variance, inflation, offset, mean, variance, cost, stop
):
    """`cost` plus the cost of a pose with an offset integrated out, given up beyond `stop`."""
    n, c = z.shape
    gx, gy, gz, ry, rz = 0.0, 0.0, 0.0, 0.0, 0.0
    squares, total_weight = 0.0, offset[1]
    for k in range(n):
        a = min(max(j + row[k] + 1, 0), ny + 1)
        b = min(max(i + column[k] + 1, 0), nx + 1)
        v = variance[a, b] + noise[k]
        w = 1.0 / (inflation * v)
        rx = z[k, 0] - mean[a, b, 0]
        if c > 1:
            ry = z[k, 1] - mean[a, b, 1]
        if c > 2:
            rz = z[k, 2] - mean[a, b, 2]
        x, y, up = _to_sensor(rx, ry, rz, turn, tilt, k)
        gx, gy, gz = gx + w * x, gy + w * y, gz + w * up
        squares += w * (rx * rx + ry * ry + rz * rz)
        total_weight += w
        cost += c * math.log(v / (floor_variance + noise[k]))
        apart = squares - (gx * gx + gy * gy + gz * gz) / total_weight
        if cost + offset[3] + apart > stop:
            return cost + offset[3] + apart
    apart = squares - (gx * gx + gy * gy + gz * gz) / total_weight
    return cost + max(apart, 0.0) + c * math.log(total_weight / offset[2])


@numba.njit(cache=True, nogil=True, inline="always")
def _distance_cost(j, i, side, prior):  # type: ignore[no-untyped-def]
    """Least prior cost of a block: `prior` = (row, column, weight) of the expected cell, weight per squared cell."""
    dj = max(max(j - prior[0], prior[0] - (j + side - 1)), 0.0)
    di = max(max(i - prior[1], prior[1] - (i + side - 1)), 0.0)
    return prior[2] * (dj * dj + di * di)


@numba.njit(cache=True, nogil=True)
def pose_costs(  # type: ignore[no-untyped-def]
    poses, offset, z, row, column, turn, tilt, noise, floor_variance, inflation, mean, variance, course_cost, prior,
    stop
):  # fmt: skip
    """Costs (p,) of poses (p, 3) given as (course, row, column); beyond `stop` only a lower bound of the cost.

    offset = (whether there is one, precision of its prior, weight its logarithm is relative to, least of that term)
    """
    ny, nx = mean.shape[0] - 2, mean.shape[1] - 2
    costs = np.empty(len(poses))
    for p in range(len(poses)):
        h, j, i = poses[p, 0], poses[p, 1], poses[p, 2]
        base = course_cost[h] + _distance_cost(j, i, 1, prior)
        if offset[0] > 0.0:
            costs[p] = _offset_cost(
                ny, nx, j, i, z[h], row[h], column[h], turn[h], tilt, noise, floor_variance, inflation, offset, mean,
                variance, base, stop
            )  # fmt: skip
        else:
            costs[p] = _plain_cost(
                ny, nx, j, i, z[h], row[h], column[h], noise, floor_variance, inflation, mean, variance, base, stop
            )
    return costs


@numba.njit(cache=True, nogil=True)
def block_bounds(  # type: ignore[no-untyped-def]
    blocks, side, offset, z, row, column, turn, tilt, kind, ladder, level, records, codes, course_cost, prior, stop
):
    """Lower bounds (p,) of the costs in blocks (p, 3) of (course, first row, first column), given up beyond `stop`.

    ladder (kinds of noise, steps, 2) inflated variances and c times their logs; level = (base, shift, height, width) of
    the records; offset as in `pose_costs`.
    """
    found = np.empty(len(blocks))
    for p in range(len(blocks)):
        h, j, i = blocks[p, 0], blocks[p, 1], blocks[p, 2]
        base = course_cost[h] + _distance_cost(j, i, side, prior)
        if offset[0] > 0.0:
            bound = _offset_bound(
                j, i, z[h], row[h], column[h], turn[h], tilt, kind, ladder, offset, level, records, codes, base, stop
            )
        else:
            bound = _plain_bound(j, i, z[h], row[h], column[h], kind, ladder, level, records, codes, base, stop)
        found[p] = bound - _SLACK * (1.0 + abs(bound))
    return found
