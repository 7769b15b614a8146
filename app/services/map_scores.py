"""A map against walks it never saw: accuracy, calibration, and whether its stated sd ranks its errors.

Samples of one walk err together, so standard errors come from drawing walks, not samples (bootstrap, fixed seed).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import rankdata

from app.field.body_bias import BodyBias
from app.field.grid import FieldGrid
from app.field.samples import Samples
from app.field.session_bias import offset_variance_uT2
from app.geometry import Array

__all__ = ["Estimate", "HeldOutWalk", "MapScore", "held_out_walk", "nlpd_gain", "score_map"]

NEAR_M = 1.0
"""Judged are samples this near to a mapping walk: farther away nothing was measured."""
DRAWS = 100
SCALE_OF_MAD = 1.4826

_T = TypeVar("_T")


@dataclass(frozen=True, slots=True)
class Estimate:
    """A figure and its standard error; None of one walk alone."""

    value: float
    standard_error: float | None

    def text(self, digits: int) -> str:
        """`value ±error`."""
        error = "" if self.standard_error is None else f" ±{self.standard_error:.{digits}f}"
        return f"{self.value:.{digits}f}{error}"


@dataclass(frozen=True, slots=True, eq=False)
class HeldOutWalk:
    """error_uT (n, c): measured minus predicted; variance_uT2 (n, c): predictive, noise and what is not known of the
    session's offset included; latent_sd_uT (n, c): the map's own. Only samples near a mapping walk."""

    error_uT: Array
    variance_uT2: Array
    latent_sd_uT: Array

    @property
    def nlpd(self) -> Array:
        """(n,) negative log predictive density per component."""
        squared = np.square(self.error_uT) / self.variance_uT2
        return np.asarray(0.5 * np.mean(np.log(2.0 * np.pi * self.variance_uT2) + squared, axis=1))


@dataclass(frozen=True, slots=True)
class MapScore:
    """Of samples within a metre of a mapping walk, per component where there are several.

    robust_sd_ut: 1.4826 median |error|. rank_correlation: Spearman's, of the stated latent sd with |error|.
    """

    samples: int
    walks: int
    rmse_ut: tuple[float, ...]
    robust_sd_ut: tuple[Estimate, ...]
    coverage_2sigma: tuple[Estimate, ...]
    nlpd: Estimate
    rank_correlation: Estimate


def held_out_walk(grid: FieldGrid, samples: Samples, mapped_m: Array, session: BodyBias | None) -> HeldOutWalk:
    """One walk, its session's offset already taken out, against the map. mapped_m (m, 2): places of the map's walks."""
    near = near_mapped(samples, mapped_m)
    predicted = grid.at(samples.p_building_m[near])
    variance_uT2 = np.square(predicted.sd_uT) + np.square(grid.noise_sd_uT)
    if session is not None:
        variance_uT2 = variance_uT2 + offset_variance_uT2(samples, session, grid.components)[near]
    return HeldOutWalk(samples.features(grid.components)[near] - predicted.mean_uT, variance_uT2, predicted.sd_uT)


def near_mapped(samples: Samples, mapped_m: Array) -> NDArray[np.bool_]:
    """(n,) samples within NEAR_M of a place (m, 2) that was mapped."""
    distance_m, _ = cKDTree(mapped_m).query(samples.p_building_m[:, :2])
    return np.asarray(distance_m) <= NEAR_M


def score_map(walks: Sequence[HeldOutWalk]) -> MapScore | None:
    """All walks together; None when none of them came near the map."""
    walks = [walk for walk in walks if len(walk.error_uT)]
    if not walks:
        return None
    error_uT = np.concatenate([walk.error_uT for walk in walks])

    def each(statistic: Callable[[Sequence[HeldOutWalk]], Array]) -> tuple[Estimate, ...]:
        return _estimates(walks, statistic)

    return MapScore(
        samples=len(error_uT),
        walks=len(walks),
        rmse_ut=tuple(np.sqrt(np.mean(np.square(error_uT), axis=0)).tolist()),
        robust_sd_ut=each(_robust_sd),
        coverage_2sigma=each(_coverage),
        nlpd=each(_mean_nlpd)[0],
        rank_correlation=each(_rank_correlation)[0],
    )


def nlpd_gain(walks: Sequence[HeldOutWalk], others: Sequence[HeldOutWalk]) -> Estimate | None:
    """How much lower the NLPD of `walks` is than that of the same walks under another map, sample by sample."""
    gains = [other.nlpd - walk.nlpd for walk, other in zip(walks, others, strict=True) if len(walk.error_uT)]
    return _estimates(gains, lambda drawn: np.atleast_1d(np.concatenate(list(drawn)).mean()))[0] if gains else None


def _estimates(walks: Sequence[_T], statistic: Callable[[Sequence[_T]], Array]) -> tuple[Estimate, ...]:
    values = statistic(walks)
    if len(walks) < 2:
        return tuple(Estimate(float(value), None) for value in values)
    rng = np.random.default_rng(0)
    drawn = [statistic([walks[k] for k in rng.integers(0, len(walks), len(walks))]) for _ in range(DRAWS)]
    return tuple(Estimate(float(v), float(e)) for v, e in zip(values, np.std(drawn, axis=0), strict=True))


def _robust_sd(walks: Sequence[HeldOutWalk]) -> Array:
    return np.asarray(SCALE_OF_MAD * np.median(np.abs(np.concatenate([walk.error_uT for walk in walks])), axis=0))


def _coverage(walks: Sequence[HeldOutWalk]) -> Array:
    return np.asarray(
        np.mean(np.concatenate([np.square(walk.error_uT) <= 4.0 * walk.variance_uT2 for walk in walks]), axis=0)
    )


def _mean_nlpd(walks: Sequence[HeldOutWalk]) -> Array:
    return np.atleast_1d(np.concatenate([walk.nlpd for walk in walks]).mean())


def _rank_correlation(walks: Sequence[HeldOutWalk]) -> Array:
    """Mean over the components."""
    error = rankdata(np.abs(np.concatenate([walk.error_uT for walk in walks])), axis=0)
    sd = rankdata(np.concatenate([walk.latent_sd_uT for walk in walks]), axis=0)
    error, sd = error - error.mean(axis=0), sd - sd.mean(axis=0)
    spread = np.sqrt(np.sum(error**2, axis=0) * np.sum(sd**2, axis=0))
    return np.atleast_1d(np.mean(np.sum(error * sd, axis=0) / np.maximum(spread, 1e-12)))
