"""Bound of a node with a constant offset of the sensor integrated out.

Over the node the residual of sample i lies in a box, and an offset b shifts all boxes alike (turned to the building's
axes by R_i): the least cost is min_b g(b), g(b) = sum_i w_i |e_i(b)|^2 + p |b|^2, with e_i(b) the distance vector of
the box, shifted by R_i b, from zero. g is convex, and any vectors l_i bound it from below by duality,
    g(b) >= 2 (sum_i l_i mid_i - |l_i| half_i) - sum_i |l_i|^2 / w_i - |sum_i R_i' l_i|^2 / p.
With l_i = t w_i e_i(b) and the best t this is L^2 / Q, L = sum w_i |e_i|^2 + s b, Q = sum w_i |e_i|^2 + |s|^2 / p, s
= sum w_i R_i' e_i: exact at the best b, which a few Newton steps from zero come close to. Without a prior (p = 0) the
sum of the l_i must vanish: what it is gets subtracted from them. Any part of the samples gives a bound too, so that
most nodes are given up after a few.
"""

import math

import numba
import numpy as np

from app.positioning.kernels import ROUNDING, SLACK, limit_of, record_of, spare_cost, to_sensor

__all__ = ["offset_bounds"]

_STEPS = 4


@numba.njit(cache=True, nogil=True, inline="always")
def _apart(low, high):  # type: ignore[no-untyped-def]
    """Where the interval is nearest zero."""
    return max(low, 0.0) + min(high, 0.0)


@numba.njit(cache=True, nogil=True, inline="always")
def _to_building(x, y, z, turn, k):  # type: ignore[no-untyped-def]
    return (
        turn[k, 0, 0] * x + turn[k, 1, 0] * y + turn[k, 2, 0] * z,
        turn[k, 0, 1] * x + turn[k, 1, 1] * y + turn[k, 2, 1] * z,
        turn[k, 0, 2] * x + turn[k, 1, 2] * y + turn[k, 2, 2] * z,
    )


@numba.njit(cache=True, nogil=True, inline="always")
def _scaled(linear, quadratic):  # type: ignore[no-untyped-def]
    """2 t linear - t^2 quadratic at the best t up to two: where both vanish, their quotient is but rounding."""
    t = min(linear / max(quadratic, 1e-300), 2.0)
    return t * (2.0 * linear - t * quadratic) if linear > 0.0 else 0.0


@numba.njit(cache=True, nogil=True)
def _dual(precision, bx, by, bz, squares, sx, sy, sz, total, ch, sh, box, weight, turn, n):  # type: ignore[no-untyped-def]
    """The bound from the distance vectors at offset b."""
    if precision > 0.0:
        linear = squares + sx * bx + sy * by + sz * bz
        quadratic = squares + (sx * sx + sy * sy + sz * sz) / precision
        if linear > 0.0 and precision > 0.02 * total:
            return _scaled(linear, quadratic)
    # l_i = w_i (e_i - R_i u), so that their sum is p b
    ux, uy, uz = (sx - precision * bx) / total, (sy - precision * by) / total, (sz - precision * bz) / total
    linear, quadratic = 0.0, precision * (bx * bx + by * by + bz * bz)
    for k in range(n):
        w = weight[k]
        ox, oy, oz = _to_building(bx, by, bz, turn, k)
        ox, oy = ch * ox - sh * oy, ch * oy + sh * ox
        vx, vy, vz = _to_building(ux, uy, uz, turn, k)
        vx, vy = ch * vx - sh * vy, ch * vy + sh * vx
        lx = _apart(box[k, 0] - ox, box[k, 3] - ox) - vx
        ly = _apart(box[k, 1] - oy, box[k, 4] - oy) - vy
        lz = _apart(box[k, 2] - oz, box[k, 5] - oz) - vz
        quadratic += w * (lx * lx + ly * ly + lz * lz)
        linear += w * (min(lx * box[k, 0], lx * box[k, 3]) + min(ly * box[k, 1], ly * box[k, 4])
                       + min(lz * box[k, 2], lz * box[k, 5]))  # fmt: skip
    return _scaled(linear, quadratic)


@numba.njit(cache=True, nogil=True, inline="always")
def _offset_bound(  # type: ignore[no-untyped-def]
    g,
    j,
    i,
    square,
    place,
    feature,
    heading,
    kind,
    ladder,
    records,
    codes,
    places,
    turn,
    headed,
    offset,
    cost,
    stop,
    box,
    weight,
):
    """`cost` plus the bound of the block at (j, i), given up as soon as it exceeds `stop`; and the samples compared.

    box (n, 6), weight (n,): room to work in
    """
    n, c = feature.shape[1], feature.shape[2] // 2
    _, precision, relative, least = offset
    ch, sh = (heading[g, 0], heading[g, 1]) if headed else (1.0, 0.0)
    prior_variance = 1.0 / precision if precision > 0.0 else 0.0
    squares, sx, sy, sz, total = 0.0, 0.0, 0.0, 0.0, precision
    hx, hy, hz = precision, precision, precision
    cost += least
    for k in range(n):
        at = record_of(j + place[g, k, 0], i + place[g, k, 1], max(place[g, k, 2], square), places)
        for m in range(c):
            box[k, m] = feature[g, k, m] - records[at, c + m]
            box[k, 3 + m] = feature[g, k, c + m] - records[at, m]
        w = ladder[kind[k], codes[at, 8 * c + 1], 1]
        cost += ladder[kind[k], codes[at, 8 * c], 2]
        weight[k] = w
        total += w
        ex, ey, ez = _apart(box[k, 0], box[k, 3]), _apart(box[k, 1], box[k, 4]), _apart(box[k, 2], box[k, 5])
        squares += w * (ex * ex + ey * ey + ez * ez)
        hx, hy, hz = hx + w * (ex != 0.0), hy + w * (ey != 0.0), hz + w * (ez != 0.0)
        ex, ey = ch * ex + sh * ey, ch * ey - sh * ex
        x, y, z = to_sensor(ex, ey, ez, turn, k)
        sx, sy, sz = sx + w * x, sy + w * y, sz + w * z
        room = stop - cost
        if room < 0.0:
            return cost, k + 1
        if precision > 0.0:
            quadratic = squares + prior_variance * (sx * sx + sy * sy + sz * sz)
            if squares * squares > room * quadratic:
                return cost + squares * squares / quadratic, k + 1
    cost += c * math.log(total / relative) - least
    room = stop - cost
    best = 0.0
    if precision > 0.0:
        best = squares * squares / max(squares + prior_variance * (sx * sx + sy * sy + sz * sz), 1e-300)
    if squares <= room:
        return cost + best, n
    bx, by, bz = 0.0, 0.0, 0.0
    work = n
    for _ in range(_STEPS):
        bx += (sx - precision * bx) / max(hx, 1e-9)
        by += (sy - precision * by) / max(hy, 1e-9)
        bz += (sz - precision * bz) / max(hz, 1e-9)
        squares, sx, sy, sz = 0.0, 0.0, 0.0, 0.0
        hx, hy, hz = precision, precision, precision
        for k in range(n):
            w = weight[k]
            ox, oy, oz = _to_building(bx, by, bz, turn, k)
            ox, oy = ch * ox - sh * oy, ch * oy + sh * ox
            ex, ey = _apart(box[k, 0] - ox, box[k, 3] - ox), _apart(box[k, 1] - oy, box[k, 4] - oy)
            ez = _apart(box[k, 2] - oz, box[k, 5] - oz)
            squares += w * (ex * ex + ey * ey + ez * ez)
            hx, hy, hz = hx + w * (ex != 0.0), hy + w * (ey != 0.0), hz + w * (ez != 0.0)
            ex, ey = ch * ex + sh * ey, ch * ey - sh * ex
            x, y, z = to_sensor(ex, ey, ez, turn, k)
            sx, sy, sz = sx + w * x, sy + w * y, sz + w * z
        work += n
        bound = _dual(precision, bx, by, bz, squares, sx, sy, sz, total - precision, ch, sh, box, weight, turn, n)
        best = max(best, bound)
        if best > room or squares + precision * (bx * bx + by * by + bz * bz) <= room:
            break
    return cost + best, work


@numba.njit(cache=True, nogil=True)
def offset_bounds(nodes, costs, level, tree, scene, best, window):  # type: ignore[no-untyped-def]
    """As `plain_bounds`."""
    place, feature, heading, kind, ladder = tree.place, tree.feature, tree.heading, scene.kind, scene.ladder
    records, codes, places, turn = scene.records, scene.codes, scene.places, scene.turn
    n = feature.shape[1]
    box, weight = np.zeros((n, 6)), np.empty(n)
    spare, square = spare_cost(level, scene.mean), scene.doubling[level]
    work = 0
    for p in range(len(nodes)):
        known, stop = costs[p], limit_of(tree.size[nodes[p, 0]], spare, best, window)
        bound, used = _offset_bound(
            nodes[p, 0], nodes[p, 1], nodes[p, 2], square, place, feature, heading, kind, ladder, records,
            codes, places,
            turn,
            scene.headed, scene.offset, known, stop, box, weight,
        )  # fmt: skip
        costs[p] = bound - SLACK * (1.0 + bound - known) - ROUNDING * abs(bound)
        work += used
    return work
