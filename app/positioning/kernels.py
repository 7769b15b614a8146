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

__all__ = ["Scene", "pose_cost", "record_of", "plain_bound", "to_sensor"]


class Scene(NamedTuple):
    """A plane, a window and its errors, as the compiled loops need them; samples in the order they are compared in.

    mean, variance    (ny + 2, nx + 2, c) and (ny + 2, nx + 2): the field, with one cell of prior around
    records, codes, places   of the pyramid; codes are the records' bytes
    walkable          (ny + 1, nx + 1) summed-area table of cells the last sample may be in, or (0, 0): all
    noise             (n,) variance of the samples over the map's share
    kind              (n,) which ladder a sample uses
    ladder            (kinds, steps, 3) inflated variances v: c v, 1 / v and c log(v / v_min)
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
    walkable: NDArray[np.int64]
    noise: Array
    kind: NDArray[np.int64]
    ladder: Array
    inflation: float
    least: float
    prior: Array
    turn: Array
    headed: bool
    offset: tuple[bool, float, float, float]


@numba.njit(cache=True, nogil=True, inline="always")
def record_of(j, i, l, places):  # type: ignore[no-untyped-def]
    """Index of the record that covers the square of level l (from one) at (j, i)."""
    base, shift = places[l - 1, 0], places[l - 1, 1]
    height, width = places[l - 1, 2], places[l - 1, 3]
    a = min(max((j + base) >> shift, 0), height - 1)
    b = min(max((i + base) >> shift, 0), width - 1)
    return places[l - 1, 4] + a * width + b


@numba.njit(cache=True, nogil=True, inline="always")
def _term(squared, low, high, ladder, c):  # type: ignore[no-untyped-def]
    """Smallest squared / v + c log(v / v_min) over the variances between two steps of `ladder` (steps, 3)."""
    if squared >= ladder[high, 0]:
        return squared * ladder[high, 1] + ladder[high, 2]
    if squared <= ladder[low, 0]:
        return squared * ladder[low, 1] + ladder[low, 2]
    return c * (1.0 + math.log(squared / ladder[0, 0]))


@numba.njit(cache=True, nogil=True)
def plain_bound(g, j, i, level, place, feature, scene, cost, stop):  # type: ignore[no-untyped-def]
    """`cost` plus the bound of the block at (j, i), given up as soon as it exceeds `stop`; and the samples compared."""
    n, c = feature.shape[1], feature.shape[2] // 2
    records, codes, places, kind, ladder = scene.records, scene.codes, scene.places, scene.kind, scene.ladder
    for k in range(n):
        at = record_of(j + place[g, k, 0], i + place[g, k, 1], max(place[g, k, 2], level), places)
        squared = 0.0
        for m in range(c):
            d = max(max(feature[g, k, m] - records[at, c + m], records[at, m] - feature[g, k, c + m]), 0.0)
            squared += d * d
        cost += _term(squared, codes[at, 8 * c], codes[at, 8 * c + 1], ladder[kind[k]], c)
        if cost > stop:
            return cost, k + 1
    return cost, n


@numba.njit(cache=True, nogil=True, inline="always")
def to_sensor(x, y, z, turn, k):  # type: ignore[no-untyped-def]
    """A residual in the sensor's axes at sample k."""
    return (
        turn[k, 0, 0] * x + turn[k, 0, 1] * y + turn[k, 0, 2] * z,
        turn[k, 1, 0] * x + turn[k, 1, 1] * y + turn[k, 1, 2] * z,
        turn[k, 2, 0] * x + turn[k, 2, 1] * y + turn[k, 2, 2] * z,
    )


@numba.njit(cache=True, nogil=True)
def pose_cost(g, j, i, place, feature, heading, scene, cost, stop):  # type: ignore[no-untyped-def]
    """`cost` plus that of the pose of course g whose middle sample is in cell (j, i), given up beyond `stop`; and the
    samples compared."""
    n, c = feature.shape[1], feature.shape[2] // 2
    mean, variance = scene.mean, scene.variance
    ny, nx = mean.shape[0] - 2, mean.shape[1] - 2
    has_offset, precision, relative, least = scene.offset
    gx, gy, gz, ry, rz = 0.0, 0.0, 0.0, 0.0, 0.0
    squares, total = 0.0, precision
    if has_offset:
        cost += least
    for k in range(n):
        a = min(max(j + place[g, k, 0] + 1, 0), ny + 1)
        b = min(max(i + place[g, k, 1] + 1, 0), nx + 1)
        v = variance[a, b] + scene.noise[k]
        w = 1.0 / (scene.inflation * v)
        rx = feature[g, k, 0] - mean[a, b, 0]
        if c > 1:
            ry = feature[g, k, 1] - mean[a, b, 1]
        if c > 2:
            rz = feature[g, k, 2] - mean[a, b, 2]
        squares += w * (rx * rx + ry * ry + rz * rz)
        cost += c * math.log(v / (scene.least + scene.noise[k]))
        apart = squares
        if has_offset:
            if scene.headed:
                rx, ry = heading[g, 0] * rx + heading[g, 1] * ry, heading[g, 0] * ry - heading[g, 1] * rx
            x, y, z = to_sensor(rx, ry, rz, scene.turn, k)
            gx, gy, gz = gx + w * x, gy + w * y, gz + w * z
            total += w
            apart -= (gx * gx + gy * gy + gz * gz) / total
        if cost + apart > stop:
            return cost + apart, k + 1
    if has_offset:
        return cost - least + max(apart, 0.0) + c * math.log(total / relative), n
    return cost + apart, n
