"""Products of cosines are sums of cosines: Gram matrices and variances of a cosine basis by way of small tables.

`cos s cos t = (cos(s - t) + cos(s + t)) / 2`, so with the moments of the points, over u, v = pi (p - corner) / side,

    M[p, q] = sum_i cos(p u_i) cos(q v_i),      p, q < 2 k - 1,

every entry of `Phi^T Phi` is a sum of four of them:

    G[i, j] = norm_i norm_j (M[|a - a'|, |b - b'|] + M[a + a', |b - b'|] + M[|a - a'|, b + b'] + M[a + a', b + b']) / 4,

(a, b) and (a', b') being the orders of functions i and j: n (2 k)^2 operations for n points where the direct product
takes n m^2. Backwards, the variance `phi(p)^T C phi(p)` of weights of covariance C is a cosine series of twice the
degree, whose (2 k - 1, 2 k - 1) coefficients every entry of C adds to in four places: exact anywhere for the price
of the mean.
"""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.field.basis import CosineBasis
from app.geometry import Array

__all__ = [
    "VarianceSeries",
    "cosines",
    "gram_of_moments",
    "moments_of",
    "scaled_functions",
    "scaled_functions_on_lattice",
]


def cosines(basis: CosineBasis, axis: int, coordinate_m: Array) -> Array:
    """(n, 2k - 1) `cos(p u)` of one axis (0: x, 1: y), twice the degree of the functions."""
    return np.asarray(_chebyshev(_cosine(basis, axis, coordinate_m), 2 * basis.functions_per_axis - 1))


def scaled_functions(basis: CosineBasis, points_m: Array, scale: Array) -> Array:
    """`diag(scale) Phi^T` (m, n) at points (n, 2), scale (m,), in Fortran order."""
    x, y = _cosine(basis, 0, points_m[:, 0]), _cosine(basis, 1, points_m[:, 1])
    return np.asarray(_functions(x, y, basis.orders, scale * basis.norms, basis.functions_per_axis).T)


def scaled_functions_on_lattice(basis: CosineBasis, cosines_x: Array, cosines_y: Array, scale: Array) -> Array:
    """`scaled_functions` at the crossings of rows and columns with these `cosines`, row after row."""
    return np.asarray(_on_lattice(cosines_x, cosines_y, basis.orders, scale * basis.norms).T)


def moments_of(basis: CosineBasis, points_m: Array, features: Array) -> tuple[Array, Array]:
    """The moments (2k - 1, 2k - 1) of points (n, 2), and `Phi^T features` (m, c) for features (n, c)."""
    x, y = _cosine(basis, 0, points_m[:, 0]), _cosine(basis, 1, points_m[:, 1])
    moments, weighted = _moments(x, y, features, basis.functions_per_axis)
    return moments, basis.norms[:, None] * weighted[basis.orders[:, 0], basis.orders[:, 1]]


def _cosine(basis: CosineBasis, axis: int, coordinate_m: Array) -> Array:
    return np.asarray(np.cos(np.pi / basis.side_m * (coordinate_m - basis.corner_m[axis])))


def gram_of_moments(basis: CosineBasis, moments: Array, scale: Array) -> Array:
    """`diag(scale) Phi^T Phi diag(scale)` (m, m) of the points of these moments, scale (m,).

    Only the lower triangle, in Fortran order for LAPACK; the other is zero.
    """
    return np.asarray(_gram(moments, basis.orders, scale * basis.norms).T)


@dataclass(frozen=True, slots=True)
class VarianceSeries:
    """The variance `phi(p)^T C phi(p)` as a cosine series; `coefficients` (2k - 1, 2k - 1) over x and y."""

    basis: CosineBasis
    coefficients: Array

    @classmethod
    def of(cls, basis: CosineBasis, covariance: Array, scale: Array) -> "VarianceSeries":
        """From `diag(scale) covariance diag(scale)` of the weights; only the lower triangle (m, m) is read."""
        upper = np.ascontiguousarray(covariance.T)
        return cls(basis, _series(upper, basis.orders, scale * basis.norms, 2 * basis.functions_per_axis - 1))

    def at(self, points_m: Array) -> Array:
        """(n,) variance at points (n, 2)."""
        x, y = cosines(self.basis, 0, points_m[:, 0]), cosines(self.basis, 1, points_m[:, 1])
        return np.asarray(np.maximum(np.sum((x @ self.coefficients) * y, axis=1), 0.0))

    def on_lattice(self, cosines_x: Array, cosines_y: Array) -> Array:
        """(ny, nx) variance at the crossings of columns and rows with these `cosines` (nx, 2k - 1), (ny, 2k - 1)."""
        return np.asarray(np.maximum(cosines_y @ self.coefficients.T @ cosines_x.T, 0.0))


@njit(cache=True)
def _chebyshev(cosine: Array, degrees: int) -> Array:
    """(n, degrees) `cos(p u)` from `cos u` (n,): `cos((p + 1) u) = 2 cos u cos(p u) - cos((p - 1) u)`."""
    table = np.empty((len(cosine), degrees))
    for i in range(len(cosine)):
        table[i, 0] = 1.0
        if degrees > 1:
            table[i, 1] = cosine[i]
        for p in range(2, degrees):
            table[i, p] = 2.0 * cosine[i] * table[i, p - 1] - table[i, p - 2]
    return table


@njit(cache=True)
def _functions(x: Array, y: Array, orders: NDArray[np.int64], scale: Array, degrees: int) -> Array:
    """(n, m) scaled products of the cosines of u and v, from `cos u` and `cos v` (n,)."""
    along_x, along_y = _chebyshev(x, degrees), _chebyshev(y, degrees)
    values = np.empty((len(x), len(orders)))
    for i in range(len(x)):
        for j in range(len(orders)):
            values[i, j] = scale[j] * along_x[i, orders[j, 0]] * along_y[i, orders[j, 1]]
    return values


@njit(cache=True)
def _on_lattice(along_x: Array, along_y: Array, orders: NDArray[np.int64], scale: Array) -> Array:
    """(ny nx, m) scaled products of the cosines of rows (ny, k) and columns (nx, k)."""
    values = np.empty((len(along_y) * len(along_x), len(orders)))
    for y in range(len(along_y)):
        for x in range(len(along_x)):
            for j in range(len(orders)):
                values[y * len(along_x) + x, j] = scale[j] * along_x[x, orders[j, 0]] * along_y[y, orders[j, 1]]
    return values


@njit(cache=True)
def _moments(x: Array, y: Array, features: Array, k: int) -> tuple[Array, Array]:
    """M (2k - 1, 2k - 1), and the same sums with every feature as weight (k, k, c); `cos u` and `cos v` (n,)."""
    degrees, components = 2 * k - 1, features.shape[1]
    along_x, along_y = _chebyshev(x, degrees), _chebyshev(y, degrees)
    moments = np.zeros((degrees, degrees))
    weighted = np.zeros((components, k, k))
    for i in range(len(x)):
        row = along_y[i]
        for p in range(degrees):
            for q in range(degrees):
                moments[p, q] += along_x[i, p] * row[q]
        for c in range(components):
            for p in range(k):
                factor = features[i, c] * along_x[i, p]
                for q in range(k):
                    weighted[c, p, q] += factor * row[q]
    return moments, weighted.transpose(1, 2, 0)


@njit(cache=True)
def _gram(moments: Array, orders: NDArray[np.int64], scale: Array) -> Array:
    """The upper triangle in C order; the functions of one order along x lie side by side, in order along y."""
    m, degrees = len(orders), moments.shape[1]
    gram = np.zeros((m, m))
    first = np.searchsorted(orders[:, 0], np.arange(orders[-1, 0] + 2))
    row, mirrored = np.empty(degrees), np.empty(2 * degrees - 1)
    for a in range(len(first) - 1):
        for other_a in range(a, len(first) - 1):
            for q in range(degrees):
                row[q] = moments[other_a - a, q] + moments[a + other_a, q]
                mirrored[degrees - 1 + q] = mirrored[degrees - 1 - q] = row[q]
            start, count = first[other_a], first[other_a + 1] - first[other_a]
            for b in range(first[a + 1] - first[a]):
                i = first[a] + b
                factor = 0.25 * scale[i]
                for other_b in range(b if other_a == a else 0, count):
                    j = start + other_b
                    both = mirrored[degrees - 1 + other_b - b] + row[b + other_b]
                    gram[i, j] = factor * scale[j] * both
    return gram


@njit(cache=True)
def _series(covariance: Array, orders: NDArray[np.int64], scale: Array, degrees: int) -> Array:
    """From the upper triangle in C order, the other taken to be its mirror."""
    coefficients = np.zeros((degrees, degrees))
    for i in range(len(orders)):
        a, b = orders[i, 0], orders[i, 1]
        for j in range(i, len(orders)):
            other_a, other_b = orders[j, 0], orders[j, 1]
            share = (0.25 if i == j else 0.5) * scale[i] * scale[j] * covariance[i, j]
            coefficients[other_a - a, abs(b - other_b)] += share
            coefficients[other_a - a, b + other_b] += share
            coefficients[a + other_a, abs(b - other_b)] += share
            coefficients[a + other_a, b + other_b] += share
    return coefficients
