"""Compiled steps down the tree of (course, position): split nodes, bound them, drop what cannot matter.

Nodes are (group, first row, first column) of a block for the middle sample. They are made, bounded and dropped in small
batches that stay in the processor's caches; only those that are to be followed are kept.
"""

import numba
import numpy as np

from app.positioning.kernels import limit_of, plain_bounds, pose_costs, spare_cost
from app.positioning.offset_bound import offset_bounds

__all__ = ["dive", "split", "top", "top_nodes"]

_BATCH = 512
_NEGLIGIBLE = 120.0  # twice the nats below the best pose from which mass does not count
_STEPS = 4  # to a unit of cost, in which masses are rounded up
_MASS = np.exp(-0.5 / _STEPS * np.arange(int(_NEGLIGIBLE) * _STEPS + 1))  # by steps of cost above the best


@numba.njit(cache=True, nogil=True, inline="always")
def _prior_cost(g, j, i, side, ny, nx, middle, walkable, prior):  # type: ignore[no-untyped-def]
    """Least prior cost of a node's poses over where their last samples are; negative if none is on the grid where one
    may walk."""
    top, bottom = max(j - middle[g, 1], 0), min(j + side - 1 - middle[g, 0], ny - 1)
    left, right = max(i - middle[g, 3], 0), min(i + side - 1 - middle[g, 2], nx - 1)
    if top > bottom or left > right:
        return -1.0
    if len(walkable):
        held = (
            walkable[bottom + 1, right + 1]
            - walkable[top, right + 1]
            - walkable[bottom + 1, left]
            + walkable[top, left]
        )
        if held == 0:
            return -1.0
    dj = max(max(top - prior[0], prior[0] - bottom), 0.0)
    di = max(max(left - prior[1], prior[1] - right), 0.0)
    return prior[2] * (dj * dj + di * di)


@numba.njit(cache=True, nogil=True)
def _batch(nodes, costs, count, level, tree, scene, best, window, kept, bounds, found):  # type: ignore[no-untyped-def]
    """Bound the first `count` nodes, given their prior costs, and append those within their `limit_of` to the `found`
    first of `kept`, with their bounds.

    Returns these arrays, which may have grown, how many they hold, the samples compared, the mass relative to a pose of
    cost `best` that the others hold at most, and the least cost.
    """
    nodes, costs = nodes[:count], costs[:count]
    if level == 0:
        work = pose_costs(nodes, costs, tree, scene, best, window)
    elif scene.offset[0]:
        work = offset_bounds(nodes, costs, level, tree, scene, best, window)
    else:
        work = plain_bounds(nodes, costs, level, tree, scene, best, window)
    if found + count > len(bounds):
        before, known = kept, bounds
        kept, bounds = np.empty((2 * len(bounds) + count, 3), dtype=np.int32), np.empty(2 * len(bounds) + count)
        kept[:found], bounds[:found] = before[:found], known[:found]
    leaves, size, spare = tree.leaves, tree.size, spare_cost(level, scene.mean)
    cells = float(min(1 << level, scene.mean.shape[0] - 2) * min(1 << level, scene.mean.shape[1] - 2))
    missed, least = 0.0, np.inf
    for p in range(count):
        g, bound = nodes[p, 0], costs[p]
        least = min(least, bound)
        if bound <= limit_of(size[g], spare, best, window):
            kept[found, 0], kept[found, 1], kept[found, 2], bounds[found] = g, nodes[p, 1], nodes[p, 2], bound
            found += 1
        elif bound < best + _NEGLIGIBLE:
            missed += leaves[g] * cells * _MASS[int((bound - best) * _STEPS)]
    return kept, bounds, found, work, missed, least


@numba.njit(cache=True, nogil=True)
def top(first, last, level, area, tree, scene, best, window):  # type: ignore[no-untyped-def]
    """The nodes of groups `first` to `last` (excluded) over an area (first row, first column, blocks down, blocks
    right) that are within their limits.

    Returns them, their bounds, the samples compared, and the mass relative to a pose of cost `best` that the others
    hold at most.
    """
    middle, walkable, prior, cost = tree.middle, scene.walkable, scene.prior, tree.cost
    ny, nx, side = scene.mean.shape[0] - 2, scene.mean.shape[1] - 2, 1 << level
    row, column, height, width = area
    batch, costs, count = np.empty((_BATCH, 3), dtype=np.int32), np.empty(_BATCH), 0
    kept, bounds, found = np.empty((_BATCH, 3), dtype=np.int32), np.empty(_BATCH), 0
    work, missed = 0, 0.0
    for g in range(first, last):
        for a in range(height):
            for b in range(width):
                j, i = row + a * side, column + b * side
                apart = _prior_cost(g, j, i, side, ny, nx, middle, walkable, prior)
                if apart < 0.0:
                    continue
                batch[count, 0], batch[count, 1], batch[count, 2] = g, j, i
                costs[count] = cost[g] + apart + scene.constant
                count += 1
                if count == _BATCH:
                    kept, bounds, found, used, left, _ = _batch(
                        batch, costs, count, level, tree, scene, best, window, kept, bounds, found
                    )
                    work, missed, count = work + used, missed + left, 0
    kept, bounds, found, used, left, _ = _batch(
        batch, costs, count, level, tree, scene, best, window, kept, bounds, found
    )
    return kept[:found], bounds[:found], work + used, missed + left


@numba.njit(cache=True, nogil=True)
def split(nodes, level, tree, scene, best, window, allowed):  # type: ignore[no-untyped-def]
    """The parts, with blocks of 2^level cells, of nodes of the stage above, that are within their limits.

    Returns them, their bounds, how many nodes were split before `allowed` samples were compared, how many were
    compared, the mass relative to a pose of cost `best` that other parts hold at most, and the least cost of a part.
    """
    middle, walkable, prior, cost = tree.middle, scene.walkable, scene.prior, tree.cost
    first, part = tree.first, tree.part
    ny, nx, side = scene.mean.shape[0] - 2, scene.mean.shape[1] - 2, 1 << level
    batch, costs, count = np.empty((_BATCH, 3), dtype=np.int32), np.empty(_BATCH), 0
    kept, bounds, found = np.empty((_BATCH, 3), dtype=np.int32), np.empty(_BATCH), 0
    work, missed, least, done = 0, 0.0, np.inf, 0
    while done < len(nodes) and work < allowed:
        g = nodes[done, 0]
        start, end = first[g], first[g + 1]
        for q in range(max(end - start, 1)):
            h = part[start + q] if end > start else g
            for quarter in range(4):
                j, i = nodes[done, 1] + side * (quarter >> 1), nodes[done, 2] + side * (quarter & 1)
                apart = _prior_cost(h, j, i, side, ny, nx, middle, walkable, prior)
                if apart < 0.0:
                    continue
                batch[count, 0], batch[count, 1], batch[count, 2] = h, j, i
                costs[count] = cost[h] + apart + scene.constant
                count += 1
                if count == _BATCH:
                    kept, bounds, found, used, left, low = _batch(
                        batch, costs, count, level, tree, scene, best, window, kept, bounds, found
                    )
                    work, missed, least, count = work + used, missed + left, min(least, low), 0
        done += 1
    kept, bounds, found, used, left, low = _batch(
        batch, costs, count, level, tree, scene, best, window, kept, bounds, found
    )
    return kept[:found], bounds[:found], done, work + used, missed + left, min(least, low)


@numba.njit(cache=True, nogil=True)
def top_nodes(first, last, level, area, tree, scene):  # type: ignore[no-untyped-def]
    """All nodes that hold poses, as `top`, unbounded, and their prior costs."""
    middle, walkable, prior = tree.middle, scene.walkable, scene.prior
    ny, nx, side = scene.mean.shape[0] - 2, scene.mean.shape[1] - 2, 1 << level
    row, column, height, width = area
    nodes = np.empty(((last - first) * height * width, 3), dtype=np.int32)
    costs, k = np.empty(len(nodes)), 0
    for g in range(first, last):
        for a in range(height):
            for b in range(width):
                j, i = row + a * side, column + b * side
                apart = _prior_cost(g, j, i, side, ny, nx, middle, walkable, prior)
                if apart >= 0.0:
                    nodes[k, 0], nodes[k, 1], nodes[k, 2] = g, j, i
                    costs[k] = tree.cost[g] + apart + scene.constant
                    k += 1
    return nodes[:k], costs[:k]


@numba.njit(cache=True, nogil=True)
def dive(nodes, bounds, level, wide, beam, tree, scene, best):  # type: ignore[no-untyped-def]
    """Follow the most promising nodes of a level down to a pose: (course, row, column) of its middle, and its cost; if
    that is not below `best`, it need not be the best of them, nor the cost exact. None (0, 3) if they hold none.

    Bounds of large blocks say little about which is best: of the `wide` with the lowest, and of their parts, `beam` are
    followed, those whose middle pose costs least.
    """
    nodes = _lowest(nodes, bounds, wide)
    while level > 0 and len(nodes):
        middle, costs = nodes + (1 << level - 1), np.empty(len(nodes))
        for p in range(len(nodes)):
            middle[p, 0] = tree.typical[nodes[p, 0]]
            costs[p] = tree.cost[nodes[p, 0]] + scene.constant
        pose_costs(middle, costs, tree, scene, np.inf, 0.0)
        nodes = _lowest(nodes, costs, beam)
        level -= 1
        nodes = _parts(nodes, level, tree, scene)
    costs = np.full(len(nodes), np.inf)
    for p in range(len(nodes)):
        g, j, i = nodes[p, 0], nodes[p, 1], nodes[p, 2]
        apart = _prior_cost(
            g, j, i, 1, scene.mean.shape[0] - 2, scene.mean.shape[1] - 2, tree.middle, scene.walkable, scene.prior
        )
        costs[p] = tree.cost[g] + apart + scene.constant
    if not len(nodes):
        return nodes, np.inf
    pose_costs(nodes, costs, tree, scene, best, 0.0)
    least = np.argmin(costs)
    return nodes[least : least + 1].copy(), costs[least]


@numba.njit(cache=True, nogil=True)
def _parts(nodes, level, tree, scene):  # type: ignore[no-untyped-def]
    """The parts of nodes that hold poses."""
    first, side = tree.first, 1 << level
    most = 0
    for p in range(len(nodes)):
        most += 4 * max(first[nodes[p, 0] + 1] - first[nodes[p, 0]], 1)
    parts, k = np.empty((most, 3), dtype=np.int32), 0
    for p in range(len(nodes)):
        g = nodes[p, 0]
        start, end = first[g], first[g + 1]
        for q in range(max(end - start, 1)):
            h = tree.part[start + q] if end > start else g
            for quarter in range(4):
                j, i = nodes[p, 1] + side * (quarter >> 1), nodes[p, 2] + side * (quarter & 1)
                apart = _prior_cost(
                    h, j, i, side, scene.mean.shape[0] - 2, scene.mean.shape[1] - 2, tree.middle, scene.walkable,
                    scene.prior
                )  # fmt: skip
                if apart >= 0.0:
                    parts[k, 0], parts[k, 1], parts[k, 2] = h, j, i
                    k += 1
    return parts[:k]


@numba.njit(cache=True, nogil=True)
def _lowest(nodes, values, count):  # type: ignore[no-untyped-def]
    """About `count` nodes with the lowest values."""
    if len(nodes) <= count:
        return nodes
    return nodes[np.flatnonzero(values <= np.partition(values, count)[count])[: 2 * count]]
