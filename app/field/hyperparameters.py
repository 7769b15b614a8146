"""The numbers a map is fitted with: one kernel length and one noise shape for all components, one scale for each."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from app.field.basis import CosineBasis
from app.field.kernels import spectral_density, variance_beyond
from app.field.spec import Kernel
from app.field.walk_noise import WHITE, WalkNoise
from app.geometry import Array

__all__ = ["Hyperparameters"]


@dataclass(frozen=True, slots=True, eq=False)
class Hyperparameters:
    """Covariance of component c: `signal_sd_uT[c]^2 (k(r) + bias + walk exp(-|s - s'| / walk_length_m) + white)`.

    bias_ratio, walk_ratio, white_ratio: variances of a survey's offset in a tile, of the error correlated along the
    walk and of the white error, over the signal's. r is the distance between places, s the distance walked.
    """

    kernel: Kernel
    length_m: float
    signal_sd_uT: Array
    white_ratio: float
    bias_ratio: float = 0.0
    walk_ratio: float = 0.0
    walk_length_m: float = 1.0

    @property
    def error_sd_uT(self) -> Array:
        """(c,) sd of one observation about the latent field: offset, correlated and white error together."""
        return np.asarray(self.signal_sd_uT * np.sqrt(self.bias_ratio + self.walk_ratio + self.white_ratio))

    def prior_sd(self, basis: CosineBasis) -> Array:
        """(m,) sd of the weight of every function, over the signal's sd."""
        return _prior_sd(self.kernel, basis.side_m, basis.functions_per_axis, self.length_m)

    def detail_ratio(self, basis: CosineBasis) -> float:
        """Share of the signal's variance finer than the basis can follow. To the samples it is one more white error."""
        return variance_beyond(self.kernel, basis.cutoff_rad_per_m, self.length_m)

    def white_ratio_in(self, basis: CosineBasis) -> float:
        return self.white_ratio + self.detail_ratio(basis)

    def walk_noise_in(self, basis: CosineBasis) -> WalkNoise:
        """The shape of the errors along a walk as seen by this basis."""
        if self.walk_ratio == 0.0:
            return WHITE
        return WalkNoise(self.walk_ratio / self.white_ratio_in(basis), self.walk_length_m)

    def as_json(self) -> dict[str, object]:
        """Plain JSON with units in the names; standard deviations are per component."""
        return {
            "kernel": self.kernel,
            "length_m": self.length_m,
            "signal_sd_ut": self.signal_sd_uT.tolist(),
            "white_noise_sd_ut": (self.signal_sd_uT * np.sqrt(self.white_ratio)).tolist(),
            "walk_noise_sd_ut": (self.signal_sd_uT * np.sqrt(self.walk_ratio)).tolist(),
            "walk_noise_length_m": self.walk_length_m,
            "survey_bias_sd_ut": (self.signal_sd_uT * np.sqrt(self.bias_ratio)).tolist(),
        }


@lru_cache(maxsize=8)
def _prior_sd(kernel: Kernel, side_m: float, functions_per_axis: int, length_m: float) -> Array:
    """The same for all tiles of a lattice, wherever their corner."""
    basis = CosineBasis((0.0, 0.0), side_m, functions_per_axis)
    sd = np.sqrt(spectral_density(kernel, basis.frequencies_squared, length_m))
    sd.setflags(write=False)
    return np.asarray(sd)
