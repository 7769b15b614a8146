"""The belief over places: atoms of mass, modes among them, and radii that hold their stated mass.

The atoms are the searched poses, each spread over its cell. Where a mode is narrower than a cell the lattice cannot
resolve it: there the refined Gaussian takes the place of the poses around it, with its Laplace mass. Every atom is
widened by what no match can tell: errors of map coordinates, and of the distance from the window's middle to its end.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array

__all__ = [
    "DISPLACEMENT_SD_M", "POSITION_SD_FLOOR_M", "Atoms", "cell_atoms", "find_modes", "mass_radius",
    "mixture_points", "replace_narrow_mode", "untold_variance_m2",
]  # fmt: skip

POSITION_SD_FLOOR_M = 0.03  # of the map's coordinates
DISPLACEMENT_SD_M = 0.03  # random walk of a window's displacements, per root of a metre
_LEFT_AT_THE_END = 2.0 / 15.0  # of a random walk's variance, when its mean and trend are fitted out
_RINGS, _SPOKES = 24, 12
_MANY = 4000


@dataclass(slots=True, eq=False)
class Atoms:
    """Mass at places: plane (n,), position_m (n, 2), mass (n,), covariance_m2 (n, 2, 2)."""

    plane: NDArray[np.int64]
    position_m: Array
    mass: Array
    covariance_m2: Array

    def on(self, chosen: NDArray[np.bool_]) -> "Atoms":
        return Atoms(self.plane[chosen], self.position_m[chosen], self.mass[chosen], self.covariance_m2[chosen])


def untold_variance_m2(path_m: Array) -> float:
    """Variance per axis of the last position that matching leaves, from the distances walked (n,).

    Place, heading and scale of a window are fitted; what its displacements err beyond that is still in its last one.
    """
    length_m = float(path_m[-1] - path_m[0])
    return POSITION_SD_FLOOR_M**2 + _LEFT_AT_THE_END * DISPLACEMENT_SD_M**2 * length_m


def find_modes(
    plane: NDArray[np.int64], position_m: Array, score: Array, separation_m: float, limit: int
) -> list[NDArray[np.int64]]:
    """Non-maximum suppression: modes by descending peak, each the indices of poses within `separation_m` of it."""
    left = np.ones(len(score), dtype=bool)
    order = np.argsort(-score, kind="stable")
    modes: list[NDArray[np.int64]] = []
    for peak in order:
        if not left[peak]:
            continue
        near = left & (plane == plane[peak])
        near[near] = np.linalg.norm(position_m[near] - position_m[peak], axis=1) < separation_m
        members = order[near[order]]
        modes.append(members)
        left[members] = False
        if len(modes) == limit:
            break
    return modes


def replace_narrow_mode(
    atoms: Atoms,
    plane: int,
    position_m: Array,
    covariance_m2: Array,
    laplace_mass: float,
    cell_m: float,
    untold_m2: float,
) -> Atoms:
    """Exchange the atoms around a mode narrower than a cell for its Gaussian; wider modes stay as they are."""
    widest = float(np.sqrt(np.linalg.eigvalsh(covariance_m2)[-1]))
    if widest >= cell_m:
        return atoms
    near = (atoms.plane == plane) & (
        np.linalg.norm(atoms.position_m - position_m, axis=1) < 3.0 * widest + 1.5 * cell_m
    )
    kept = atoms.on(~near)
    return Atoms(
        np.append(kept.plane, plane),
        np.vstack([kept.position_m, position_m]),
        np.append(kept.mass, laplace_mass),
        np.concatenate([kept.covariance_m2, (covariance_m2 + untold_m2 * np.eye(2))[None]]),
    )


def mixture_points(atoms: Atoms) -> tuple[Array, Array]:
    """Points (k, 2) and masses (k,) that stand for the mixture: rings of equal probability about every atom.

    Light atoms are taken with fewer points; one each where there are thousands of them.
    """
    heavy = atoms.mass > 0.01 * atoms.mass.sum()
    light = atoms.on(~heavy)
    many = len(light.mass) > _MANY
    parts = [
        _rings(atoms.on(heavy), _RINGS, _SPOKES),
        (light.position_m, light.mass) if many else _rings(light, 2, 4),
    ]
    return np.concatenate([p for p, _ in parts]), np.concatenate([m for _, m in parts])


def cell_atoms(
    plane: NDArray[np.int64],
    row: NDArray[np.int64],
    column: NDArray[np.int64],
    position_m: Array,
    mass: Array,
    cell_m: Array,
    untold_m2: float,
) -> Atoms:
    """Atoms of the cells that poses (n,) fall in, headings summed, each spread over its cell (side `cell_m` (n,))."""
    key = np.stack([plane, row, column], axis=1)
    _, first, group = np.unique(key, axis=0, return_index=True, return_inverse=True)
    total = np.asarray(np.bincount(group.ravel(), weights=mass), dtype=np.float64)
    spread = np.square(cell_m[first]) / 12.0 + untold_m2
    return Atoms(plane[first], position_m[first], total, spread[:, None, None] * np.eye(2))


def mass_radius(points_m: Array, mass: Array, centre_m: Array, shares: Sequence[float]) -> tuple[float, ...]:
    """Radii about `centre_m` that hold the given shares of the mass."""
    distance = np.linalg.norm(points_m - centre_m, axis=1)
    order = np.argsort(distance, kind="stable")
    held = np.cumsum(mass[order]) / mass.sum()
    at = np.minimum(np.searchsorted(held, shares), len(order) - 1)
    return tuple(float(r) for r in distance[order[at]])


def _rings(atoms: Atoms, rings: int, spokes: int) -> tuple[Array, Array]:
    radius = np.sqrt(-2.0 * np.log1p(-(np.arange(rings) + 0.5) / rings))
    angle = 2.0 * np.pi * np.arange(spokes) / spokes
    disc = np.stack([np.outer(radius, np.cos(angle)).ravel(), np.outer(radius, np.sin(angle)).ravel()], axis=1)
    if not len(atoms.mass):
        return np.empty((0, 2)), np.empty(0)
    spread = np.einsum("kij,dj->kdi", np.linalg.cholesky(atoms.covariance_m2), disc)
    points = (atoms.position_m[:, None, :] + spread).reshape(-1, 2)
    return points, np.repeat(atoms.mass / len(disc), len(disc))
