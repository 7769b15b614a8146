"""Hyper-parameters by maximum marginal likelihood, from sufficient statistics alone: no pass over samples.

The signal variance of each component is concentrated out (`sigma^2 = y^T C^-1 y / n`), which leaves three parameters
shared by all components: log length, log white ratio, log bias ratio; and for a sum of two kernels two more: the
logarithm of the second length over the first, and the logit of its share. One evaluation costs O(m^3) per tile. Detail
of the field finer than the functions can only be learned as white error, which errs on the side of a larger one.
Rasmussen & Williams 2006, 5.4.1; statistics as Solin & Sarkka 2020, 3.3.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg.blas import dgemm
from scipy.linalg.lapack import dpotrf
from scipy.special import expit

from app.field.descent import descend
from app.field.hyperparameters import Basis, Hyperparameters, weight_variance
from app.field.kernels import is_sum, log_spectral_slope
from app.field.spec import Kernel
from app.field.statistics import Gram, SurveyStatistics
from app.field.triangular import inverse_of_lower
from app.field.walk_noise import WalkNoise
from app.geometry import Array

__all__ = ["Likelihood", "MostLikely", "TileStatistics", "learn", "negative_log_likelihood"]

SCALE_FLOOR_UT2 = 1e-6
LENGTH_BOUNDS_M = (0.3, 40.0)
RATIO_BOUNDS_LOG = np.log([(1e-6, 1e2), (1e-8, 1e1)])
SECOND_BOUNDS = np.array([(np.log(0.15), np.log(0.7)), (-4.0, 2.0)])
"""Of a sum: log of the second length over the first, and logit of its share of the variance."""
START_SECOND = np.array([np.log(0.35), -1.5])
TOLERANCE = 2e-5
"""The search ends when a step gains less log likelihood than this per observation and component."""
START_LOG = np.log([3.0, 1e-2, 1e-4])
START_CURVATURE = np.array([0.1, 0.1, 0.01, 0.1, 0.01])
"""Of the value per observation and component along each parameter, on the low side."""


@dataclass(frozen=True, slots=True, eq=False)
class TileStatistics:
    """The sums over the s surveys of one tile that a likelihood needs, and the functions they were projected on.

    gram, target (m, c), energy (c,), log_det_shape, count: totals. offsets (m, s), ones (s,), ones_target (s, c):
    of every offset of every survey. sources (m, m): of a potential, the divergence where somebody walked.
    """

    basis: Basis
    gram: Gram
    target: Array
    energy: Array
    log_det_shape: float
    count: int
    offsets: Array
    ones: Array
    ones_target: Array
    sources: Array | None = None

    @classmethod
    def of(cls, basis: Basis, surveys: Collection[SurveyStatistics]) -> "TileStatistics":
        one, *_ = surveys
        return cls(
            basis=basis,
            gram=Gram(np.sum([s.gram.table for s in surveys], axis=0), one.gram.of_moments),
            target=np.sum([s.target for s in surveys], axis=0),
            energy=np.sum([s.energy for s in surveys], axis=0),
            log_det_shape=sum(s.log_det_shape for s in surveys),
            count=sum(s.count for s in surveys),
            offsets=np.hstack([s.offsets for s in surveys]),
            ones=np.concatenate([s.ones for s in surveys]),
            ones_target=np.vstack([s.ones_target for s in surveys]),
            sources=None if one.sources is None else np.sum([np.asarray(s.sources) for s in surveys], axis=0),
        )


@dataclass(frozen=True, slots=True, eq=False)
class Likelihood:
    """value: negative log marginal likelihood; gradient (3,) or (5,) over the parameters, in the order above."""

    value: float
    gradient: Array
    signal_variance_uT2: Array


class MostLikely(NamedTuple):
    """Hyper-parameters; their logarithms (p,) and the curvature (p, p) there, to start from next time; and the value,

    negative log marginal likelihood per observation and component.
    """

    hyper: Hyperparameters
    log_parameters: Array
    curvature: Array
    nats: float


class _Prior(NamedTuple):
    """sd (m,) of the weights over the signal's; derivatives (k, m) of their log variance with the kernel's parameters:

    k is 1, or 3 of a sum. source_variance: of the divergence in air, over the signal's; source_slopes (k,): of its
    logarithm.
    """

    sd: Array
    log_slopes: Array
    source_variance: float
    source_slopes: Array

    @classmethod
    def of(cls, hyper: Hyperparameters, basis: Basis) -> "_Prior":
        sd, slopes = hyper.prior_sd(basis), _log_slopes(hyper, basis)
        if not basis.potential:
            return cls(sd, slopes, 0.0, np.zeros(len(slopes)))
        share = np.square(sd * basis.frequencies_squared)
        return cls(sd, slopes, hyper.source_variance_ratio(basis), slopes @ share / max(share.sum(), 1e-300))


@dataclass(slots=True)
class _Terms:
    """Of one tile or a sum of tiles: energy (c,) `y^T C^-1 y`, log_det of C, and their derivatives (p, c) and (p,)."""

    energy: Array
    log_det: float
    energy_slope: Array
    log_det_slope: Array
    count: int


def negative_log_likelihood(tiles: Sequence[TileStatistics], kernel: Kernel, log_parameters: Array) -> Likelihood:
    """Concentrated over the signal variances, summed over tiles and components."""
    hyper = _hyperparameters(kernel, log_parameters)
    priors = {basis: _Prior.of(hyper, basis) for basis in {tile.basis.at_origin() for tile in tiles}}
    terms = [_tile_terms(tile, hyper, priors[tile.basis.at_origin()]) for tile in tiles]
    n = sum(term.count for term in terms)
    energy = np.sum([term.energy for term in terms], axis=0) + n * SCALE_FLOOR_UT2
    components = len(energy)
    log_det = sum(term.log_det for term in terms)
    value = 0.5 * n * np.sum(np.log(energy / n) + 1.0 + np.log(2 * np.pi)) + 0.5 * components * log_det
    energy_slope = np.sum([term.energy_slope for term in terms], axis=0)
    log_det_slope = np.sum([term.log_det_slope for term in terms], axis=0)
    gradient = 0.5 * n * np.sum(energy_slope / energy, axis=1) + 0.5 * components * log_det_slope
    return Likelihood(float(value), gradient, energy / n)


def learn(
    tiles: Sequence[TileStatistics],
    kernel: Kernel,
    walk_noise: WalkNoise,
    start_log: Array = START_LOG,
    length_bounds_m: tuple[float, float] = LENGTH_BOUNDS_M,
    pin_bias: bool = False,
    tolerance: float = TOLERANCE,
    curvature: Array | None = None,
) -> MostLikely:
    """The most likely hyper-parameters, to within a gain of `tolerance` per observation and component.

    `pin_bias` keeps the offset at its lower bound: a single survey's offset is the ambient field's. `start_log` and
    `curvature` are best those of a similar search.
    """
    bounds = np.vstack([np.log(length_bounds_m), RATIO_BOUNDS_LOG])
    if is_sum(kernel):
        bounds = np.vstack([bounds, SECOND_BOUNDS])
        if len(start_log) == len(START_LOG):
            start_log = np.concatenate([start_log, START_SECOND])
    if pin_bias:
        bounds[2, 1] = bounds[2, 0]

    def objective(log_parameters: Array) -> tuple[float, Array]:
        likelihood = seen[log_parameters.tobytes()] = negative_log_likelihood(tiles, kernel, log_parameters)
        return likelihood.value / count, likelihood.gradient / count

    seen: dict[bytes, Likelihood] = {}
    count = sum(tile.count * len(tile.energy) for tile in tiles)
    if curvature is None:
        curvature = np.diag(START_CURVATURE[: len(bounds)])
    best = descend(objective, start_log, bounds, curvature, tolerance)
    likelihood = seen[best.point.tobytes()]
    hyper = replace(_hyperparameters(kernel, best.point), signal_sd_uT=np.sqrt(likelihood.signal_variance_uT2))
    walk_ratio = walk_noise.variance_ratio * hyper.white_ratio
    hyper = replace(hyper, walk_ratio=walk_ratio, walk_length_m=walk_noise.length_m)
    return MostLikely(hyper, best.point, best.curvature, best.value)


def _hyperparameters(kernel: Kernel, log_parameters: Array) -> Hyperparameters:
    """Of unit signal variance and white noise, from the parameters of a search."""
    length_m, white_ratio, bias_ratio = np.exp(log_parameters[:3]).tolist()
    hyper = Hyperparameters(kernel, length_m, np.ones(1), white_ratio, bias_ratio)
    if not is_sum(kernel):
        return hyper
    log_ratio, logit = log_parameters[3:].tolist()
    return replace(hyper, short_length_m=length_m * float(np.exp(log_ratio)), short_share=float(expit(logit)))


def _log_slopes(hyper: Hyperparameters, basis: Basis) -> Array:
    """(1, m), or (3, m) of a sum."""
    by_term = weight_variance(hyper.terms, basis)
    total = by_term.sum(axis=0)
    share = np.divide(by_term, total, out=np.zeros_like(by_term), where=total > 0.0)  # of the finest it may vanish
    slopes = np.stack(
        [
            log_spectral_slope(kernel, basis.frequencies_squared, length_m, basis.dimensions, basis.potential)
            for kernel, length_m, _ in hyper.terms
        ]
    )
    slopes[:, basis.frequencies_squared == 0.0] *= 1.0 - basis.potential  # long waves have no length
    both: Array = np.sum(share * slopes, axis=0)
    if len(share) == 1:
        return both[None]
    return np.stack([both, share[1] * slopes[1], share[1] - hyper.short_share])


def _tile_terms(tile: TileStatistics, hyper: Hyperparameters, prior: _Prior) -> _Terms:
    """Energy and log determinant of one tile, with S^(1/2)-scaled weights so that every matrix is I plus something."""
    white, bias = hyper.white_ratio, hyper.bias_ratio
    root = prior.sd
    shrink = bias / (white + bias * tile.ones)
    offsets = root[:, None] * tile.offsets
    weighted = shrink[:, None] * tile.ones_target
    target = root[:, None] * tile.target - offsets @ weighted
    energy = tile.energy - np.sum(weighted * tile.ones_target, axis=0)

    precision = tile.gram.scaled(tile.basis, root / np.sqrt(white))
    precision = dgemm(-1.0 / white, offsets * shrink, offsets, 1.0, precision, trans_b=1, overwrite_c=1)
    np.einsum("ii->i", precision)[:] += 1.0
    air = None
    if tile.sources is not None:
        air = Gram(tile.sources, of_moments=False).scaled(tile.basis, root / np.sqrt(prior.source_variance))
        precision += air
    factor, info = dpotrf(precision, lower=1, clean=1, overwrite_a=1)
    assert info == 0, info
    inverse = inverse_of_lower(factor)
    z = inverse.T @ (inverse @ target) / white
    explained = np.sum(z * target, axis=0)
    misfit = energy - explained - white * np.sum(np.square(z), axis=0)

    variance = np.einsum("ij,ij->j", inverse, inverse)
    own = bias * tile.ones / (white + bias * tile.ones)
    log_det = 2.0 * np.sum(np.log(np.diagonal(factor))) + tile.count * np.log(white) - np.sum(np.log1p(-own))

    slope, *second = prior.log_slopes
    shrink_slope = shrink * white / (white + bias * tile.ones)
    energy_by_shrink = -np.square(tile.ones_target - offsets.T @ z) / white
    log_det_by_shrink = -np.sum(np.square(inverse @ offsets), axis=0) / white
    energy_by_bias, log_det_by_bias = shrink_slope @ energy_by_shrink, shrink_slope @ log_det_by_shrink
    terms = _Terms(
        energy=(energy - explained) / white,
        log_det=float(log_det) + tile.log_det_shape,
        energy_slope=np.stack(
            [
                -slope @ np.square(z),
                -misfit / white - energy_by_bias,
                energy_by_bias,
                *(-each @ np.square(z) for each in second),
            ]
        ),
        log_det_slope=np.array(
            [
                slope @ (1.0 - variance),
                tile.count - (len(root) - np.sum(variance)) - np.sum(own) - log_det_by_bias,
                np.sum(own) + log_det_by_bias,
                *(each @ (1.0 - variance) for each in second),
            ]
        ),
        count=tile.count,
    )
    return terms if air is None else _given_air(terms, prior, air, inverse, z)


def _given_air(terms: _Terms, prior: _Prior, air: Array, inverse: Array, z: Array) -> _Terms:
    """The same of what was measured given that the divergence in air is nothing: `p(y | 0) = p(y, 0) / p(0)`.

    air (m, m): what is known of the scaled weights from air alone, its lower triangle; inverse (m, m) of the factor
    of the precision from both, and its weights z (m, c).
    """
    both = np.tril(air) + np.tril(air, -1).T
    of_weights = np.einsum("mc,mc->c", z, both @ z)
    known = float(np.sum((inverse @ both) * inverse))
    factor, info = dpotrf(both + np.eye(len(both)), lower=1, clean=1, overwrite_a=1)
    assert info == 0, info
    alone = inverse_of_lower(factor)
    variance = np.einsum("ij,ij->j", alone, alone)
    known_alone = len(alone) - float(variance.sum())
    by_kernel = prior.log_slopes @ (1.0 - variance) + prior.source_slopes * (known - known_alone)
    kernel = [0, *range(3, len(terms.log_det_slope))]
    terms.log_det -= 2.0 * float(np.sum(np.log(np.diagonal(factor))))
    terms.energy_slope[1] += of_weights
    terms.energy_slope[kernel] -= np.outer(prior.source_slopes, of_weights)
    terms.log_det_slope[1] += known
    terms.log_det_slope[kernel] -= by_kernel
    return terms
