"""Compiled steps down the tree of (course, position): bound nodes, split them, drop what cannot matter."""

import math

import numba
import numpy as np

from app.positioning.kernels import plain_bound, pose_cost
from app.positioning.offset_bound import offset_bound

__all__ = ["bound_nodes", "dive", "split_nodes", "top_nodes"]

_SLACK = 1e-9  # relative: what rounding may add to a bound
_NEGLIGIBLE = 120.0  # twice the nats below the best pose from which mass does not count


@numba.njit(cache=True, nogil=True)
def _possible(g, j, i, side, tree, scene):  # type: ignore[no-untyped-def]
    """Whether the last sample of a pose of the node can be on the grid and where one may walk; and the least prior cost
    of where it is."""
    ny, nx = scene.mean.shape[0] - 2, scene.mean.shape[1] - 2
    top, bottom = max(j - tree.middle[g, 1], 0), min(j + side - 1 - tree.middle[g, 0], ny - 1)
    left, right = max(i - tree.middle[g, 3], 0), min(i + side - 1 - tree.middle[g, 2], nx - 1)
    if top > bottom or left > right:
        return False, 0.0
    if len(scene.walkable):
        t = scene.walkable
        if t[bottom + 1, right + 1] - t[top, right + 1] - t[bottom + 1, left] + t[top, left] == 0:
            return False, 0.0
    row, column, weight = scene.prior[0], scene.prior[1], scene.prior[2]
    dj = max(max(top - row, row - bottom), 0.0)
    di = max(max(left - column, column - right), 0.0)
    return True, weight * (dj * dj + di * di)


@numba.njit(cache=True, nogil=True)
def _bound(g, j, i, level, tree, scene, cost, stop, box, weight):  # type: ignore[no-untyped-def]
    """Lower bound of the costs of a node's poses, given up beyond `stop`, and the samples compared."""
    if level == 0:
        return pose_cost(g, j, i, tree.place, tree.feature, tree.heading, scene, cost, stop)
    if scene.offset[0]:
        bound, work = offset_bound(
            g, j, i, level, tree.place, tree.feature, tree.heading, scene, cost, stop, box, weight
        )
    else:
        bound, work = plain_bound(g, j, i, level, tree.place, tree.feature, scene, cost, stop)
    return bound - _SLACK * (1.0 + abs(bound)), work


@numba.njit(cache=True, nogil=True)
def top_nodes(first, last, level, row, column, height, width, tree, scene):  # type: ignore[no-untyped-def]
    """(k, 3) nodes (group, first row, first column) of all groups of a stage over the extended grid from (row, column)
    on, that hold poses; and the least prior cost of each."""
    side = 1 << level
    nodes = np.empty(((last - first) * height * width, 3), dtype=np.int32)
    costs = np.empty(len(nodes))
    k = 0
    for g in range(first, last):
        for a in range(height):
            for b in range(width):
                j, i = row + a * side, column + b * side
                there, cost = _possible(g, j, i, side, tree, scene)
                if there:
                    nodes[k, 0], nodes[k, 1], nodes[k, 2] = g, j, i
                    costs[k] = tree.cost[g] + cost
                    k += 1
    return nodes[:k].copy(), costs[:k].copy()


@numba.njit(cache=True, nogil=True)
def bound_nodes(nodes, costs, level, tree, scene, stop):  # type: ignore[no-untyped-def]
    """Replace prior costs (k,) of nodes (k, 3) by their bounds, given up beyond `stop`; returns the samples compared."""
    box, weight = np.zeros((tree.feature.shape[1], 6)), np.empty(tree.feature.shape[1])
    work = 0
    for p in range(len(nodes)):
        costs[p], used = _bound(
            nodes[p, 0], nodes[p, 1], nodes[p, 2], level, tree, scene, costs[p], stop, box, weight
        )
        work += used
    return work


@numba.njit(cache=True, nogil=True)
def split_nodes(nodes, level, tree, scene, keep, stop, best, allowed):  # type: ignore[no-untyped-def]
    """The parts, with blocks of 2^level cells, of nodes of the stage above, as far as `allowed` samples' comparisons go.

    Returns parts (k, 3) whose bounds (k,) are at most `keep`, their bounds, how many nodes were split, the samples
    compared, and the mass relative to a pose of cost `best` that the other parts may hold.
    """
    box, weight = np.zeros((tree.feature.shape[1], 6)), np.empty(tree.feature.shape[1])
    ny, nx = scene.mean.shape[0] - 2, scene.mean.shape[1] - 2
    side = 1 << level
    cells = float(min(side, ny) * min(side, nx))
    parts, bounds = np.empty((max(4 * len(nodes), 64), 3), dtype=np.int32), np.empty(max(4 * len(nodes), 64))
    found, work, missed, p = 0, 0, 0.0, 0
    while p < len(nodes) and work < allowed:
        g = nodes[p, 0]
        start, end = tree.first[g], tree.first[g + 1]
        count = max(end - start, 1)
        if found + 4 * count > len(parts):
            more = 2 * len(parts) + 4 * count
            old_parts, old_bounds = parts, bounds
            parts, bounds = np.empty((more, 3), dtype=np.int32), np.empty(more)
            parts[:found], bounds[:found] = old_parts[:found], old_bounds[:found]
        for q in range(count):
            h = tree.part[start + q] if end > start else g
            for quarter in range(4):
                j, i = nodes[p, 1] + side * (quarter >> 1), nodes[p, 2] + side * (quarter & 1)
                there, cost = _possible(h, j, i, side, tree, scene)
                if not there:
                    continue
                bound, used = _bound(h, j, i, level, tree, scene, cost + tree.cost[h], stop, box, weight)
                work += used
                if bound <= keep:
                    parts[found, 0], parts[found, 1], parts[found, 2] = h, j, i
                    bounds[found] = bound
                    found += 1
                elif bound < best + _NEGLIGIBLE:
                    missed += tree.leaves[h] * cells * math.exp(min(0.5 * (best - bound), 300.0))
        p += 1
    return parts[:found].copy(), bounds[:found].copy(), p, work, missed


@numba.njit(cache=True, nogil=True)
def dive(nodes, bounds, level, beam, tree, scene, stop):  # type: ignore[no-untyped-def]
    """Follow the `beam` most promising nodes of a level down to a pose: (course, row, column) of its middle, and its
    cost; above `stop` it need not be the best of the beam."""
    while level > 0:
        if len(nodes) > beam:
            chosen = np.argsort(bounds)[:beam]
            nodes = nodes[chosen]
        level -= 1
        nodes, bounds, _, _, _ = split_nodes(nodes, level, tree, scene, np.inf, stop, 0.0, 1 << 60)
    best = np.argmin(bounds)
    return nodes[best : best + 1].copy(), bounds[best]
