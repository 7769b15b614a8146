"""Eigenfunctions of the Laplacian on a square box, with reflecting walls (Neumann): products of cosines.

`f(p) = sum_j w_j phi_j(p)` with `w_j ~ N(0, S(w_j))` approximates a stationary Gaussian process (Solin & Sarkka 2020).
Reflecting walls let samples lie up to the wall: the prior is doubled there, where absorbing walls (sines) would force
the field to the ambient value. Products of cosines are sums of cosines, so the posterior variance is itself a cosine
series of twice the degree: `VarianceSeries` evaluates it exactly at any number of points without touching the
covariance again.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from app.geometry import Array

__all__ = ["CosineBasis", "VarianceSeries"]


@dataclass(frozen=True, slots=True)
class CosineBasis:
    """`functions_per_axis`^2 orthonormal functions on the square of side `side_m` with lower corner `corner_m`.

    Function j = a * functions_per_axis + b is `phi_a(x) phi_b(y)`.
    """

    corner_m: tuple[float, float]
    side_m: float
    functions_per_axis: int

    @property
    def size(self) -> int:
        return self.functions_per_axis**2

    @property
    def frequencies_squared(self) -> Array:
        """(m,) eigenvalues of minus the Laplacian, (rad/m)^2."""
        axis = np.square(np.pi / self.side_m * np.arange(self.functions_per_axis))
        return np.asarray((axis[:, None] + axis[None, :]).ravel())

    @property
    def cutoff_rad_per_m(self) -> float:
        """Radius of the disc of as much area as the square of frequencies the functions reach."""
        return float(2.0 / np.sqrt(np.pi) * np.pi / self.side_m * (self.functions_per_axis - 0.5))

    def along(self, axis: int, coordinate_m: Array) -> Array:
        """(n, functions_per_axis) values of the functions of one axis (0: x, 1: y)."""
        return self._norms() * np.cos(self._angles(axis, coordinate_m))

    def slope_along(self, axis: int, coordinate_m: Array) -> Array:
        """(n, functions_per_axis) exact derivatives of `along` with the coordinate, per metre."""
        k = np.pi / self.side_m * np.arange(self.functions_per_axis)
        return -self._norms() * k * np.sin(self._angles(axis, coordinate_m))

    def at(self, points_m: Array) -> Array:
        """(n, m) values of all functions at points (n, 2)."""
        x, y = self.along(0, points_m[:, 0]), self.along(1, points_m[:, 1])
        return (x[:, :, None] * y[:, None, :]).reshape(len(points_m), self.size)

    def _angles(self, axis: int, coordinate_m: Array) -> Array:
        unit = np.pi / self.side_m * (coordinate_m - self.corner_m[axis])
        return np.asarray(np.multiply.outer(unit, np.arange(self.functions_per_axis)))

    def _norms(self) -> Array:
        norms = np.full(self.functions_per_axis, np.sqrt(2.0 / self.side_m))
        norms[0] = np.sqrt(1.0 / self.side_m)
        return norms


@dataclass(frozen=True, slots=True)
class VarianceSeries:
    """The variance `phi(p)^T C phi(p)` as a cosine series; `coefficients` (2k - 1, 2k - 1) over x and y."""

    basis: CosineBasis
    coefficients: Array

    @classmethod
    def of(cls, basis: CosineBasis, covariance: Array) -> "VarianceSeries":
        """From the covariance (m, m) of the weights."""
        k = basis.functions_per_axis
        products = _products_of_cosines(k) / basis.side_m
        by_axis = covariance.reshape(k, k, k, k).transpose(0, 2, 1, 3).reshape(k * k, k * k)
        return cls(basis, products.T @ by_axis @ products)

    def along(self, axis: int, coordinate_m: Array) -> Array:
        """(n, 2k - 1) cosines of one axis."""
        unit = np.pi / self.basis.side_m * (coordinate_m - self.basis.corner_m[axis])
        return np.cos(np.multiply.outer(unit, np.arange(2 * self.basis.functions_per_axis - 1)))

    def at(self, points_m: Array) -> Array:
        """(n,) variance at points (n, 2)."""
        x, y = self.along(0, points_m[:, 0]), self.along(1, points_m[:, 1])
        return np.asarray(np.maximum(np.sum((x @ self.coefficients) * y, axis=1), 0.0))

    def on_lattice(self, x_m: Array, y_m: Array) -> Array:
        """(ny, nx) variance at the crossings of columns and rows."""
        series = self.along(1, y_m) @ self.coefficients.T @ self.along(0, x_m).T
        return np.asarray(np.maximum(series, 0.0))


@lru_cache(maxsize=8)
def _products_of_cosines(k: int) -> Array:
    """(k^2, 2k - 1): side * phi_a phi_b = sum over d of row (a, b) times cos(d ...), both functions orthonormal."""
    norms = np.full(k, np.sqrt(2.0))
    norms[0] = 1.0
    products = np.zeros((k, k, 2 * k - 1))
    a, b = np.meshgrid(np.arange(k), np.arange(k), indexing="ij")
    half = 0.5 * norms[a] * norms[b]
    np.add.at(products, (a, b, np.abs(a - b)), half)
    np.add.at(products, (a, b, a + b), half)
    return products.reshape(k * k, 2 * k - 1)
