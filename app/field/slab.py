"""Cosines in three dimensions: a tile between two heights, for a field that changes with height.

Functions are products of cosines (Neumann walls, like `app.field.basis`) on a box, all those within a ball of
frequencies. A field component is their sum; or the functions are of a scalar potential and the field is minus its
gradient, `B = -grad phi`: then the three components share one set of weights, the field has no curl, and its
divergence is `-laplace phi`. Walls would force a potential's normal field to zero, so its box is larger than the tile
by a padding, and taller than the surveys (a thin one is wrong by several uT along the vertical).
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["SlabBasis"]


@dataclass(frozen=True, slots=True)
class SlabBasis:
    """Orthonormal functions on a box, `side_m` wide along x and y and `depth_m` along z, with lower `corner_m`.

    air_m: the heights between which people, robots and their sensors move.
    """

    corner_m: tuple[float, float, float]
    side_m: float
    depth_m: float
    cutoff_rad_per_m: float
    potential: bool
    air_m: tuple[float, float] = (0.0, 0.0)

    @property
    def dimensions(self) -> int:
        return 3

    @property
    def volume(self) -> float:
        return self.side_m**2 * self.depth_m

    @property
    def size(self) -> int:
        return len(self.orders)

    @property
    def orders(self) -> NDArray[np.int64]:
        """(m, 3) half waves of every function along x, y and z; of a potential the constant is left out."""
        return _orders(self.side_m, self.depth_m, self.cutoff_rad_per_m, self.potential)

    @property
    def frequencies_squared(self) -> Array:
        """(m,) eigenvalues of minus the Laplacian, (rad/m)^2."""
        return np.asarray(np.sum(np.square(np.pi / np.array(self._sides) * self.orders), axis=1))

    @property
    def rows_per_point(self) -> int:
        """Rows of the design matrix for one point: one, or one for each component of the field."""
        return 3 if self.potential else 1

    def at_origin(self) -> "SlabBasis":
        return replace(self, corner_m=(0.0, 0.0, 0.0))

    def rows(self, points_m: Array) -> Array:
        """(r, n, m) at points (n, 3): what every weight adds to the field; r is `rows_per_point`."""
        values, slopes, _ = self._along_all(points_m)
        if not self.potential:
            return np.asarray(self._products(values)[None])
        return -np.stack([self._products([*values[:k], slopes[k], *values[k + 1 :]]) for k in range(3)])

    def divergence_rows(self, points_m: Array) -> Array:
        """(n, m) what every weight of a potential adds to the divergence of the field at points (n, 3)."""
        values, _, _ = self._along_all(points_m)
        return self._products(values) * self.frequencies_squared

    def at(self, points_m: Array) -> Array:
        """(n, m) values of all functions at points (n, 3)."""
        return self._products(self._along_all(points_m)[0])

    def on_lattice(self, weights: Array, x_m: Array, y_m: Array, z_m: Array) -> tuple[Array, Array, Array]:
        """For weights (m, c), at heights, rows and columns: the functions' sum (c, nz, ny, nx), the field

        (the same, or of a potential (3, nz, ny, nx)) and the field's exact gradient (3, c, nz, ny, nx) over x, y and z.
        """
        tables = [self._along(axis, at) for axis, at in enumerate((x_m, y_m, z_m))]
        table = np.zeros((weights.shape[1], *(t[0].shape[1] for t in tables)))
        table[:, self.orders[:, 0], self.orders[:, 1], self.orders[:, 2]] = weights.T

        def derived(*axes: int) -> Array:
            """(c, nz, ny, nx) of the functions, derived once along each of these axes."""
            chosen = [tables[axis][axes.count(axis)] for axis in range(3)]
            return np.asarray(np.einsum("wabc,xa,yb,zc->wzyx", table, *chosen, optimize=True))

        if not self.potential:
            return derived(), derived(), np.stack([derived(axis) for axis in range(3)])
        field = np.concatenate([-derived(axis) for axis in range(3)])
        second = {(i, j): -derived(i, j) for i, j in product(range(3), repeat=2) if i <= j}
        gradient = np.stack([np.concatenate([second[min(i, j), max(i, j)] for j in range(3)]) for i in range(3)])
        return derived(), field, gradient

    @property
    def _sides(self) -> tuple[float, float, float]:
        return self.side_m, self.side_m, self.depth_m

    def _along_all(self, points_m: Array) -> tuple[list[Array], list[Array], list[Array]]:
        tables = [self._along(axis, points_m[:, axis]) for axis in range(3)]
        values, slopes, curvatures = ([np.ascontiguousarray(table[order].T) for table in tables] for order in range(3))
        return values, slopes, curvatures

    def _along(self, axis: int, coordinate_m: Array) -> tuple[Array, Array, Array]:
        """(n, k) functions of one axis, their first and their second derivatives."""
        side = self._sides[axis]
        k = np.pi / side * np.arange(int(self.orders[:, axis].max()) + 1)
        norm = np.where(k == 0.0, np.sqrt(1.0 / side), np.sqrt(2.0 / side))
        angle = np.multiply.outer(coordinate_m - self.corner_m[axis], k)
        cosine, sine = norm * np.cos(angle), norm * np.sin(angle)
        return cosine, -k * sine, -np.square(k) * cosine

    def _products(self, along: list[Array]) -> Array:
        """(n, m) products of one function of every axis, of tables (k, n)."""
        x, y, z = (table[self.orders[:, axis]] for axis, table in enumerate(along))
        return np.asarray((x * y * z).T)


@lru_cache(maxsize=8)
def _orders(side_m: float, depth_m: float, cutoff_rad_per_m: float, potential: bool) -> NDArray[np.int64]:
    most = [int(cutoff_rad_per_m * side / np.pi) + 1 for side in (side_m, side_m, depth_m)]
    grid = np.stack(np.meshgrid(*map(np.arange, most), indexing="ij"), axis=-1).reshape(-1, 3)
    frequency = np.pi * grid / np.array([side_m, side_m, depth_m])
    inside = np.sum(np.square(frequency), axis=1) <= cutoff_rad_per_m**2
    if potential:
        inside[0] = False
    orders = grid[inside]
    orders.setflags(write=False)
    return np.asarray(orders)
