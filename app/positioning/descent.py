"""Compiled steps down the tree of (course, position): split nodes, bound them, drop what cannot matter."""

import math

import numba
import numpy as np

from app.field.tangents import FLAT_SIDE
from app.positioning.kernels import limit_of, plain_bounds, pose_costs, spare_cost
from app.positioning.offset_bound import offset_bounds
from app.positioning.tangent_bound import tangent_bounds

__all__ = ["bound_nodes", "dive", "sift", "split_nodes", "top_nodes"]

_NEGLIGIBLE = 120.0  # twice the nats below the best pose from which mass does not count


@numba.njit(cache=True, nogil=True, inline="always")
def _prior_cost(g, j, i, side, ny, nx, middle, walkable, prior):  # type: ignore[no-untyped-def]
    """Least prior cost of a node's poses over where their last samples are; negative if none is on the grid where one
    may walk."""
    top, bottom = max(j - middle[g, 1], 0), min(j + side - 1 - middle[g, 0], ny - 1)
    left, right = max(i - middle[g, 3], 0), min(i + side - 1 - middle[g, 2], nx - 1)
    if top > bottom or left > right:
        return -1.0
    if len(walkable):
        held = walkable[bottom + 1, right + 1] - walkable[top, right + 1] - walkable[bottom + 1, left] + walkable[top, left]
        if held == 0:
            return -1.0
    dj = max(max(top - prior[0], prior[0] - bottom), 0.0)
    di = max(max(left - prior[1], prior[1] - right), 0.0)
    return prior[2] * (dj * dj + di * di)


@numba.njit(cache=True, nogil=True)
def top_nodes(first, last, level, row, column, height, width, tree, scene):  # type: ignore[no-untyped-def]
    """(k, 3) nodes (group, first row, first column) of all groups of a stage over the extended grid from (row, column)
    on, that hold poses; and the least prior cost of each."""
    middle, walkable, prior, cost = tree.middle, scene.walkable, scene.prior, tree.cost
    ny, nx, side = scene.mean.shape[0] - 2, scene.mean.shape[1] - 2, 1 << level
    nodes = np.empty(((last - first) * height * width, 3), dtype=np.int32)
    costs = np.empty(len(nodes))
    k = 0
    for g in range(first, last):
        for a in range(height):
            for b in range(width):
                j, i = row + a * side, column + b * side
                least = _prior_cost(g, j, i, side, ny, nx, middle, walkable, prior)
                if least >= 0.0:
                    nodes[k, 0], nodes[k, 1], nodes[k, 2] = g, j, i
                    costs[k] = cost[g] + least + scene.constant
                    k += 1
    return nodes[:k].copy(), costs[:k].copy()


@numba.njit(cache=True, nogil=True)
def _ranges(nodes, costs, level, tree, scene, best, window, allowed):  # type: ignore[no-untyped-def]
    if scene.offset[0]:
        return offset_bounds(nodes, costs, level, tree, scene, best, window, allowed)
    return plain_bounds(nodes, costs, level, tree, scene, best, window, allowed)


@numba.njit(cache=True, nogil=True)
def bound_nodes(nodes, costs, level, tree, scene, best, window, allowed):  # type: ignore[no-untyped-def]
    """Turn the prior costs (k,) of nodes (k, 3) into bounds of their poses' costs, at level zero into these, given up
    beyond their `limit_of`. Returns how many nodes were reached, and the samples compared, hardly more than `allowed`."""
    if level == 0:
        return pose_costs(nodes, costs, tree, scene, best, window, allowed)
    if 1 << level <= FLAT_SIDE:
        return _ranges(nodes, costs, level, tree, scene, best, window, allowed)
    priors = costs.copy()
    done, work = _ranges(nodes, costs, level, tree, scene, best, window, allowed)
    return done, work + tangent_bounds(nodes[:done], costs[:done], priors, priors.copy(), level, tree, scene, best, window)


@numba.njit(cache=True, nogil=True)
def split_nodes(nodes, bounds, level, tree, scene):  # type: ignore[no-untyped-def]
    """The parts (k, 3), with blocks of 2^level cells, of nodes of the stage above; their prior costs (k,), and the
    bounds (k,) of the nodes they come from."""
    middle, walkable, prior, cost = tree.middle, scene.walkable, scene.prior, tree.cost
    first, part = tree.first, tree.part
    ny, nx, side = scene.mean.shape[0] - 2, scene.mean.shape[1] - 2, 1 << level
    most = 0
    for p in range(len(nodes)):
        most += 4 * max(first[nodes[p, 0] + 1] - first[nodes[p, 0]], 1)
    parts, costs, known = np.empty((most, 3), dtype=np.int32), np.empty(most), np.empty(most)
    k = 0
    for p in range(len(nodes)):
        g = nodes[p, 0]
        start, end = first[g], first[g + 1]
        for q in range(max(end - start, 1)):
            h = part[start + q] if end > start else g
            for quarter in range(4):
                j, i = nodes[p, 1] + side * (quarter >> 1), nodes[p, 2] + side * (quarter & 1)
                least = _prior_cost(h, j, i, side, ny, nx, middle, walkable, prior)
                if least >= 0.0:
                    parts[k, 0], parts[k, 1], parts[k, 2] = h, j, i
                    costs[k], known[k] = cost[h] + least + scene.constant, bounds[p]
                    k += 1
    return parts[:k], costs[:k], known[:k]


@numba.njit(cache=True, nogil=True)
def sift(nodes, bounds, level, tree, scene, best, window):  # type: ignore[no-untyped-def]
    """The nodes whose bounds are within their `limit_of`, their bounds, and the mass relative to a pose of cost `best`
    that the others hold at most."""
    leaves, size, spare = tree.leaves, tree.size, spare_cost(level, scene.mean)
    cells = float(min(1 << level, scene.mean.shape[0] - 2) * min(1 << level, scene.mean.shape[1] - 2))
    kept, missed = 0, 0.0
    for p in range(len(nodes)):
        if bounds[p] <= limit_of(size[nodes[p, 0]], spare, best, window):
            kept += 1
        elif bounds[p] < best + _NEGLIGIBLE:
            missed += leaves[nodes[p, 0]] * cells * math.exp(min(0.5 * (best - bounds[p]), 300.0))
    left, least = np.empty((kept, 3), dtype=np.int32), np.empty(kept)
    k = 0
    for p in range(len(nodes)):
        if bounds[p] <= limit_of(size[nodes[p, 0]], spare, best, window):
            left[k, 0], left[k, 1], left[k, 2], least[k] = nodes[p, 0], nodes[p, 1], nodes[p, 2], bounds[p]
            k += 1
    return left, least, missed


@numba.njit(cache=True, nogil=True)
def _guesses(nodes, bounds, level, tree, scene):  # type: ignore[no-untyped-def]
    """What the best pose of each node may cost: were the field its tangents, or, of small blocks, that in the middle."""
    guesses = np.empty(len(nodes))
    for p in range(len(nodes)):
        guesses[p] = tree.cost[nodes[p, 0]] + scene.constant
    if 1 << level > FLAT_SIDE:
        tangent_bounds(nodes, bounds.copy(), guesses.copy(), guesses, level, tree, scene, np.inf, 0.0)
        return guesses
    middle = nodes + (1 << level - 1)
    for p in range(len(nodes)):
        middle[p, 0] = tree.typical[nodes[p, 0]]
    pose_costs(middle, guesses, tree, scene, np.inf, 0.0, 1 << 60)
    return guesses


@numba.njit(cache=True, nogil=True)
def dive(nodes, bounds, level, wide, beam, tree, scene, best):  # type: ignore[no-untyped-def]
    """Follow the most promising nodes of a level down to a pose: (course, row, column) of its middle, and its cost; if
    that is not below `best`, it need not be the best of them, nor the cost exact. None (0, 3) if they hold none.

    Bounds of large blocks say little about which is best: of the `wide` with the lowest, and of their parts, `beam` are
    followed, those whose best pose is guessed to cost least.
    """
    nodes, bounds = _lowest(nodes, bounds, wide)
    while level > 0 and len(nodes):
        nodes, bounds = _lowest(nodes, _guesses(nodes, bounds, level, tree, scene), beam)
        level -= 1
        nodes, bounds, _ = split_nodes(nodes, bounds, level, tree, scene)
    pose_costs(nodes, bounds, tree, scene, best, 0.0, 1 << 60)
    if not len(nodes):
        return nodes, np.inf
    least = np.argmin(bounds)
    return nodes[least : least + 1].copy(), bounds[least]


@numba.njit(cache=True, nogil=True)
def _lowest(nodes, values, count):  # type: ignore[no-untyped-def]
    """About `count` nodes with the lowest values."""
    if len(nodes) <= count:
        return nodes, values
    chosen = np.flatnonzero(values <= np.partition(values, count)[count])[: 2 * count]
    return nodes[chosen], values[chosen]
