"""MagNavigate: a particle filter along roads or corridors whose map is a list of samples (Shockley 10.2).

State [pE, pN, vE, vN, aE, aN]: Gauss-Markov acceleration, a soft penalty for being far from the map's samples, and
either readings of the field, compared with the nearest sample's, or positions from elsewhere.
"""

from dataclasses import dataclass, field

import numpy as np

from app.geometry import Array
from app.tracking.constraints import RoadPenalty
from app.tracking.motion import GaussMarkov
from app.tracking.particle_filter import Particles, Updated, update

__all__ = ["MagNavigate", "begin_around"]

ALWAYS = 1.0 + 1e-9
"""Resampled after every update (Shockley, L1356), equal weights too."""


@dataclass(frozen=True, slots=True, eq=False)
class MagNavigate:
    """The filter of a map; field_uT (m, c) at the road's samples, in the vehicle's axes for one direction of travel.

    One resampling a cycle instead of one for road and one for reading, which is equivalent on the mean; none where no
    reading came. `resample_below` is a share of n.
    """

    road: RoadPenalty
    field_uT: Array
    field_sd_uT: Array
    motion: GaussMarkov = field(default_factory=GaussMarkov)
    position_sd_m: float = 10.0
    resample_below: float = ALWAYS

    def step(
        self,
        particles: Particles,
        elapsed_s: float,
        rng: np.random.Generator,
        *,
        reading_uT: Array | None = None,
        position_m: Array | None = None,
    ) -> Updated:
        """Propagate by the true time, weigh by the road and by a reading (c,) or a position (2,) if there is one."""
        state = self.motion.propagate(particles.state, elapsed_s, rng)
        log_l, nearest = self.road.nearest(state[:, :2])
        if reading_uT is not None:
            off = (reading_uT - self.field_uT[nearest]) / self.field_sd_uT
            log_l = log_l - 0.5 * np.sum(np.square(off), axis=1)
        if position_m is not None:
            log_l = log_l - 0.5 * np.sum(np.square(state[:, :2] - position_m), axis=1) / self.position_sd_m**2
        return update(Particles(state, particles.log_weight), log_l, rng, resample_below=self.resample_below)


def begin_around(position_m: Array, rng: np.random.Generator, count: int = 500, within_m: float = 50.0) -> Particles:
    """At rest, uniform in a disc about a position (2,) (Shockley, L1347; the disc is our reading of it)."""
    radius, angle = within_m * np.sqrt(rng.random(count)), 2.0 * np.pi * rng.random(count)
    state = np.zeros((count, 6))
    state[:, :2] = position_m + np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    return Particles.equal(state)
