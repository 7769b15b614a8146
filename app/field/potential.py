"""Blending tiles of a curl-free field: what is blended is the potential, so the seams have no curl either.

`phi = sum_t w_t (phi_t + c_t)` and `B = -grad phi = sum_t w_t B_t - grad w_t (phi_t + c_t)`. A tile knows its potential
up to a constant, so the constants c are chosen first, for neighbours to agree along their common borders: least squares
over all tiles, each point of a border weighted by how well the two know the field there (past the last sample a
potential is a guess). Where a tile has no neighbour its weight falls off to nothing: there the field fades, not the
potential.
"""

from collections.abc import Mapping

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.linalg import spsolve

from app.field.hilbert import Patch
from app.field.raster import Blended, GridFrame, placed
from app.field.tiles import Lattice, Tile
from app.geometry import Array

__all__ = ["blend_potentials", "matching_constants"]

LEFT, RIGHT, LOWER, UPPER = range(4)
WELL_KNOWN = 1e-3
"""Variance of the field, over the signal's, below which a border counts in full."""
HARDLY = 1e-9
"""Weight of a constant's own size: it only settles what the borders leave open."""


def blend_potentials(
    lattice: Lattice,
    frame: GridFrame,
    resolution_m: float,
    patches: Mapping[Tile, Patch],
    borders: Mapping[Tile, Array],
) -> Blended:
    """The curl-free field of all tiles; borders: see TileFit."""
    constants = matching_constants(borders)
    places = {tile: placed(lattice, frame, resolution_m, tile) for tile in patches}
    weight, phi = np.zeros((2, *frame.shape))
    mean, variance = np.zeros((3, *frame.shape)), np.ones((3, *frame.shape))
    hessian = np.zeros((6, *frame.shape))  # of minus the potential: xx, xy, yy, xz, yz, zz
    for tile, patch in patches.items():
        p = places[tile]
        weight[p.cells] += p.weight
        phi[p.cells] += p.weight * (_potential(p.of(patch)) + constants[tile])
    phi /= np.maximum(weight, 1e-12)
    for tile, patch in patches.items():
        p = places[tile]
        own = p.of(patch)
        excess = _potential(own) + constants[tile] - phi[p.cells]
        sx, sy = p.slope
        cxx, cxy, cyy = p.curvature
        bx, by, bz = own.mean_uT
        g = own.gradient_uT_per_m
        mean[p.cells] += p.weight * own.mean_uT
        mean[0][p.cells] -= sx * excess
        mean[1][p.cells] -= sy * excess
        hessian[0][p.cells] += p.weight * g[0, 0] + 2.0 * sx * bx - cxx * excess
        hessian[1][p.cells] += p.weight * g[0, 1] + sx * by + sy * bx - cxy * excess
        hessian[2][p.cells] += p.weight * g[1, 1] + 2.0 * sy * by - cyy * excess
        hessian[3][p.cells] += p.weight * g[0, 2] + sx * bz
        hessian[4][p.cells] += p.weight * g[1, 2] + sy * bz
        hessian[5][p.cells] += p.weight * g[2, 2]
        variance[p.cells] += p.weight * (own.variance_ratio - 1.0)
    xx, xy, yy, xz, yz, zz = hessian
    return Blended(mean, np.stack([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), variance)


def matching_constants(borders: Mapping[Tile, Array]) -> dict[Tile, float]:
    """The constant of every tile's potential, uT m, with which neighbours agree best along their common borders."""
    index = {tile: number for number, tile in enumerate(borders)}
    rows, columns, values = list(range(len(index))), list(range(len(index))), [HARDLY] * len(index)
    right_hand = np.zeros(len(index))
    for tile, own in borders.items():
        for right, up, mine, theirs in ((1, 0, RIGHT, LEFT), (0, 1, UPPER, LOWER)):
            other = Tile(tile.column + right, tile.row + up)
            if other not in index:
                continue
            difference, _ = borders[other][:, theirs] - own[:, mine]
            known = WELL_KNOWN / (WELL_KNOWN + borders[other][1, theirs] + own[1, mine])
            a, b = index[tile], index[other]
            rows += [a, a, b, b]
            columns += [a, b, b, a]
            values += [known.sum(), -known.sum()] * 2
            right_hand[a] += known @ difference
            right_hand[b] -= known @ difference
    matrix = coo_array((values, (rows, columns)), shape=(len(index), len(index))).tocsc()
    return dict(zip(index, np.atleast_1d(spsolve(matrix, right_hand)).tolist(), strict=True))


def _potential(patch: Patch) -> Array:
    assert patch.potential_uT_m is not None
    return patch.potential_uT_m
