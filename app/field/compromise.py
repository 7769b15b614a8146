"""The compromise map: a large exact map told again by its own predictions at a few chosen nodes (Kuevor B9-B11).

The *intermediate* map is conditioned on n2 observations; it is asked at n1 nodes, and a map conditioned on the answers,
with the same hyper-parameters, is what is kept: small enough to hand on, at a cost per point that n1 decides.

The seed takes the answers for observations as noisy as the measurements were, which smooths twice and forgets how sure
the intermediate map was. Stored together with their posterior covariance they lose neither: as long as the nodes are no
farther apart than half a length scale, mean and variance are the intermediate map's.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from app.field.exact import ExactPosterior, _distances_m
from app.field.kernels import covariance
from app.geometry import Array

__all__ = ["CompromisePosterior", "compromise", "naive_nodes", "spanning_nodes"]

JITTER = 1e-9
"""Of the prior's variance: nodes half a length apart make a squared exponential's covariance nearly singular."""


@dataclass(frozen=True, slots=True, eq=False)
class CompromisePosterior(ExactPosterior):
    """A process known at nodes by mean and covariance.

    known (n1, n1): share of the prior's variance that the intermediate map explains, in the basis of the factor.
    """

    known: Array

    def at(self, points_m: Array) -> tuple[Array, Array]:
        """Mean (n,) about the ambient field and latent variance over the prior's (n,)."""
        prior = covariance(self.process.kernel, _distances_m(points_m, self.position_m), self.process.length_m)
        whitened = solve_triangular(self.factor, prior.T, lower=True, check_finite=False)
        explained = np.einsum("in,in->n", whitened, self.known @ whitened)
        return np.square(self.process.signal_sd_uT) * prior @ self.dual_uT, np.maximum(1.0 - explained, 0.0)
