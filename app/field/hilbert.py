"""Reduced-rank Gaussian process on one tile: posterior weights, and the field they stand for.

Weights `w ~ N(0, signal^2 S)`; the posterior covariance in units of the signal variance is the same for every
component, since length and noise ratios are shared: one factor, one variance for all.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf, dpotri, dpotrs

from app.field.basis import CosineBasis
from app.field.hyperparameters import Hyperparameters
from app.field.moments import VarianceSeries, cosines, scaled_functions
from app.field.statistics import Evidence
from app.geometry import Array

__all__ = ["AxisFunctions", "LatticeField", "TilePosterior", "posterior", "predict"]


class AxisFunctions(NamedTuple):
    """One axis of a lattice of n points: values and slopes (n, k) of the functions, cosines (n, 2k - 1)."""

    values: Array
    slopes: Array
    cosines: Array

    @classmethod
    def at(cls, basis: CosineBasis, axis: int, coordinate_m: Array) -> "AxisFunctions":
        return cls(
            basis.along(axis, coordinate_m), basis.slope_along(axis, coordinate_m), cosines(basis, axis, coordinate_m)
        )


class LatticeField(NamedTuple):
    """On ny rows and nx columns: mean (c, ny, nx) about the ambient, slopes with x and y alike, variance (ny, nx)."""

    mean_uT: Array
    slope_x_uT_per_m: Array
    slope_y_uT_per_m: Array
    variance_ratio: Array


@dataclass(frozen=True, slots=True, eq=False)
class TilePosterior:
    """weights_uT (m, c); variance: of the functions' sum, over the signal variance of each component.

    detail_ratio is added to it: the variance of what is too fine for the functions. Never above the prior's.
    """

    basis: CosineBasis
    weights_uT: Array
    variance: VarianceSeries
    detail_ratio: float

    def at(self, points_m: Array) -> tuple[Array, Array]:
        """Mean about the ambient (n, c) in uT and variance ratio (n,) at points (n, 2)."""
        return self.basis.at(points_m) @ self.weights_uT, np.minimum(
            self.variance.at(points_m) + self.detail_ratio, 1.0
        )

    def on_lattice(self, x: AxisFunctions, y: AxisFunctions) -> LatticeField:
        """The field at the crossings of columns and rows, axis by axis."""
        by_axis = self.basis.by_axis(self.weights_uT)
        rows, row_slopes = y.values @ by_axis, y.slopes @ by_axis
        variance = np.minimum(self.variance.on_lattice(x.cosines, y.cosines) + self.detail_ratio, 1.0)
        return LatticeField(rows @ x.values.T, rows @ x.slopes.T, row_slopes @ x.values.T, variance)


def posterior(basis: CosineBasis, evidence: Evidence, hyper: Hyperparameters) -> TilePosterior:
    """The posterior of one tile given the sum of its surveys' evidence."""
    root, factor = _factor(basis, evidence, hyper)
    scaled, info = dpotrs(factor, root[:, None] * evidence.target, lower=1)
    assert info == 0, info
    covariance, info = dpotri(factor, lower=1, overwrite_c=1)
    assert info == 0, info
    variance = VarianceSeries.of(basis, covariance, root)
    return TilePosterior(basis, root[:, None] * scaled, variance, hyper.detail_ratio(basis))


def predict(basis: CosineBasis, evidence: Evidence, hyper: Hyperparameters, points_m: Array) -> tuple[Array, Array]:
    """`posterior(...).at(points_m)` for a few points: mean (n, c) about the ambient in uT, variance ratio (n,)."""
    root, factor = _factor(basis, evidence, hyper)
    components = evidence.target.shape[1]
    right = np.empty((basis.size, components + len(points_m)), order="F")
    right[:, :components], right[:, components:] = (
        root[:, None] * evidence.target,
        scaled_functions(basis, points_m, root),
    )
    half = dtrsm(1.0, factor, right, lower=1, overwrite_b=1)
    variance = np.einsum("mn,mn->n", half[:, components:], half[:, components:]) + hyper.detail_ratio(basis)
    return half[:, components:].T @ half[:, :components], np.minimum(variance, 1.0)


def _factor(basis: CosineBasis, evidence: Evidence, hyper: Hyperparameters) -> tuple[Array, Array]:
    """Prior sds (m,) of the weights, and the Cholesky factor (m, m) of their scaled posterior precision.

    Only its lower triangle is meant.
    """
    root = hyper.prior_sd(basis)
    factor, info = dpotrf(evidence.scaled_precision(basis, root), lower=1, clean=0, overwrite_a=1)
    assert info == 0, info
    return root, np.asarray(factor)
