"""Compiled inner loops of the search: the cost of a pose and the bound of a node of the tree.

cost = -2 log L + constant = sum_i [|z_i - m_i|^2 / (f v_i) + c log(v_i / v_min)] + prior terms, v_i the variance of the
cell and the sensor, f the inflation that stands for errors alike along the walk. With a constant offset b of the sensor
integrated out under a Gaussian prior of precision p (zero: flat), and residuals r_i turned to the sensor's axes,
    min_b sum_i w_i |r_i - b|^2 + p |b|^2  =  sum w_i |r_i|^2 - |sum w_i r_i|^2 / (sum w_i + p),   w_i = 1 / (f v_i),
and a term c log(sum w_i + p).

A node holds the poses of a group of courses whose middle sample is in a block of 2^l x 2^l cells. For every sample the
map's values over the displaced block lie in a box, and so do the turned features of the group: residuals lie in a box.
Without an offset the bound takes the squared distance of that box from zero, at the variance of the block's range that
makes the term smallest: every operation is monotone. With an offset see `offset_bound`.
"""

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from app.geometry import Array

__all__ = [
    "NOTHING",
    "ROUNDING",
    "SLACK",
    "Scene",
    "limit_of",
    "plain_bounds",
    "pose_costs",
    "record_of",
    "spare_cost",
    "to_sensor",
]

SLACK = 2e-6  # relative: what rounding to single precision may add to the terms of a bound
ROUNDING = 1e-9  # relative: what rounding to double precision may add to a bound
LEFT_OUT = 3e-5  # mass relative to the best pose that a node may hold that is left out
NOTHING = np.float32(0.0)


class Scene(NamedTuple):
    """A plane, a window and its errors, as the compiled loops need them; samples in the order they are compared in.

    mean, variance    (ny + 2, nx + 2, c) and (ny + 2, nx + 2): the field, with one cell of prior around
    records, codes, places   of the pyramid; codes are the records' bytes
    doubling          of the pyramid: the squares that are blocks
    walkable          (ny + 1, nx + 1) summed-area table of cells the last sample may be in, or (0, 0): all
    noise             (n,) variance of the samples over the map's share
    kind              (n,) which ladder a sample uses
    ladder            (kinds, steps, 3) inflated variances v: c v, 1 / v and c log(v / v_min)
    constant          turns a cost into -2 score, which is comparable between planes
    inflation, least  f times the map's share, and the map's least variance
    prior             (3,) expected cell of the last sample (row, column), cost per squared cell
    turn              (n, 3, 3) rotation of the building's axes to the sensor's, up to the course's heading
    headed            whether the course's heading matters to it: it does not where all turns are about the vertical
    offset            whether there is one, precision of its prior, weight its logarithm is relative to, least of that
    """

    mean: NDArray[np.float32]
    variance: NDArray[np.float32]
    records: NDArray[np.float32]
    codes: NDArray[np.uint8]
    places: NDArray[np.int64]
    doubling: NDArray[np.int64]
    walkable: NDArray[np.int64]
    noise: Array
    kind: NDArray[np.int64]
    ladder: Array
    constant: float
    inflation: float
    least: float
    prior: Array
    turn: Array
    headed: bool
    offset: tuple[bool, float, float, float]


@numba.njit(cache=True, nogil=True, inline="always")
def spare_cost(level, mean):  # type: ignore[no-untyped-def]
    """Twice the nats below the best pose at which all cells of a block together hold a mass of `LEFT_OUT`."""
    side = 1 << level
    return 2.0 * math.log(min(side, mean.shape[0] - 2) * min(side, mean.shape[1] - 2) / LEFT_OUT)


@numba.njit(cache=True, nogil=True, inline="always")
def limit_of(size, spare, best, window):  # type: ignore[no-untyped-def]
    """The bound beyond which a node is left out: its poses are outside the window of the best pose, and all of them
    together hold next to no mass. `size`: twice the log of the number of its courses."""
    return best + max(window, size + spare)


@numba.njit(cache=True, nogil=True, inline="always")
def record_of(j, i, square, places):  # type: ignore[no-untyped-def]
    """Index of the record that covers the square at (j, i) of those with index square."""
    base, shift = places[square, 0], places[square, 1]
    height, width = places[square, 2], places[square, 3]
    a = min(max((j + base) >> shift, 0), height - 1)
    b = min(max((i + base) >> shift, 0), width - 1)
    return places[square, 4] + a * width + b


@numba.njit(cache=True, nogil=True, inline="always")
def _term(squared, low, high, ladder, kind, c):  # type: ignore[no-untyped-def]
    """Smallest squared / v + c log(v / v_min) over the variances between two steps of a ladder."""
    if squared >= ladder[kind, high, 0]:
        return squared * ladder[kind, high, 1] + ladder[kind, high, 2]
    if squared <= ladder[kind, low, 0]:
        return squared * ladder[kind, low, 1] + ladder[kind, low, 2]
    return c * (1.0 + math.log(squared / ladder[kind, 0, 0]))


@numba.njit(cache=True, nogil=True, fastmath={"nnan", "nsz"})
def plain_bounds(nodes, costs, level, tree, scene, best, window):  # type: ignore[no-untyped-def]
    """Add to the prior costs (k,) of nodes (k, 3) what their poses cost at least, given up beyond their `limit_of`.

    Returns how many samples were compared.
    """
    place, feature, kind, ladder = tree.place, tree.feature, scene.kind, scene.ladder
    records, codes, places = scene.records, scene.codes, scene.places
    n, c = feature.shape[1], feature.shape[2] // 2
    spare, square = spare_cost(level, scene.mean), scene.doubling[level]
    prior_costs, stops = costs.copy(), np.empty(len(nodes))
    followed, count = np.arange(len(nodes)), len(nodes)
    for p in range(count):
        stops[p] = limit_of(tree.size[nodes[p, 0]], spare, best, window)
    work = 0
    for k in range(n):  # sample after sample, so that lookups do not wait for what the node before comes to
        work += count
        left = 0
        for q in range(count):
            p = followed[q]
            g = nodes[p, 0]
            j, i = nodes[p, 1] + place[g, k, 0], nodes[p, 2] + place[g, k, 1]
            at = record_of(j, i, max(place[g, k, 2], square), places)
            if c == 3:
                x = max(max(feature[g, k, 0] - records[at, 3], records[at, 0] - feature[g, k, 3]), NOTHING)
                y = max(max(feature[g, k, 1] - records[at, 4], records[at, 1] - feature[g, k, 4]), NOTHING)
                z = max(max(feature[g, k, 2] - records[at, 5], records[at, 2] - feature[g, k, 5]), NOTHING)
                squared = x * x + y * y + z * z
            else:
                squared = NOTHING
                for m in range(c):
                    x = max(max(feature[g, k, m] - records[at, c + m], records[at, m] - feature[g, k, c + m]), NOTHING)
                    squared += x * x
            costs[p] += _term(squared, codes[at, 8 * c], codes[at, 8 * c + 1], ladder, kind[k], c)
            followed[left] = p
            left += costs[p] <= stops[p]
        count = left
        if not count:
            break
    for p in range(len(nodes)):
        costs[p] -= SLACK * (1.0 + costs[p] - prior_costs[p]) + ROUNDING * abs(costs[p])
    return work


@numba.njit(cache=True, nogil=True, inline="always")
def to_sensor(x, y, z, turn, k):  # type: ignore[no-untyped-def]
    """A residual in the sensor's axes at sample k."""
    return (
        turn[k, 0, 0] * x + turn[k, 0, 1] * y + turn[k, 0, 2] * z,
        turn[k, 1, 0] * x + turn[k, 1, 1] * y + turn[k, 1, 2] * z,
        turn[k, 2, 0] * x + turn[k, 2, 1] * y + turn[k, 2, 2] * z,
    )


@numba.njit(cache=True, nogil=True)
def pose_costs(nodes, costs, tree, scene, best, window):  # type: ignore[no-untyped-def]
    """Add to the prior costs (k,) of poses (k, 3) (course, cell of the middle sample) their own, given up
    beyond their `limit_of`.

    Returns as `plain_bounds`.
    """
    place, feature, heading = tree.place, tree.exact, tree.heading
    mean, variance, turn, noise = scene.mean, scene.variance, scene.turn, scene.noise
    n, c = feature.shape[1], feature.shape[2]
    ny, nx = mean.shape[0] - 2, mean.shape[1] - 2
    has_offset, precision, relative, least = scene.offset
    ry, rz = 0.0, 0.0
    stop = limit_of(0.0, spare_cost(0, mean), best, window)
    floor = scene.least + noise
    work = 0
    for p in range(len(nodes)):
        g, j, i, cost = nodes[p, 0], nodes[p, 1], nodes[p, 2], costs[p]
        gx, gy, gz, squares, apart, total, ratios = 0.0, 0.0, 0.0, 0.0, 0.0, precision, 1.0
        if has_offset:
            cost += least
        for k in range(n):
            a = min(max(j + place[g, k, 0] + 1, 0), ny + 1)
            b = min(max(i + place[g, k, 1] + 1, 0), nx + 1)
            v = variance[a, b] + noise[k]
            w = 1.0 / (scene.inflation * v)
            rx = feature[g, k, 0] - mean[a, b, 0]
            if c > 1:
                ry = feature[g, k, 1] - mean[a, b, 1]
            if c > 2:
                rz = feature[g, k, 2] - mean[a, b, 2]
            squares += w * (rx * rx + ry * ry + rz * rz)
            ratios *= v / floor[k]
            if ratios > 1e200:
                cost, ratios = cost + c * math.log(ratios), 1.0
            apart = squares
            if has_offset:
                if scene.headed:
                    rx, ry = heading[g, 0] * rx + heading[g, 1] * ry, heading[g, 0] * ry - heading[g, 1] * rx
                x, y, z = to_sensor(rx, ry, rz, turn, k)
                gx, gy, gz = gx + w * x, gy + w * y, gz + w * z
                total += w
                apart = max(squares - (gx * gx + gy * gy + gz * gz) / total, 0.0)
            work += 1
            if cost + apart > stop:
                break
        cost += c * math.log(ratios)
        if has_offset and cost + apart <= stop:
            cost += c * math.log(total / relative) - least
        costs[p] = cost + apart
    return work
