"""The compromise map: a large exact map told again by its own predictions at a few chosen nodes (Kuevor B9-B11).

The *intermediate* map is conditioned on n2 observations; it is asked at n1 nodes, and a map conditioned on the answers
with the same hyper-parameters is what is kept: small enough to hand on, at a cost per point that n1 decides.

The seed takes the answers for observations as noisy as the measurements were, which smooths twice and forgets how sure
the intermediate map was. Stored with their posterior covariance they lose neither: mean and variance are nearly the
intermediate map's as long as the nodes are close enough, for a smooth kernel half a length scale apart.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular
from scipy.spatial.distance import cdist

from app.field.exact import ExactPosterior, ExactProcess
from app.field.kernels import covariance
from app.geometry import Array

__all__ = [
    "STUDY_SPACINGS_M",
    "CompromisePosterior",
    "Density",
    "compromise",
    "interpolate",
    "naive_nodes",
    "spanning_nodes",
    "study_density",
]

STUDY_SPACINGS_M = tuple(round(0.2 + 0.05 * k, 2) for k in range(17))
"""Of the seed's spatial-density analysis (Kuevor, L820)."""

JITTER = 1e-9
"""Of the prior's variance: with nodes this close a squared exponential's covariance is singular but for rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class CompromisePosterior(ExactPosterior):
    """A process known at nodes by mean and covariance; `factor` is of the nodes' prior covariance, without noise.

    known (n1, n1): what is known of the nodes' values whitened by `factor`: nothing is 0, everything the identity.
    """

    known: Array

    def at(self, points_m: Array) -> tuple[Array, Array]:
        """Mean (n,) about the ambient field and latent variance over the prior's (n,)."""
        prior = _prior_uT2(self.process, points_m, self.position_m)
        whitened = solve_triangular(self.factor, prior.T, lower=True, check_finite=False)
        explained = np.einsum("in,in->n", whitened, self.known @ whitened)
        return prior @ self.dual_uT, np.maximum(1.0 - explained / self.process.signal_sd_uT**2, 0.0)


def compromise(intermediate: ExactPosterior, node_m: Array, with_covariance: bool = True) -> ExactPosterior:
    """The map told by its predictions at nodes (n1, 3).

    without covariance: the seed's, predictions as noisy observations (Kuevor, L570-L574, L756). With it: mean
    `k K11^-1 M` and variance `k(0) - k K11^-1 (K11 - C) K11^-1 k` for predictions M of posterior covariance C.
    """
    if not with_covariance:
        return _as_observations(intermediate, node_m)
    told = interpolate(intermediate, node_m)
    between = _prior_uT2(told.process, intermediate.position_m, node_m)
    seen = solve_triangular(intermediate.factor, between, lower=True, check_finite=False)
    whitened = solve_triangular(told.factor, seen.T, lower=True, check_finite=False)
    return CompromisePosterior(told.process, node_m, told.factor, told.dual_uT, whitened @ whitened.T)


def interpolate(intermediate: ExactPosterior, node_m: Array) -> ExactPosterior:
    """The mean alone of the map told with covariance, at a fraction of the cost; its variance is meaningless."""
    process = intermediate.process
    prior = _prior_uT2(process, node_m, node_m)
    prior[np.diag_indices_from(prior)] += JITTER * process.signal_sd_uT**2
    factor = cho_factor(prior, lower=True, check_finite=False)
    dual_uT = cho_solve(factor, intermediate.mean_at(node_m), check_finite=False)
    return ExactPosterior(process, node_m, factor[0], dual_uT)


def naive_nodes(box_m: Array, spacing_m: Sequence[float]) -> Array:
    """(n, 3) nodes `low : spacing : high` of a box (2, 3) as the seed lays them: the far faces are often missed."""
    low, high = box_m
    counts = np.floor((high - low) / spacing_m + 1e-9).astype(int) + 1
    return _crossings([a + s * np.arange(n) for a, s, n in zip(low, spacing_m, counts, strict=True)])


def spanning_nodes(box_m: Array, spacing_m: Sequence[float]) -> Array:
    """(n, 3) evenly spaced nodes of a box (2, 3), its faces included, no farther apart than the spacing.

    Where the box is thinner than half a spacing one node lies in its middle.
    """
    axes = []
    for low, high, spacing in zip(*box_m, spacing_m, strict=True):
        intervals = int(np.ceil((high - low) / spacing - 1e-9))
        thin = high - low < spacing / 2.0
        axes.append(np.array([(low + high) / 2.0]) if thin else np.linspace(low, high, intervals + 1))
    return _crossings(axes)


class Density(NamedTuple):
    """One row of the density study: n1 nodes and the vector RMSE (Kuevor, eq. 2.9) of every validation set."""

    spacing_m: float
    nodes: int
    rmse_vec_uT: tuple[float, ...]


def study_density(
    intermediate: Sequence[ExactPosterior],
    grids: Iterable[tuple[float, Array]],
    validation: Sequence[tuple[Array, Array]],
    with_covariance: bool = True,
) -> list[Density]:
    """How far apart nodes may be (Kuevor B11): the compromise of one intermediate map for every grid.

    grids: spacing and nodes (n1, 3); validation: positions (n, 3) and field about the ambient (n, c) of each log.
    """
    told = interpolate if with_covariance else _as_observations
    rows = []
    for spacing_m, node_m in grids:
        maps = [told(component, node_m) for component in intermediate]
        errors_uT = [np.stack([m.mean_at(p) for m in maps], axis=1) - field_uT for p, field_uT in validation]
        rmse = tuple(float(np.sqrt(np.mean(np.sum(np.square(error), axis=1)))) for error in errors_uT)
        rows.append(Density(spacing_m, len(node_m), rmse))
    return rows


def _as_observations(intermediate: ExactPosterior, node_m: Array) -> ExactPosterior:
    """The seed's: predictions taken for observations as noisy as measurements."""
    return intermediate.process.condition(node_m, intermediate.mean_at(node_m))


def _crossings(axes: Sequence[Array]) -> Array:
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, len(axes))


def _prior_uT2(process: ExactProcess, a_m: Array, b_m: Array) -> Array:
    """(n, m) covariance of the latent field at points (n, 3) and (m, 3)."""
    return process.signal_sd_uT**2 * covariance(process.kernel, np.asarray(cdist(a_m, b_m)), process.length_m)
