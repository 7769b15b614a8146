"""The bootstrap particle filter as named steps: weigh, normalise, estimate, resample, roughen.

Particles are states (n, d) with log weights (n,). A cycle: propagate (`app.tracking.motion`), add log likelihoods
(`app.tracking.field_likelihood`, `app.tracking.constraints`), `normalise`, `estimate` from the weighted set *before*
resampling (Shockley, L794, L1347), and resample where `effective_sample_size` is below a share of n (Kuevor, L1565).
`update` does all but the first two. Nothing is NaN here: particles that have all lost are a named divergence.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from app.geometry import Array

__all__ = [
    "RESAMPLE_BELOW",
    "Estimate",
    "Particles",
    "Updated",
    "Weights",
    "effective_sample_size",
    "estimate",
    "kld_sample_size",
    "needs_resampling",
    "normalise",
    "occupied_bins",
    "roughen",
    "systematic_ancestors",
    "update",
]

RESAMPLE_BELOW = 0.75
"""Share of n that the effective sample size must fall below, strictly (Kuevor, L1565)."""


@dataclass(frozen=True, slots=True, eq=False)
class Particles:
    """state (n, d), and log_weight (n,) up to a constant; -inf is a particle that has lost."""

    state: Array
    log_weight: Array

    @classmethod
    def equal(cls, state: Array) -> "Particles":
        """All as likely as each other."""
        return cls(state, np.full(len(state), -np.log(len(state))))

    def __len__(self) -> int:
        return len(self.state)


class Weights(NamedTuple):
    """weight (n,) with sum one, and the log of the sum before. `diverged`: all had lost, and weights are equal."""

    weight: Array
    log_sum: float
    diverged: bool


class Estimate(NamedTuple):
    """Weighted mean (d,) and covariance (d, d) of the states (Shockley, eq. 2.45-2.46)."""

    mean: Array
    covariance: Array


class Updated(NamedTuple):
    """particles after resampling if any, the estimate before it, effective sample size, and log evidence (nats).

    log_evidence: log of the likelihoods' mean under the weights before; -inf where the filter `diverged`.
    """

    particles: Particles
    estimate: Estimate
    effective: float
    log_evidence: float
    resampled: bool
    diverged: bool


def normalise(log_weight: Array) -> Weights:
    """Weights of log weights (n,), the greatest subtracted first, so that none overflows; NaN counts as lost."""
    log_weight = np.where(np.isnan(log_weight), -np.inf, log_weight)
    greatest = float(log_weight.max())
    if greatest == -np.inf:
        return Weights(np.full(len(log_weight), 1.0 / len(log_weight)), -np.inf, True)
    weight = np.exp(log_weight - greatest)
    total = float(weight.sum())
    return Weights(weight / total, greatest + float(np.log(total)), False)


def effective_sample_size(weight: Array) -> float:
    """How many equal weights would be worth as much: 1 / sum w^2, between 1 and n (Kuevor, eq. 4.10)."""
    return float(1.0 / np.sum(np.square(weight)))


def needs_resampling(weight: Array, below: float = RESAMPLE_BELOW) -> bool:
    """Whether the effective sample size is strictly below that share of n; equal weights never are at 1."""
    return effective_sample_size(weight) < below * len(weight) * (1.0 - 1e-12)


def systematic_ancestors(weight: Array, uniform: float, count: int | None = None) -> NDArray[np.int64]:
    """Ancestors (count,), in rising order, by low-variance resampling with one draw in [0, 1) (Kuevor, L1567).

    Particle i is chosen floor(count w_i) or ceil(count w_i) times, count w_i on the mean; never where w_i is zero.
    """
    count = count or len(weight)
    edge = np.cumsum(weight)
    place = (np.arange(count) + uniform) * (edge[-1] / count)
    last = int(np.flatnonzero(weight)[-1])
    return np.asarray(np.minimum(np.searchsorted(edge, place, side="right"), last), dtype=np.int64)


def roughen(state: Array, sd: Array, rng: np.random.Generator) -> Array:
    """States (n, d) plus Gaussian jitter of sd (d,): resampled copies part again (Kuevor, L1569: P_resample)."""
    return np.asarray(state + np.asarray(sd) * rng.standard_normal(state.shape))


def estimate(state: Array, weight: Array) -> Estimate:
    """Weighted mean and covariance; of several modes the mean may lie between them."""
    mean = weight @ state
    off = state - mean
    return Estimate(mean, (weight[:, None] * off).T @ off)


def update(
    particles: Particles,
    log_likelihood: Array,
    rng: np.random.Generator,
    *,
    jitter_sd: Array | None = None,
    resample_below: float = RESAMPLE_BELOW,
) -> Updated:
    """Weigh by log likelihoods (n,), estimate, and resample if needed, with jitter of sd (d,) where given.

    On divergence weights start again as equal and nothing is resampled: the caller decides how to find itself again.
    One uniform and, where there is jitter, n d normals are drawn from `rng` at each resampling, and nothing else.
    """
    before = normalise(particles.log_weight).log_sum
    weight, log_sum, diverged = normalise(particles.log_weight + log_likelihood)
    found = estimate(particles.state, weight)
    effective = effective_sample_size(weight)
    if diverged or not needs_resampling(weight, resample_below):
        with np.errstate(divide="ignore"):
            kept = Particles(particles.state, np.log(weight))
        return Updated(kept, found, effective, -np.inf if diverged else log_sum - before, False, diverged)
    state = particles.state[systematic_ancestors(weight, rng.random())]
    if jitter_sd is not None:
        state = roughen(state, jitter_sd, rng)
    return Updated(Particles.equal(state), found, effective, log_sum - before, True, False)


def occupied_bins(state: Array, bin_width: Array) -> int:
    """How many bins of `bin_width` (d,) hold at least one of the states (n, d) (Fox 2003)."""
    return len(np.unique(np.floor(state / np.asarray(bin_width)).astype(np.int64), axis=0))


def kld_sample_size(bins: int, epsilon: float = 0.05, delta: float = 0.01) -> int:
    """Particles that keep the Kullback-Leibler distance to the posterior below epsilon with probability 1 - delta.

    n = (k - 1) / (2 epsilon) (1 - 2 / (9 (k - 1)) + sqrt(2 / (9 (k - 1))) z)^3, z the upper quantile and k the bins
    occupied: Wilson-Hilferty's quantile of chi-square (Fox 2003, eq. 13). One bin needs one particle.
    """
    if bins < 2:
        return 1
    ninth = 2.0 / (9.0 * (bins - 1))
    quantile = (bins - 1) * (1.0 - ninth + np.sqrt(ninth) * ndtri(1.0 - delta)) ** 3
    return int(np.ceil(quantile / (2.0 * epsilon)))
