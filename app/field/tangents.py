"""Planes through a gridded field over the squares of its pyramid, with what the field differs from them by at most.

Over a square a smooth field is its tangent plane and a remainder that shrinks with the square of the side, where its
range shrinks with the side alone: bounds that keep the plane know far more of the field than its least and largest value.
"""

import numba
import numpy as np
from numpy.typing import NDArray

__all__ = ["FLAT_SIDE", "TANGENT_WIDTH", "tangents"]

Float32 = NDArray[np.float32]

FLAT_SIDE = 7  # squares up to this have no planes: the range says enough
TANGENT_WIDTH = 12  # of a record: (value, slope along rows, slope along columns, remainder) of three components


def tangents(
    mean_uT: Float32, whole: Float32, places: NDArray[np.int64]
) -> tuple[Float32, NDArray[np.int64]]:
    """Records (k, TANGENT_WIDTH) of the levels above `FLAT_SIDE` in the order of `places`, then one of everything.

    mean_uT (ny + 2, nx + 2, c) carries one cell of prior; whole (2 c,) least and largest values. A record holds, per
    component, the value in the middle of the square that the pyramid's record covers, the slopes per cell, and the
    largest difference from that plane. Returns also where each level begins, -1 where there are none.
    """
    c = mean_uT.shape[2]
    first = np.full(len(places), -1, dtype=np.int64)
    parts: list[Float32] = []
    start = 0
    for l, (base, shift, height, width, _, side) in enumerate(places[:-1].tolist()):
        if side > FLAT_SIDE:
            first[l] = start
            parts.append(_fit(mean_uT, base, 1 << shift, side + (1 << shift) - 1, height, width))
            start += height * width
    first[-1] = start
    everything = np.zeros((1, TANGENT_WIDTH), dtype=np.float32)
    everything[0, :c], everything[0, 9 : 9 + c] = 0.5 * (whole[:c] + whole[c:]), 0.5 * (whole[c:] - whole[:c]) * (1 + 1e-5) + 1e-5
    parts.append(everything)
    return np.concatenate(parts), first


@numba.njit(cache=True, nogil=True)
def _fit(mean, base, step, side, height, width):  # type: ignore[no-untyped-def]
    ny, nx, c = mean.shape
    records = np.zeros((height * width, TANGENT_WIDTH), dtype=np.float32)
    middle = 0.5 * (side - 1)
    spread = side * side * (side * side - 1) / 12.0  # sum over the square of squared distances along one axis
    rows, columns = np.empty(side, dtype=np.int64), np.empty(side, dtype=np.int64)
    for a in range(height):
        for b in range(width):
            for k in range(side):
                rows[k] = min(max(a * step - base + k + 1, 0), ny - 1)
                columns[k] = min(max(b * step - base + k + 1, 0), nx - 1)
            for m in range(c):
                total, down, right = 0.0, 0.0, 0.0
                for y in range(side):
                    line, slant = 0.0, 0.0
                    for x in range(side):
                        value = mean[rows[y], columns[x], m]
                        line += value
                        slant += value * (x - middle)
                    total += line
                    down += line * (y - middle)
                    right += slant
                at = np.float32(total / (side * side))
                slope_y, slope_x = np.float32(down / spread), np.float32(right / spread)
                low, high = np.inf, -np.inf
                for y in range(side):
                    for x in range(side):
                        off = mean[rows[y], columns[x], m] - slope_y * (y - middle) - slope_x * (x - middle)
                        low, high = min(low, off), max(high, off)
                at = np.float32(0.5 * (low + high))
                records[a * width + b, m], records[a * width + b, 3 + m] = at, slope_y
                records[a * width + b, 6 + m] = slope_x
                records[a * width + b, 9 + m] = max(high - at, at - low) * (1.0 + 1e-6) + 1e-6
    return records
