"""The courses of a window as a tree, over which a search bounds many of them at once.

The leaves are the courses themselves: a product lattice of headings, scales and drifts. At every level of blocks of
2^l cells they are grouped into boxes of that lattice, nested, halved along each dimension as the blocks are halved. A
group knows, for every sample, the rectangle of cells its courses displace it to and the interval of features they turn
it to; both are exact. Displacements count from the sample in the middle of the window, not from the last: that halves
the levers, so that a group can hold more courses. Which boxes go with which blocks follows from the lattice's steps:
what a box spreads the samples by, in cells, is kept in proportion to the side of the block.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.positioning.lattice import Courses, Turned

__all__ = ["CourseTree", "Stage", "Tree", "course_tree"]

Index = NDArray[np.int32]


class Tree(NamedTuple):
    """All groups of all stages; the courses, each on its own, come first, as groups 0 to h - 1.

    place     (g, n, 3) per sample: first row and first column of the group's displacements from the middle cell, and
              the index of the squares that cover a block so displaced; of a course alone zero: those of the block
    feature   (g, n, 2 c) lower, then upper bounds of the features, uT
    exact     (h, n, c) features of the courses, uT
    middle    (g, 4) least and largest row, least and largest column of the middle sample from the last
    heading   (g, 2) cosine and sine of one of its headings
    cost      (g,) least -2 log prior
    typical   (g,) a course in the middle of the group
    leaves    (g,) courses held
    size      (g,) twice the log of it
    first     (g + 1,) where a group's parts in the stage below begin in `part`
    part      groups of the stage below; courses alone have none, they stay
    """

    place: Index
    feature: NDArray[np.float32]
    exact: Array
    middle: Index
    heading: Array
    cost: Array
    typical: Index
    leaves: Index
    size: Array
    first: Index
    part: Index


@dataclass(frozen=True, slots=True)
class Stage:
    """Blocks of 2^level cells with the groups `first` to `last` (excluded)."""

    level: int
    first: int
    last: int


@dataclass(frozen=True, slots=True, eq=False)
class CourseTree:
    """stages[l] goes with blocks of 2^l cells; stages[0] holds poses."""

    tree: Tree
    stages: tuple[Stage, ...]


def course_tree(
    courses: Courses,
    turned: Turned,
    order: NDArray[np.int64],
    middle_sample: int,
    places: NDArray[np.int64],
    top: int,
    cells_per_uT: float,
    share: float,
    headings_apart: bool,
) -> CourseTree:
    """Groups for blocks up to 2^top cells, for the squares `places` of a pyramid.

    order           in which the samples are compared
    middle_sample   the one that displacements count from
    cells_per_uT    cells over which the field changes by a microtesla
    share           how far a group may spread the samples, in sides of the block
    headings_apart  whether no group may hold several headings
    """
    offset = turned.offset_cells
    c, n = turned.features_uT.shape[2], offset.shape[1]
    counts = _counts(courses)
    spread = _spread_per_step(turned, middle_sample, counts, cells_per_uT)
    if headings_apart:
        spread[0] = np.inf
    shifts = _shifts(spread, counts, top, share)
    sizes = [_boxes(counts, shift) for shift in shifts]
    alone = [size == len(courses) for size in sizes]
    groups = len(courses) + sum(size for size, single in zip(sizes, alone, strict=True) if not single)
    extent = np.empty((groups, n, 4), dtype=np.int32)
    feature = np.empty((groups, n, 2 * c), dtype=np.float32)
    exact = np.ascontiguousarray(turned.features_uT[:, order])
    middle, cost = np.empty((groups, 4), dtype=np.int32), np.empty(groups)
    leaves, first = np.ones(groups, dtype=np.int32), np.zeros(groups + 1, dtype=np.int32)
    level, typical = np.zeros((groups, n), dtype=np.int32), np.arange(groups).astype(np.int32)
    _leaves(offset, exact, order, middle_sample, extent, feature, middle)
    cost[: len(courses)] = -2.0 * courses.log_prior
    heading = np.empty((groups, 2))
    heading[: len(courses), 0], heading[: len(courses), 1] = np.cos(courses.heading_rad), np.sin(courses.heading_rad)
    parts, stages, below = [], [], Stage(0, 0, len(courses))
    for level_of, (size, single) in enumerate(zip(sizes, alone, strict=True)):
        stage = Stage(level_of, 0, len(courses))
        if not single:
            start = below.last
            stage = Stage(level_of, start, start + size)
            part, counted = _nest(counts, shifts[level_of - 1], shifts[level_of])
            first[start + 1 : start + size + 1] = first[start] + np.cumsum(counted)
            parts.append((part + below.first).astype(np.int32))
            _join(
                start, first[start : start + size + 1] - first[start], parts[-1], extent, feature, middle, cost, leaves
            )
            heading[start : start + size] = heading[parts[-1][first[start : start + size] - first[start]]]
            held = first[start : start + size] - first[start]
            typical[start : start + size] = typical[parts[-1][held + counted // 2]]
            _choose_squares(extent[start : start + size], level_of, places, level[start : start + size])
        stages.append(stage)
        below = stage
    place = np.ascontiguousarray(np.stack([extent[..., 0], extent[..., 2], level], axis=-1))
    gathered: Index = np.concatenate(parts).astype(np.int32) if parts else np.empty(0, dtype=np.int32)
    return CourseTree(
        Tree(place, feature, exact, middle, heading, cost, typical, leaves, 2.0 * np.log(leaves), first, gathered),
        tuple(stages),
    )


def _counts(courses: Courses) -> tuple[int, int, int]:
    """Headings, scales and drifts of a product lattice in that order; of another list: its length, one and one."""
    total = len(courses)
    runs = _run(courses.heading_rad)
    drifts = _run(courses.scale[:runs])
    shape = (total // runs, runs // drifts, drifts)
    if shape[0] * shape[1] * shape[2] != total:
        return total, 1, 1
    h, s, d = (a.reshape(shape) for a in (courses.heading_rad, courses.scale, courses.drift_rad_per_m))
    same = (h == h[:, :1, :1]).all() and (s == s[:1, :, :1]).all() and (d == d[:1, :1]).all()
    return shape if same else (total, 1, 1)


def _run(values: Array) -> int:
    """How often the first value is repeated at the beginning."""
    other = np.flatnonzero(values != values[0])
    return int(other[0]) if len(other) else len(values)


def _spread_per_step(turned: Turned, middle: int, counts: tuple[int, int, int], cells_per_uT: float) -> Array:
    """(3,) rms over the samples, in cells, of what one step along each dimension displaces and turns them by."""
    n, c = turned.features_uT.shape[1:]
    offset = turned.offset_cells.reshape(*counts, n, 2)
    feature = turned.features_uT.reshape(*counts, n, c)[..., :2]
    offset = offset - offset[..., middle, None, :]
    spread = np.full(3, np.inf)
    for axis in range(3):
        if counts[axis] < 2:
            continue
        along = tuple(
            slice(None) if k == axis else slice(None, None, max(count // 3, 1)) for k, count in enumerate(counts)
        )
        moved = np.diff(offset[along], axis=axis).astype(np.float64)
        turns = np.diff(feature[along], axis=axis) * cells_per_uT
        spread[axis] = np.sqrt(np.mean(np.square(moved).sum(axis=-1)) + np.mean(np.square(turns).sum(axis=-1)))
    return spread


def _shifts(spread: Array, counts: tuple[int, int, int], top: int, share: float) -> NDArray[np.int64]:
    """(top + 1, 3) log2 of the box's extent along each dimension, for every level: as large as the block allows."""
    most = np.array([(count - 1).bit_length() for count in counts])
    shift = np.zeros(3, dtype=np.int64)
    chosen = [shift.copy()]
    for level in range(1, top + 1):
        while True:
            width = np.where(shift > 0, (2.0**shift - 1.0) * np.where(shift > 0, spread, 0.0), 0.0)
            wider = np.where(shift < most, (2.0 ** (shift + 1) - 1.0) * spread, np.inf)
            axis = int(np.argmin(wider))
            if not width.sum() - width[axis] + wider[axis] <= share * 2.0**level:
                break
            shift[axis] += 1
        chosen.append(shift.copy())
    return np.array(chosen)


def _boxes(counts: tuple[int, int, int], shift: NDArray[np.int64]) -> int:
    return int(np.prod([-(-count // (1 << int(s))) for count, s in zip(counts, shift, strict=True)]))


def _nest(
    counts: tuple[int, int, int], finer: NDArray[np.int64], coarser: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The boxes of the finer stage in the order of the coarser's that hold them, and how many each of those holds."""
    shape = [-(-count // (1 << int(s))) for count, s in zip(counts, finer, strict=True)]
    held = [-(-count // (1 << int(s))) for count, s in zip(counts, coarser, strict=True)]
    a, b, d = (np.arange(size) >> int(up - down) for size, up, down in zip(shape, coarser, finer, strict=True))
    owner = ((a[:, None, None] * held[1] + b[:, None]) * held[2] + d).ravel()
    return np.argsort(owner, kind="stable"), np.bincount(owner, minlength=held[0] * held[1] * held[2])


@numba.njit(cache=True, nogil=True)
def _leaves(offset, features, order, m, extent, feature, middle):  # type: ignore[no-untyped-def]
    """The courses, each alone: displacements counted from sample m, features to single precision."""
    h, n, c = features.shape
    for g in range(h):
        middle[g, 0] = middle[g, 1] = offset[g, m, 0]
        middle[g, 2] = middle[g, 3] = offset[g, m, 1]
        for k in range(n):
            extent[g, k, 0] = extent[g, k, 1] = offset[g, order[k], 0] - offset[g, m, 0]
            extent[g, k, 2] = extent[g, k, 3] = offset[g, order[k], 1] - offset[g, m, 1]
            for x in range(c):
                near = np.float32(features[g, k, x])
                feature[g, k, x], feature[g, k, c + x] = near, near
                if near < features[g, k, x]:
                    feature[g, k, c + x] = np.nextafter(near, np.float32(np.inf))
                elif near > features[g, k, x]:
                    feature[g, k, x] = np.nextafter(near, np.float32(-np.inf))


@numba.njit(cache=True, nogil=True)
def _join(start, first, part, extent, feature, middle, cost, leaves):  # type: ignore[no-untyped-def]
    """Groups from `start` on: the union of their parts."""
    n, c = feature.shape[1], feature.shape[2] // 2
    for a in range(len(first) - 1):
        g, p = start + a, part[first[a]]
        extent[g], feature[g], middle[g] = extent[p], feature[p], middle[p]
        cost[g], leaves[g] = cost[p], leaves[p]
        for b in range(first[a] + 1, first[a + 1]):
            p = part[b]
            cost[g], leaves[g] = min(cost[g], cost[p]), leaves[g] + leaves[p]
            for x in (0, 2):
                middle[g, x], middle[g, x + 1] = (
                    min(middle[g, x], middle[p, x]),
                    max(middle[g, x + 1], middle[p, x + 1]),
                )
            for k in range(n):
                for x in (0, 2):
                    extent[g, k, x] = min(extent[g, k, x], extent[p, k, x])
                    extent[g, k, x + 1] = max(extent[g, k, x + 1], extent[p, k, x + 1])
                for x in range(c):
                    feature[g, k, x] = min(feature[g, k, x], feature[p, k, x])
                    feature[g, k, c + x] = max(feature[g, k, c + x], feature[p, k, c + x])


@numba.njit(cache=True, nogil=True)
def _choose_squares(extent, block_level, places, chosen):  # type: ignore[no-untyped-def]
    """Per group and sample the smallest squares that cover a block, whose corner is a multiple of its side, anywhere in
    the extent; where the squares' steps are no larger than the block, their start is known exactly."""
    side, last = 1 << block_level, len(places) - 1
    for g in range(extent.shape[0]):
        for k in range(extent.shape[1]):
            rows, columns = side + extent[g, k, 1] - extent[g, k, 0], side + extent[g, k, 3] - extent[g, k, 2]
            chosen[g, k] = last
            for square in range(last):
                base, shift, covered = places[square, 0], places[square, 1], places[square, 5]
                down = right = 0
                if shift <= block_level:
                    covered += (1 << shift) - 1
                    down, right = (
                        (extent[g, k, 0] + base) & ((1 << shift) - 1),
                        (extent[g, k, 2] + base) & ((1 << shift) - 1),
                    )
                if down + rows <= covered and right + columns <= covered:
                    chosen[g, k] = square
                    break
