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
    "DISPLACEMENT_SD_M", "POSITION_SD_FLOOR_M", "Atoms", "NarrowMode", "cell_atoms", "distinct_poses", "mass_radius",
    "mixture_points", "replace_narrow_modes", "untold_variance_m2",
]  # fmt: skip

POSITION_SD_FLOOR_M = 0.01  # of the map's coordinates; with the next, what calibrates on analytic buildings
DISPLACEMENT_SD_M = 0.024  # random walk of a window's displacements, per root of a metre
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


@dataclass(frozen=True, slots=True, eq=False)
class NarrowMode:
    """A refined mode: its Gaussian on a plane of cells `cell_m`, and its Laplace mass."""

    plane: int
    position_m: Array
    covariance_m2: Array
    mass: float
    cell_m: float

    @property
    def widest_m(self) -> float:
        return float(np.sqrt(np.linalg.eigvalsh(self.covariance_m2)[-1]))


def untold_variance_m2(path_m: Array) -> float:
    """Variance per axis of the last position that matching leaves, from the distances walked (n,).

    Place, heading and scale of a window are fitted; what its displacements err beyond that is still in its last one.
    """
    length_m = float(path_m[-1] - path_m[0])
    return POSITION_SD_FLOOR_M**2 + _LEFT_AT_THE_END * DISPLACEMENT_SD_M**2 * length_m


def distinct_poses(
    plane: NDArray[np.int64], position_m: Array, heading_rad: Array, apart_m: float, apart_rad: float, limit: int
) -> NDArray[np.int64]:
    """Non-maximum suppression: indices of poses, which come best first, none like a better one in place and heading."""
    left = np.ones(len(plane), dtype=bool)
    chosen: list[int] = []
    while len(chosen) < limit and left.any():
        peak = int(np.argmax(left))
        chosen.append(peak)
        near = left & (plane == plane[peak])
        near[near] = np.linalg.norm(position_m[near] - position_m[peak], axis=1) < apart_m
        near[near] = np.abs(np.angle(np.exp(1j * (heading_rad[near] - heading_rad[peak])))) < apart_rad
        left[near] = False
        left[peak] = False
    return np.array(chosen)


def replace_narrow_modes(atoms: Atoms, modes: Sequence[NarrowMode], untold_m2: float) -> Atoms:
    """Exchange the atoms around modes narrower than a cell for their Gaussians; wider modes stay as they are."""
    narrow = [mode for mode in modes if mode.widest_m < mode.cell_m]
    if not narrow:
        return atoms
    near = np.zeros(len(atoms.mass), dtype=np.bool_)
    for mode in narrow:
        reach_m = 3.0 * mode.widest_m + 1.5 * mode.cell_m
        near |= (atoms.plane == mode.plane) & (np.linalg.norm(atoms.position_m - mode.position_m, axis=1) < reach_m)
    kept = atoms.on(~near)
    return Atoms(
        np.append(kept.plane, [mode.plane for mode in narrow]),
        np.vstack([kept.position_m, *(mode.position_m for mode in narrow)]),
        np.append(kept.mass, [mode.mass for mode in narrow]),
        np.concatenate([kept.covariance_m2, *((mode.covariance_m2 + untold_m2 * np.eye(2))[None] for mode in narrow)]),
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
