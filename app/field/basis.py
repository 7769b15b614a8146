"""Eigenfunctions of the Laplacian on a square box, with reflecting walls (Neumann): products of cosines.

`f(p) = sum_j w_j phi_j(p)` with `w_j ~ N(0, S(w_j))` approximates a stationary Gaussian process (Solin & Sarkka 2020).
Reflecting walls let samples lie up to the wall: the prior is doubled there, where absorbing walls (sines) would force
the field to the ambient value. Of all products those within a disc of frequencies are kept, the likeliest of an
isotropic field. Products of cosines are sums of cosines, which `app.field.moments` makes use of.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array

__all__ = ["CosineBasis"]


@dataclass(frozen=True, slots=True)
class CosineBasis:
    """Orthonormal functions on the square of side `side_m` with lower corner `corner_m`.

    Function j is `phi_a(x) phi_b(y)` with (a, b) row j of `orders`: all `a^2 + b^2 < functions_per_axis^2`.
    """

    corner_m: tuple[float, float]
    side_m: float
    functions_per_axis: int

    @property
    def dimensions(self) -> int:
        return 2

    @property
    def potential(self) -> bool:
        return False

    @property
    def volume(self) -> float:
        return self.side_m**2

    @property
    def size(self) -> int:
        return len(self.orders)

    @property
    def rows_per_point(self) -> int:
        return 1

    def at_origin(self) -> "CosineBasis":
        return CosineBasis((0.0, 0.0), self.side_m, self.functions_per_axis)

    def rows(self, points_m: Array) -> Array:
        """(1, n, m) values of all functions at points (n, 2) or (n, 3), whose height is not looked at."""
        return self.at(points_m)[None]

    @property
    def orders(self) -> NDArray[np.int64]:
        """(m, 2) half waves of every function along x and y, in order of x, then of y."""
        return _orders(self.functions_per_axis)

    @property
    def frequencies_squared(self) -> Array:
        """(m,) eigenvalues of minus the Laplacian, (rad/m)^2."""
        return _frequencies_squared(self.side_m, self.functions_per_axis)

    @property
    def norms(self) -> Array:
        """(m,) factor of the product of cosines in every function, 1/m."""
        return _norms(self.side_m, self.functions_per_axis)

    @property
    def cutoff_rad_per_m(self) -> float:
        """Radius of the disc of frequencies the functions stand for: a unit cell each, half of one on an axis."""
        cells = self.size - self.functions_per_axis + 0.25
        return float(np.pi / self.side_m * np.sqrt(4.0 / np.pi * cells))

    def along(self, axis: int, coordinate_m: Array) -> Array:
        """(n, functions_per_axis) values of the functions of one axis (0: x, 1: y)."""
        return _axis_norms(self.side_m, self.functions_per_axis) * np.cos(self._angles(axis, coordinate_m))

    def slope_along(self, axis: int, coordinate_m: Array) -> Array:
        """(n, functions_per_axis) exact derivatives of `along` with the coordinate, per metre."""
        k = np.pi / self.side_m * np.arange(self.functions_per_axis)
        return -_axis_norms(self.side_m, self.functions_per_axis) * k * np.sin(self._angles(axis, coordinate_m))

    def at(self, points_m: Array) -> Array:
        """(n, m) values of all functions at points (n, 2)."""
        x, y = self.along(0, points_m[:, 0]), self.along(1, points_m[:, 1])
        return np.asarray(x[:, self.orders[:, 0]] * y[:, self.orders[:, 1]])

    def by_axis(self, weights: Array) -> Array:
        """(c, functions_per_axis, functions_per_axis) weights (m, c) over the functions of y and of x."""
        k = self.functions_per_axis
        table = np.zeros((weights.shape[1], k, k))
        table[:, self.orders[:, 1], self.orders[:, 0]] = weights.T
        return table

    def _angles(self, axis: int, coordinate_m: Array) -> Array:
        unit = np.pi / self.side_m * (coordinate_m - self.corner_m[axis])
        return np.asarray(np.multiply.outer(unit, np.arange(self.functions_per_axis)))


@lru_cache(maxsize=8)
def _orders(functions_per_axis: int) -> NDArray[np.int64]:
    a, b = np.meshgrid(np.arange(functions_per_axis), np.arange(functions_per_axis), indexing="ij")
    inside = a**2 + b**2 < functions_per_axis**2
    orders = np.column_stack([a[inside], b[inside]])
    orders.setflags(write=False)
    return orders


@lru_cache(maxsize=8)
def _axis_norms(side_m: float, functions_per_axis: int) -> Array:
    norms = np.full(functions_per_axis, np.sqrt(2.0 / side_m))
    norms[0] = np.sqrt(1.0 / side_m)
    norms.setflags(write=False)
    return norms


@lru_cache(maxsize=8)
def _norms(side_m: float, functions_per_axis: int) -> Array:
    norms = np.prod(_axis_norms(side_m, functions_per_axis)[_orders(functions_per_axis)], axis=1)
    norms.setflags(write=False)
    return np.asarray(norms)


@lru_cache(maxsize=8)
def _frequencies_squared(side_m: float, functions_per_axis: int) -> Array:
    squared = np.sum(np.square(np.pi / side_m * _orders(functions_per_axis)), axis=1)
    squared.setflags(write=False)
    return np.asarray(squared)
