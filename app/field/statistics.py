"""What one survey tells one tile: sufficient statistics that add up to a map.

With basis rows Phi (n, m), features y (n, c) about the ambient field and the walk's noise shape R, the statistics are
`Phi^T R^-1 Phi`, `Phi^T R^-1 y`, `Phi^T R^-1 1`, `1^T R^-1 1`, `1^T R^-1 y`, `y^T R^-1 y`, `log det R` and n. A
survey's constant offset inside the tile, of prior variance `bias_ratio` beside a white variance `white_ratio`, is
integrated out in closed form afterwards (Sherman-Morrison), so offsets cost nothing and no sample is read again.

Functions of a potential give three rows for a point, one for each component, and one target; a survey then has three
offsets, whose rows do not overlap. Where somebody walked is air, without poles: the divergence of the field there, zero
up to a little, is one more row.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy.linalg.blas import dgemm, dsyrk

from app.field.basis import CosineBasis
from app.field.hyperparameters import Basis, Hyperparameters
from app.field.moments import gram_of_moments, moments_of
from app.field.slab import SlabBasis
from app.field.walk_noise import WHITE, WalkNoise, whiten
from app.geometry import Array

AIR_EVERY_M = 0.15

__all__ = ["Evidence", "Gram", "SurveyStatistics", "add_evidence", "marginalise", "survey_statistics"]


@dataclass(frozen=True, slots=True, eq=False)
class Gram:
    """`Phi^T R^-1 Phi`: of white noise in the plane by its cosine moments (2k - 1, 2k - 1), else by its entries."""

    table: Array
    of_moments: bool

    def scaled(self, basis: Basis, scale: Array) -> Array:
        """`diag(scale) Phi^T R^-1 Phi diag(scale)` (m, m): the lower triangle, in Fortran order."""
        if self.of_moments:
            assert isinstance(basis, CosineBasis)
            return gram_of_moments(basis, self.table, scale)
        return np.asarray(_scaled_triangle(self.table, scale).T)


@dataclass(frozen=True, slots=True, eq=False)
class SurveyStatistics:
    """gram, target (m, c), offsets (m, k), ones (k,), ones_target (k, c), energy (c,), log_det_shape, count of rows.

    sources: `D^T D` (m, m) of the rows of the divergence where the survey walked; only of a potential.
    """

    gram: Gram
    target: Array
    offsets: Array
    ones: Array
    ones_target: Array
    energy: Array
    log_det_shape: float
    count: int
    sources: Array | None = None

    def scaled(self, factor: float) -> "SurveyStatistics":
        """Of the same walk when the variances of all its errors, offset included, are larger by a factor."""
        if factor == 1.0:
            return self
        return replace(
            self,
            gram=Gram(self.gram.table / factor, self.gram.of_moments),
            target=self.target / factor,
            offsets=self.offsets / np.sqrt(factor),
            ones_target=self.ones_target / np.sqrt(factor),
            energy=self.energy / factor,
            log_det_shape=self.log_det_shape + self.count * float(np.log(factor)),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Statistics with the surveys' offsets integrated out, ready to be added: target (m, c), and of the precision

    `gram - offsets diag(signs) offsets^T`, offsets (m, s), signs (s,) of plus and minus one.
    """

    gram: Gram
    offsets: Array
    signs: NDArray[np.float64]
    target: Array

    def __sub__(self, other: "Evidence") -> "Evidence":
        return Evidence(
            Gram(self.gram.table - other.gram.table, self.gram.of_moments),
            np.hstack([self.offsets, other.offsets]),
            np.concatenate([self.signs, -other.signs]),
            self.target - other.target,
        )

    def scaled_precision(self, basis: Basis, scale: Array) -> Array:
        """`I + diag(scale) precision diag(scale)` (m, m): the lower triangle, in Fortran order."""
        precision = self.gram.scaled(basis, scale)
        offsets = scale[:, None] * self.offsets
        precision = dgemm(-1.0, offsets * self.signs, offsets, 1.0, precision, trans_b=1, overwrite_c=1)
        np.einsum("ii->i", precision)[:] += 1.0
        return np.asarray(precision)


def survey_statistics(
    basis: Basis,
    points_m: Array,
    deviation_uT: Array,
    path_m: Array,
    noise: WalkNoise,
    white_scale: Array | None = None,
) -> SurveyStatistics:
    """The statistics of one walk's observations inside one tile.

    points_m (n, 2), or (n, 3) for a slab; deviation_uT (n, c) features minus the ambient field; path_m (n,) distance
    walked; white_scale (n,) factors on the variance of single observations' white error.
    """
    if noise == WHITE and white_scale is None and isinstance(basis, CosineBasis):
        return _white_statistics(basis, points_m, deviation_uT)
    rows = basis.rows(points_m)
    r, n, m = rows.shape
    targets = deviation_uT.shape[1] if r == 1 else 1
    columns = np.zeros((r, n, m + r + targets))
    columns[:, :, :m] = rows
    for component in range(r):
        columns[component, :, m + component] = 1.0
        columns[component, :, m + r :] = deviation_uT if r == 1 else deviation_uT[:, component : component + 1]
    log_det = 0.0
    if noise != WHITE or white_scale is not None:
        for component in range(r):
            columns[component], log_det_of_one = whiten(columns[component], path_m, noise, white_scale)
            log_det += log_det_of_one
    products = dsyrk(1.0, columns.reshape(r * n, -1).T, lower=1)
    return SurveyStatistics(
        gram=Gram(products[:m, :m], of_moments=False),
        target=products[m + r :, :m].T,
        offsets=products[m : m + r, :m].T,
        ones=np.diagonal(products)[m : m + r].copy(),
        ones_target=products[m + r :, m : m + r].T,
        energy=np.diagonal(products)[m + r :].copy(),
        log_det_shape=log_det,
        count=r * n,
        sources=_sources(basis, points_m),
    )


def _white_statistics(basis: CosineBasis, points_m: Array, deviation_uT: Array) -> SurveyStatistics:
    """Of white noise, from the cosine moments of the points and of the features at them."""
    moments, target = moments_of(basis, points_m, deviation_uT)
    return SurveyStatistics(
        gram=Gram(moments, of_moments=True),
        target=target,
        offsets=(basis.norms * moments[basis.orders[:, 0], basis.orders[:, 1]])[:, None],
        ones=np.array([float(len(points_m))]),
        ones_target=deviation_uT.sum(axis=0)[None],
        energy=np.einsum("nc,nc->c", deviation_uT, deviation_uT),
        log_det_shape=0.0,
        count=len(points_m),
    )


def _sources(basis: Basis, points_m: Array) -> Array | None:
    """Somebody who walks is in air from low to high, so heights are taken in turn."""
    if not (isinstance(basis, SlabBasis) and basis.potential):
        return None
    low_m, high_m = basis.air_m
    levels = 1 + int(np.ceil((high_m - low_m) / AIR_EVERY_M))
    air_m = points_m.copy()
    air_m[:, 2] = np.resize(np.linspace(low_m, high_m, levels), len(points_m))
    return np.asarray(dsyrk(1.0, basis.divergence_rows(air_m).T, lower=1))


@njit(cache=True)
def _scaled_triangle(table: Array, scale: Array) -> Array:
    """`table[j, i] scale[i] scale[j]`, j >= i, as the upper triangle in C order; zero below."""
    m = len(scale)
    scaled = np.zeros((m, m))
    for i in range(m):
        for j in range(i, m):
            scaled[i, j] = table[j, i] * (scale[i] * scale[j])
    return scaled


def add_evidence(evidence: Collection[Evidence]) -> Evidence:
    """The evidence of a whole tile: the sum over its surveys."""
    one, *_ = evidence
    return Evidence(
        Gram(np.sum([e.gram.table for e in evidence], axis=0), one.gram.of_moments),
        np.hstack([e.offsets for e in evidence]),
        np.concatenate([e.signs for e in evidence]),
        np.sum([e.target for e in evidence], axis=0),
    )


def marginalise(basis: Basis, survey_id: str, survey: SurveyStatistics, hyper: Hyperparameters) -> Evidence:
    """The survey's evidence about the weights in units of the signal variance, its offsets integrated out."""
    white_ratio = hyper.white_ratio_in(basis, survey_id)
    bias_ratio = hyper.bias_ratio_of(survey_id)
    shrink = bias_ratio / (white_ratio + bias_ratio * survey.ones)
    target = survey.target - (survey.offsets * shrink) @ survey.ones_target
    table = survey.gram.table / white_ratio
    if survey.sources is not None:
        table = table + survey.sources / hyper.source_variance_ratio(basis)
    return Evidence(
        Gram(table, survey.gram.of_moments),
        np.sqrt(shrink / white_ratio) * survey.offsets,
        np.ones(len(shrink)),
        target / white_ratio,
    )
