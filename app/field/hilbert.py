"""Reduced-rank Gaussian process on one tile: posterior weights, and the field they stand for.

Weights `w ~ N(0, signal^2 S)`. Independent components share length and noise ratios, so one factor of the posterior
precision and one variance, in units of the signal's, serve them all; components of a potential share the weights
themselves, and each has a variance of its own.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dlauum, dpotrf, dpotrs

from app.field.basis import CosineBasis
from app.field.hyperparameters import Basis, Hyperparameters
from app.field.moments import VarianceSeries, cosines, scaled_functions, scaled_functions_on_lattice
from app.field.slab import SlabBasis
from app.field.statistics import Evidence
from app.field.triangular import inverse_of_lower
from app.geometry import Array

VARIANCE_EVERY = 0.75
"""Layers closer than this over the cutoff share their variances: they cost far more than the field, and vary slowly."""

__all__ = ["Patch", "PlanePosterior", "SlabPosterior", "posterior", "predict"]

FEW_POINTS = 0.7
"""Per function: of more, their variances cost less by way of the covariance of the weights."""


class Patch(NamedTuple):
    """The field on nz heights, ny rows and nx columns: mean (c, nz, ny, nx) about the ambient, its exact gradient

    (d, c, nz, ny, nx) over x, y and, of a slab, z; variance over the signal's (v, nz, ny, nx), v = 1 when it is the
    same for all components. potential_uT_m (nz, ny, nx): whose gradient the mean is, with the opposite sign; None of
    independent components.
    """

    mean_uT: Array
    gradient_uT_per_m: Array
    variance_ratio: Array
    potential_uT_m: Array | None = None


@dataclass(frozen=True, slots=True, eq=False)
class PlanePosterior:
    """weights_uT (m, c); variance: of the functions' sum, over the signal variance of each component.

    detail_ratio is added to it: the variance of what is too fine for the functions. Never above the prior's.
    """

    basis: CosineBasis
    weights_uT: Array
    variance: "VarianceSeries | _Solved"
    detail_ratio: float

    def at(self, points_m: Array) -> tuple[Array, Array]:
        """Mean about the ambient (n, c) in uT and variance ratio (n, 1) at points (n, 2) or (n, 3)."""
        variance = np.minimum(self.variance.at(points_m) + self.detail_ratio, 1.0)
        return self.basis.at(points_m) @ self.weights_uT, variance[:, None]

    def patch(self, x_m: Array, y_m: Array, heights_m: Array) -> Patch:
        """The field at the crossings of columns and rows, the same at every height."""
        basis = self.basis
        by_axis = basis.by_axis(self.weights_uT)
        x, slope_x = basis.along(0, x_m), basis.slope_along(0, x_m)
        rows, row_slopes = basis.along(1, y_m) @ by_axis, basis.slope_along(1, y_m) @ by_axis
        variance = self.variance.on_lattice(cosines(basis, 0, x_m), cosines(basis, 1, y_m)) + self.detail_ratio
        one = Patch(
            (rows @ x.T)[:, None],
            np.stack([rows @ slope_x.T, row_slopes @ x.T])[:, :, None],
            np.minimum(variance, 1.0)[None, None],
        )
        return Patch(*(np.repeat(values, len(heights_m), axis=-3) for values in one[:3]))


@dataclass(frozen=True, slots=True, eq=False)
class _Solved:
    """The variance of a plane's functions from the factor (m, m) of their scaled precision, point by point."""

    basis: CosineBasis
    factor: Array
    root: Array

    def at(self, points_m: Array) -> Array:
        """(n,) variance at points (n, 2)."""
        return self._of(scaled_functions(self.basis, points_m, self.root))

    def on_lattice(self, cosines_x: Array, cosines_y: Array) -> Array:
        """(ny, nx) variance at the crossings of columns and rows with these `cosines` (nx, 2k - 1), (ny, 2k - 1)."""
        functions = scaled_functions_on_lattice(self.basis, cosines_x, cosines_y, self.root)
        return self._of(functions).reshape(len(cosines_y), len(cosines_x))

    def _of(self, functions: Array) -> Array:
        half = dtrsm(1.0, self.factor, functions, lower=1, overwrite_b=1)
        return np.asarray(np.einsum("mn,mn->n", half, half))


@dataclass(frozen=True, slots=True, eq=False)
class SlabPosterior:
    """weights_uT (m, c); factor: of the scaled precision, its lower triangle; root (m,) prior sds of the weights."""

    basis: SlabBasis
    weights_uT: Array
    factor: Array
    root: Array
    detail_ratio: float

    def at(self, points_m: Array) -> tuple[Array, Array]:
        """Mean about the ambient (n, c) in uT and variance ratio (n, v) at points (n, 3)."""
        rows = self.basis.rows(points_m)
        return _by_point(rows @ self.weights_uT), np.asarray(self._variance(rows).T)

    def patch(self, x_m: Array, y_m: Array, heights_m: Array) -> Patch:
        """The field at the crossings of columns, rows and heights."""
        sums, mean, gradient = self.basis.on_lattice(self.weights_uT, x_m, y_m, heights_m)
        y, x = (each.ravel() for each in np.meshgrid(y_m, x_m, indexing="ij"))
        some = _spread_out(heights_m, VARIANCE_EVERY / self.basis.cutoff_rad_per_m)
        variance = np.stack(
            [self._variance(self.basis.rows(np.column_stack([x, y, np.full(len(x), z)]))) for z in heights_m[some]],
            axis=1,
        )
        variance = _between(heights_m[some], variance, heights_m).reshape(-1, len(heights_m), len(y_m), len(x_m))
        return Patch(mean, gradient, variance, sums[0] if self.basis.potential else None)

    def potential_uT_m(self, points_m: Array) -> Array:
        """(n,) the potential at points (n, 3), but for a constant."""
        return np.asarray(self.basis.at(points_m) @ self.weights_uT[:, 0])

    def _variance(self, rows: Array) -> Array:
        """(r, n) for rows (r, n, m)."""
        r, n, m = rows.shape
        half = dtrsm(1.0, self.factor, (rows * self.root).reshape(r * n, m).T, lower=1)
        return np.asarray(np.minimum(np.einsum("mn,mn->n", half, half).reshape(r, n) + self.detail_ratio, 1.0))


def _spread_out(heights_m: Array, apart_m: float) -> list[int]:
    """Of rising heights the first, those at least so far apart, and the last."""
    chosen = [0]
    for index, height_m in enumerate(heights_m):
        if height_m - heights_m[chosen[-1]] >= apart_m or 0 < index == len(heights_m) - 1:
            chosen.append(index)
    return chosen


def _between(known_m: Array, values: Array, heights_m: Array) -> Array:
    """(r, heights, n) of values (r, known, n): linear between known heights, and exact at them."""
    below = np.clip(np.searchsorted(known_m, heights_m, side="right") - 1, 0, max(len(known_m) - 2, 0))
    above = np.minimum(below + 1, len(known_m) - 1)
    share = (heights_m - known_m[below]) / np.where(above > below, known_m[above] - known_m[below], 1.0)
    return np.asarray(values[:, below] * (1.0 - share)[:, None] + values[:, above] * share[:, None])


def posterior(
    basis: Basis, evidence: Evidence, hyper: Hyperparameters, points: int | None = None
) -> PlanePosterior | SlabPosterior:
    """The posterior of one tile given the sum of its surveys' evidence.

    points: at about how many it will be asked for, if that is known: for few, a series of the variance does not pay.
    """
    root, factor = _factor(basis, evidence, hyper)
    scaled, info = dpotrs(factor, root[:, None] * evidence.target, lower=1)
    assert info == 0, info
    weights_uT, detail_ratio = root[:, None] * scaled, hyper.detail_ratio(basis)
    if isinstance(basis, SlabBasis):
        return SlabPosterior(basis, weights_uT, factor, root, detail_ratio)
    if points is not None and points <= FEW_POINTS * basis.size:
        return PlanePosterior(basis, weights_uT, _Solved(basis, factor, root), detail_ratio)
    covariance, info = dlauum(inverse_of_lower(factor), lower=1, overwrite_c=1)
    assert info == 0, info
    return PlanePosterior(basis, weights_uT, VarianceSeries.of(basis, covariance, root), detail_ratio)


def predict(basis: Basis, evidence: Evidence, hyper: Hyperparameters, points_m: Array) -> tuple[Array, Array]:
    """`posterior(...).at(points_m)` for a few points: mean (n, c) about the ambient in uT, variance ratio (n, v)."""
    root, factor = _factor(basis, evidence, hyper)
    if isinstance(basis, SlabBasis):
        rows = basis.rows(points_m)
        functions = (rows * root).reshape(-1, basis.size).T
    else:
        functions = scaled_functions(basis, points_m, root)
    targets = evidence.target.shape[1]
    right = np.empty((basis.size, targets + functions.shape[1]), order="F")
    right[:, :targets], right[:, targets:] = root[:, None] * evidence.target, functions
    half = dtrsm(1.0, factor, right, lower=1, overwrite_b=1)
    variance = np.einsum("mn,mn->n", half[:, targets:], half[:, targets:]) + hyper.detail_ratio(basis)
    mean = half[:, targets:].T @ half[:, :targets]
    r = basis.rows_per_point
    return _by_point(mean.reshape(r, len(points_m), targets)), np.minimum(variance, 1.0).reshape(r, -1).T


def _by_point(values: Array) -> Array:
    """(n, c) of the values (r, n, c') of every row: a potential's three rows are its components."""
    return np.asarray(values[0] if len(values) == 1 else values[:, :, 0].T)


def _factor(basis: Basis, evidence: Evidence, hyper: Hyperparameters) -> tuple[Array, Array]:
    """Prior sds (m,) of the weights, and the Cholesky factor (m, m) of their scaled posterior precision.

    Only its lower triangle is meant.
    """
    root = hyper.prior_sd(basis)
    factor, info = dpotrf(evidence.scaled_precision(basis, root), lower=1, clean=0, overwrite_a=1)
    assert info == 0, info
    return root, np.asarray(factor)
