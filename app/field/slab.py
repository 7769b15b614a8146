"""Cosines in three dimensions: a tile between two heights, for a field that changes with height.

Functions are products of cosines (Neumann walls, like `app.field.basis`) on a box, all those within a ball of
frequencies. A field component is their sum; or the functions are of a scalar potential and the field is minus its
gradient, `B = -grad phi`: then the three components share one set of weights, the field has no curl, and its
divergence is `-laplace phi`. Walls would force a potential's normal field to zero, so its box is larger than the tile
by a padding, and taller than the surveys (a thin one is wrong by several uT along the vertical). Between walls there is
no uniform field either, and a potential of short length has hardly any: what is longer than the box, which steel far
away makes, is a few harmonic polynomials more, fields that are uniform or change linearly.
"""

from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["SlabBasis"]

_X, _Y, _Z = np.eye(3)


def _symmetric(a: Array, b: Array) -> Array:
    return np.asarray(np.outer(a, b) + np.outer(b, a))


_UNIFORM = np.concatenate([np.eye(3), np.zeros((5, 3))])
_LINEAR = np.sqrt(0.9) * np.stack(
    [
        *np.zeros((3, 3, 3)),
        *(_symmetric(a, b) for a, b in ((_X, _Y), (_X, _Z), (_Y, _Z))),
        np.diag([1.0, -1.0, 0.0]),
        np.diag([-1.0, -1.0, 2.0]) / np.sqrt(3.0),
    ]
)
"""Long waves: the field `g + A r`, r from the middle in half sides of the box; without curl or sources, isotropic."""


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
        return len(self.orders) + self.long_waves

    @property
    def about_size(self) -> float:
        """The size, from the volume and surface of the box, before anything is made of it."""
        k, edges_m = self.cutoff_rad_per_m, 2.0 * self.side_m + self.depth_m
        surface = 2.0 * self.side_m * (self.side_m + 2.0 * self.depth_m)
        return float(
            self.volume * k**3 / (6.0 * np.pi**2) + surface * k**2 / (16.0 * np.pi) + edges_m * k / (4.0 * np.pi)
        )

    @property
    def long_waves(self) -> int:
        """How many of the functions, the last ones, are longer than the box."""
        return len(_UNIFORM) if self.potential else 0

    @property
    def orders(self) -> NDArray[np.int64]:
        """(m - long waves, 3) half waves of every cosine along x, y and z; of a potential the constant is left out."""
        return _orders(self.side_m, self.depth_m, self.cutoff_rad_per_m, self.potential)

    @property
    def frequencies_squared(self) -> Array:
        """(m,) eigenvalues of minus the Laplacian, (rad/m)^2; of long waves zero."""
        cosines = np.sum(np.square(np.pi / np.array(self._sides) * self.orders), axis=1)
        return np.concatenate([cosines, np.zeros(self.long_waves)])

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
        cosines = -np.stack([self._products([*values[:k], slopes[k], *values[k + 1 :]]) for k in range(3)])
        linear = np.einsum("hab,nb->anh", _LINEAR, self._from_middle(points_m))
        return np.concatenate([cosines, _UNIFORM.T[:, None] + linear], axis=2)

    def divergence_rows(self, points_m: Array) -> Array:
        """(n, m) what every weight of a potential adds to the divergence of the field at points (n, 3)."""
        values, _, _ = self._along_all(points_m)
        cosines = self._products(values)
        return np.pad(cosines, ((0, 0), (0, self.long_waves))) * self.frequencies_squared

    def at(self, points_m: Array) -> Array:
        """(n, m) values of all functions at points (n, 3)."""
        cosines = self._products(self._along_all(points_m)[0])
        if not self.potential:
            return cosines
        r = self._from_middle(points_m)
        long = r @ _UNIFORM.T + 0.5 * np.einsum("na,hab,nb->nh", r, _LINEAR, r)
        return np.concatenate([cosines, -0.5 * self.side_m * long], axis=1)

    def on_lattice(self, weights: Array, x_m: Array, y_m: Array, z_m: Array) -> tuple[Array, Array, Array]:
        """For weights (m, c), at heights, rows and columns: the functions' sum (c, nz, ny, nx), the field

        (the same, or of a potential (3, nz, ny, nx)) and the field's exact gradient (3, c, nz, ny, nx) over x, y and z.
        """
        tables = [self._along(axis, at) for axis, at in enumerate((x_m, y_m, z_m))]
        table = np.zeros((weights.shape[1], *(t[0].shape[1] for t in tables)))
        table[:, self.orders[:, 0], self.orders[:, 1], self.orders[:, 2]] = weights[: len(self.orders)].T

        def derived(*axes: int) -> Array:
            """(c, nz, ny, nx) of the functions, derived once along each of these axes."""
            chosen = [tables[axis][axes.count(axis)] for axis in range(3)]
            return np.asarray(np.einsum("wabc,xa,yb,zc->wzyx", table, *chosen, optimize=True))

        if not self.potential:
            return derived(), derived(), np.stack([derived(axis) for axis in range(3)])
        field = np.concatenate([-derived(axis) for axis in range(3)])
        second = {(i, j): -derived(i, j) for i, j in product(range(3), repeat=2) if i <= j}
        gradient = np.stack([np.concatenate([second[min(i, j), max(i, j)] for j in range(3)]) for i in range(3)])
        long_potential, long_field, long_gradient = self._long_waves(weights[len(self.orders) :, 0], x_m, y_m, z_m)
        return derived() + long_potential, field + long_field, gradient + long_gradient[..., None, None, None]

    def _long_waves(self, weights: Array, x_m: Array, y_m: Array, z_m: Array) -> tuple[Array, Array, Array]:
        """Of weights (8,): potential (nz, ny, nx), field (3, nz, ny, nx) and the field's gradient (3, 3)."""
        z, y, x = np.meshgrid(z_m, y_m, x_m, indexing="ij")
        r = self._from_middle(np.stack([x, y, z], axis=-1))
        uniform, linear = weights @ _UNIFORM, np.tensordot(weights, _LINEAR, axes=1)
        potential = -0.5 * self.side_m * np.sum(r * (uniform + 0.5 * r @ linear), axis=-1)
        return potential, np.moveaxis(uniform + r @ linear, -1, 0), 2.0 / self.side_m * linear

    def _from_middle(self, points_m: Array) -> Array:
        """(..., 3) in half sides of the box."""
        middle_m = np.array(self.corner_m) + 0.5 * np.array(self._sides)
        return np.asarray((points_m - middle_m) / (0.5 * self.side_m))

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
