"""What particles may do besides fitting the field: stay in a box, at a height, near a road."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from app.geometry import Array

__all__ = ["ALTIMETER_VARIANCE_M2", "Box", "Boxed", "RoadPenalty", "altimeter_log_likelihood"]

ALTIMETER_VARIANCE_M2 = 0.005
"""The one noise figure of the filter that the source prints (Kuevor, L1846)."""


@dataclass(frozen=True, slots=True, eq=False)
class Boxed:
    """States (n, 6) and log weights (n,) after the box; `all_outside`: they were moved in and weigh the same."""

    state: Array
    log_weight: Array
    all_outside: bool


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A box with corners low_m, high_m (3,) that particles [p, v] may not leave (Kuevor, L1571-L1575).

    A particle outside loses its weight. Where all are outside, the coordinates that are come back to `inset_m` inside
    their bound, those axes' velocities become zero, and all weigh the same.
    """

    low_m: Array
    high_m: Array
    inset_m: float = 0.25

    def apply(self, state: Array, log_weight: Array) -> Boxed:
        p = state[:, :3]
        below, above = p < self.low_m, p > self.high_m
        if not (below.any() or above.any()):
            return Boxed(state, log_weight, False)
        outside = np.any(below | above, axis=1)
        if not outside.all():
            return Boxed(state, np.where(outside, -np.inf, log_weight), False)
        state = state.copy()
        np.copyto(state[:, :3], self.low_m + self.inset_m, where=below)
        np.copyto(state[:, :3], self.high_m - self.inset_m, where=above)
        state[:, 3:6][below | above] = 0.0
        return Boxed(state, np.full(len(state), -np.log(len(state))), True)


@dataclass(frozen=True, slots=True, eq=False)
class RoadPenalty:
    """Gaussian in the distance to the nearest sample of a map along roads; nothing is forbidden (Shockley, L1349).

    The sd of 6 m is his, for roads; give corridors their own.
    """

    tree: cKDTree
    sd_m: float = 6.0

    @classmethod
    def of(cls, sample_m: Array, sd_m: float = 6.0) -> "RoadPenalty":
        """Of the map's samples (m, 2)."""
        return cls(cKDTree(sample_m), sd_m)

    def nearest(self, position_m: Array) -> tuple[Array, NDArray[np.int64]]:
        """Log penalty (n,) of positions (n, 2), and the index (n,) of the nearest sample."""
        distance_m, index = self.tree.query(position_m)
        return -0.5 * np.square(distance_m / self.sd_m), np.asarray(index, dtype=np.int64)


def altimeter_log_likelihood(z_m: Array, measured_m: float, variance_m2: float = ALTIMETER_VARIANCE_M2) -> Array:
    """(n,) of particles at heights z_m (n,), given a measured height, both up from the floor (Kuevor, eq. 4.9)."""
    return np.asarray(-0.5 * np.square(z_m - measured_m) / variance_m2)
