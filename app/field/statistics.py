"""What one survey tells one tile: sufficient statistics that add up to a map.

With basis rows Phi (n, m), features y (n, c) about the ambient field and the walk's noise shape R, the statistics are
`Phi^T R^-1 Phi`, `Phi^T R^-1 y`, `Phi^T R^-1 1`, `1^T R^-1 1`, `1^T R^-1 y`, `y^T R^-1 y`, `log det R` and n. A
survey's constant offset inside the tile, of prior variance `bias_ratio` beside a white variance `white_ratio`, is
integrated out in closed form afterwards (Sherman-Morrison), so offsets cost nothing and no sample is read again.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dgemm, dsyrk

from app.field.basis import CosineBasis
from app.field.moments import gram_of_moments, moments_of, scaled_functions
from app.field.walk_noise import WHITE, WalkNoise, whiten
from app.geometry import Array

__all__ = ["Evidence", "Gram", "SurveyStatistics", "add_evidence", "marginalise", "survey_statistics"]


@dataclass(frozen=True, slots=True, eq=False)
class Gram:
    """`Phi^T R^-1 Phi`: of white noise by its cosine moments (2k - 1, 2k - 1), else by its entries (m, m)."""

    table: Array
    of_moments: bool

    def scaled(self, basis: CosineBasis, scale: Array) -> Array:
        """`diag(scale) Phi^T R^-1 Phi diag(scale)` (m, m): the lower triangle, in Fortran order."""
        if self.of_moments:
            return gram_of_moments(basis, self.table, scale)
        return np.asfortranarray(self.table * np.outer(scale, scale))


@dataclass(frozen=True, slots=True, eq=False)
class SurveyStatistics:
    """gram, target (m, c), offset (m,), ones, ones_target (c,), energy (c,), log_det_shape, count: see above."""

    gram: Gram
    target: Array
    offset: Array
    ones: float
    ones_target: Array
    energy: Array
    log_det_shape: float
    count: int


@dataclass(frozen=True, slots=True, eq=False)
class Evidence:
    """Statistics with the surveys' offsets integrated out, ready to be added: target (m, c), and of the precision

    `gram - offsets diag(signs) offsets^T`, offsets (m, s), signs (s,) of plus and minus one.
    """

    gram: Gram
    offsets: Array
    signs: Array
    target: Array

    def __sub__(self, other: "Evidence") -> "Evidence":
        return Evidence(
            Gram(self.gram.table - other.gram.table, self.gram.of_moments),
            np.hstack([self.offsets, other.offsets]),
            np.concatenate([self.signs, -other.signs]),
            self.target - other.target,
        )

    def scaled_precision(self, basis: CosineBasis, scale: Array) -> Array:
        """`I + diag(scale) precision diag(scale)` (m, m): the lower triangle, in Fortran order."""
        precision = self.gram.scaled(basis, scale)
        offsets = scale[:, None] * self.offsets
        precision = dgemm(-1.0, offsets * self.signs, offsets, 1.0, precision, trans_b=1, overwrite_c=1)
        np.einsum("ii->i", precision)[:] += 1.0
        return np.asarray(precision)


def survey_statistics(
    basis: CosineBasis, points_m: Array, deviation_uT: Array, path_m: Array, noise: WalkNoise
) -> SurveyStatistics:
    """The statistics of one walk's observations inside one tile.

    points_m (n, 2); deviation_uT (n, c) features minus the ambient field; path_m (n,) distance walked.
    """
    if noise == WHITE:
        return _white_statistics(basis, points_m, deviation_uT)
    m = basis.size
    columns = np.empty((len(points_m), m + 1 + deviation_uT.shape[1]))
    columns[:, :m], columns[:, m], columns[:, m + 1 :] = (
        scaled_functions(basis, points_m, np.ones(m)).T,
        1.0,
        deviation_uT,
    )
    white, log_det = whiten(columns, path_m, noise)
    products = dsyrk(1.0, white.T, lower=1)
    return SurveyStatistics(
        gram=Gram(products[:m, :m], of_moments=False),
        target=products[m + 1 :, :m].T,
        offset=products[m, :m],
        ones=float(products[m, m]),
        ones_target=products[m + 1 :, m],
        energy=np.diagonal(products)[m + 1 :],
        log_det_shape=log_det,
        count=len(points_m),
    )


def _white_statistics(basis: CosineBasis, points_m: Array, deviation_uT: Array) -> SurveyStatistics:
    """Of white noise, from the cosine moments of the points and of the features at them."""
    moments, target = moments_of(basis, points_m, deviation_uT)
    return SurveyStatistics(
        gram=Gram(moments, of_moments=True),
        target=target,
        offset=basis.norms * moments[basis.orders[:, 0], basis.orders[:, 1]],
        ones=float(len(points_m)),
        ones_target=deviation_uT.sum(axis=0),
        energy=np.einsum("nc,nc->c", deviation_uT, deviation_uT),
        log_det_shape=0.0,
        count=len(points_m),
    )


def add_evidence(evidence: Collection[Evidence]) -> Evidence:
    """The evidence of a whole tile: the sum over its surveys."""
    one, *_ = evidence
    return Evidence(
        Gram(np.sum([e.gram.table for e in evidence], axis=0), one.gram.of_moments),
        np.hstack([e.offsets for e in evidence]),
        np.concatenate([e.signs for e in evidence]),
        np.sum([e.target for e in evidence], axis=0),
    )


def marginalise(survey: SurveyStatistics, white_ratio: float, bias_ratio: float) -> Evidence:
    """The survey's evidence about the weights in units of the signal variance, its offset integrated out."""
    shrink = bias_ratio / (white_ratio + bias_ratio * survey.ones)
    target = survey.target - shrink * np.outer(survey.offset, survey.ones_target)
    return Evidence(
        Gram(survey.gram.table / white_ratio, survey.gram.of_moments),
        np.sqrt(shrink / white_ratio) * survey.offset[:, None],
        np.ones(1),
        target / white_ratio,
    )
