"""How many particles a belief needs."""

import numpy as np

from app.geometry import Array
from app.tracking.estimate import occupied_bins
from app.tracking.options import TrackOptions
from app.tracking.particle_filter import kld_sample_size
from app.tracking.particles import Particles

__all__ = ["enough"]

_LIGHT = 0.01  # of an even share: particles that count for nothing


def enough(particles: Particles, weight: Array, options: TrackOptions) -> int:
    """Particles that hold the belief's Kullback-Leibler distance (Fox 2003), between the fewest and the most."""
    heavy = weight > _LIGHT / len(weight)
    bins = occupied_bins(Particles(particles.rows[heavy], particles.floor[heavy], particles.log_weight[heavy]))
    return int(np.clip(kld_sample_size(bins), options.least_particles, options.particles))
