"""Bound of a node from the planes through its squares, which knows that a pose displaces all samples alike.

Over the node the residual of sample k is, up to remainders e_k of known size, linear in few shared unknowns t, each in
[-1, 1]: the middle cell along rows and columns, and the place of the course in its group along heading, scale and drift,
    r_k(t) = r_k - J_k t + e_k.
The root of a pose's cost is a seminorm N of its residuals, no larger than that of their plain weighted sum, so the cost is
at least (min_t N(r - J t) - E)^2, E^2 = sum_k w_k |e_k|^2. That least square is itself bounded by Lagrangian duality: for
any u >= 0
    min_t N(r - J t)^2  >=  min_t [N(r - J t)^2 + sum_q u_q (t_q^2 - 1)],
a small linear system; u is what would hold each unknown alone at the end of its interval.
"""

import math

import numba
import numpy as np

from app.positioning.kernels import ROUNDING, SLACK, limit_of, spare_cost, to_sensor

__all__ = ["UNKNOWNS", "tangent_bounds"]

UNKNOWNS = 5
_ROUNDS = 3
_LEAST = 1e-6  # multiplier of what nothing is known about


@numba.njit(cache=True, nogil=True)
def tangent_bounds(nodes, bounds, priors, guesses, level, tree, scene, best, window):  # type: ignore[no-untyped-def]
    """Raise the bounds (k,) of nodes (k, 3) that are within their limits, given the least prior cost of each (k,).

    guesses (k,) get what the best pose of such a node would cost were there no remainders. Returns the samples compared.
    """
    place, exact, heading, size = tree.place, tree.exact, tree.heading, tree.size
    slope, reference, loose = tree.slope, tree.reference, tree.loose
    kind, ladder, turn, codes, places = scene.kind, scene.ladder, scene.turn, scene.codes, scene.places
    planes, plane_first = scene.planes, scene.plane_first
    has_offset, precision, relative, least = scene.offset
    courses, n, c = exact.shape[0], exact.shape[1], exact.shape[2]
    spare, square = spare_cost(level, scene.mean), scene.doubling[level]
    half = 0.5 * ((1 << level) - 1)
    J, r, turned = np.zeros((3, UNKNOWNS + 1)), np.zeros(3), np.zeros((3, UNKNOWNS + 1))
    A, B = np.empty((UNKNOWNS + 1, UNKNOWNS + 1)), np.empty((3, UNKNOWNS + 1))
    factor, solved, held = np.empty((UNKNOWNS, UNKNOWNS)), np.empty(UNKNOWNS), np.empty(UNKNOWNS)
    work = 0
    for p in range(len(nodes)):
        g, j, i = nodes[p, 0], nodes[p, 1], nodes[p, 2]
        limit = limit_of(size[g], spare, best, window)
        if bounds[p] > limit:
            continue
        work += n
        A[:] = 0.0
        B[:] = 0.0
        logs, spread, total = priors[p], 0.0, precision
        alone = g < courses
        q = g - courses
        for k in range(n):
            l = max(place[g, k, 2], square)
            base, shift = places[l, 0], places[l, 1]
            a = min(max((j + place[g, k, 0] + base) >> shift, 0), places[l, 2] - 1)
            b = min(max((i + place[g, k, 1] + base) >> shift, 0), places[l, 3] - 1)
            cell = a * places[l, 3] + b
            at, flat = places[l, 4] + cell, plane_first[l] + cell
            centre = 0.5 * (places[l, 5] + (1 << shift) - 2) - base
            down = j + half - ((a << shift) + centre)
            right = i + half - ((b << shift) + centre)
            if alone:
                down, right = down + place[g, k, 0], right + place[g, k, 1]
            else:
                down, right = down + reference[q, k, 0], right + reference[q, k, 1]
            w = ladder[kind[k], codes[at, 8 * c + 1], 1]
            logs += ladder[kind[k], codes[at, 8 * c], 2]
            total += w
            for m in range(c):
                value, sy, sx, apart = planes[flat, m], planes[flat, 3 + m], planes[flat, 6 + m], planes[flat, 9 + m]
                J[m, 0], J[m, 1] = half * sy, half * sx
                if alone:
                    J[m, 2], J[m, 3], J[m, 4] = 0.0, 0.0, 0.0
                    J[m, 5] = exact[g, k, m] - value - sy * down - sx * right
                else:
                    J[m, 5] = reference[q, k, 2 + m] - value - sy * down - sx * right
                    for d in range(3):
                        J[m, 2 + d] = sy * slope[q, k, d, 0] + sx * slope[q, k, d, 1]
                        if m < 2:
                            J[m, 2 + d] -= slope[q, k, d, 2 + m]
                    apart += abs(sy) * loose[q, k, 0] + abs(sx) * loose[q, k, 1]
                    if m < 2:
                        apart += loose[q, k, 2 + m]
                spread += w * apart * apart
            for x in range(UNKNOWNS + 1):
                for y in range(x + 1):
                    A[x, y] += w * (J[0, x] * J[0, y] + J[1, x] * J[1, y] + J[2, x] * J[2, y])
            if has_offset:
                for x in range(UNKNOWNS + 1):
                    east, north, up = J[0, x], J[1, x], J[2, x]
                    if scene.headed:
                        east, north = heading[g, 0] * east + heading[g, 1] * north, heading[g, 0] * north - heading[g, 1] * east
                    east, north, up = to_sensor(east, north, up, turn, k)
                    B[0, x], B[1, x], B[2, x] = B[0, x] + w * east, B[1, x] + w * north, B[2, x] + w * up
        if has_offset:
            logs += c * math.log(total / relative)
            for x in range(UNKNOWNS + 1):
                for y in range(x + 1):
                    A[x, y] -= (B[0, x] * B[0, y] + B[1, x] * B[1, y] + B[2, x] * B[2, y]) / total
        room = limit - logs
        bound = logs
        need = math.sqrt(max(room, 0.0)) + math.sqrt(spread)
        apart = _least_square(A, factor, solved, held, need * need)
        guesses[p] = logs + apart
        short = math.sqrt(max(apart, 0.0)) - math.sqrt(spread)
        if short > 0.0:
            bound += short * short * (1.0 - SLACK)
        bounds[p] = max(bounds[p], bound - ROUNDING * (abs(bound) + A[UNKNOWNS, UNKNOWNS]))
    return work


@numba.njit(cache=True, nogil=True)
def _least_square(A, factor, solved, held, enough):  # type: ignore[no-untyped-def]
    """At most the least N(r - J t)^2 over t in [-1, 1]; A holds the products of the columns of J, then those with r."""
    for x in range(UNKNOWNS):
        held[x] = max(_LEAST, 1e-9 * A[x, x])
    most = 0.0
    for _ in range(_ROUNDS):
        value = A[UNKNOWNS, UNKNOWNS]
        for x in range(UNKNOWNS):
            for y in range(x + 1):
                total = A[x, y]
                if x == y:
                    total = max(total, 0.0) + held[x]
                for z in range(y):
                    total -= factor[x, z] * factor[y, z]
                factor[x, y] = math.sqrt(max(total, 1e-12)) if x == y else total / factor[y, y]
            total = A[UNKNOWNS, x]
            for z in range(x):
                total -= factor[x, z] * solved[z]
            solved[x] = total / factor[x, x]
            value -= solved[x] * solved[x] + held[x]
        most = max(most, value)
        if most > enough:
            break
        changed = False
        for x in range(UNKNOWNS - 1, -1, -1):
            total = solved[x]
            for z in range(x + 1, UNKNOWNS):
                total -= factor[z, x] * solved[z]
            solved[x] = total / factor[x, x]
        for x in range(UNKNOWNS):
            outside = abs(solved[x])
            if outside > 1.0 or held[x] > 1e-3 * A[x, x]:
                held[x] = max(held[x] + (outside - 1.0) * (max(A[x, x], 0.0) + held[x]), _LEAST, 1e-9 * A[x, x])
                changed = True
        if not changed:
            break
    return most
