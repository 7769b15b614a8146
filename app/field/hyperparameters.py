"""The numbers a map is fitted with: kernel lengths and one noise shape for all components, one scale for each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from app.field.basis import CosineBasis
from app.field.kernels import Term, base_kernel, spectral_density, variance_beyond
from app.field.slab import SlabBasis
from app.field.spec import Kernel
from app.field.walk_noise import WHITE, WalkNoise
from app.geometry import Array

__all__ = ["Basis", "Hyperparameters", "weight_variance"]

Basis = CosineBasis | SlabBasis

LONG_WAVES = 0.3
"""Variance of the fields longer than a box of a potential, each over the signal's."""
DETAIL_IN_AIR = 0.15
"""Share of a potential's detail that is there where nothing but air is."""
SOURCE_FREE = 0.07
"""Sd of the divergence left where somebody walked, over the prior's: labels are off by a little, air is not steel."""


@dataclass(frozen=True, slots=True, eq=False)
class Hyperparameters:
    """Covariance of component c: `signal_sd_uT[c]^2 (k(r) + bias + walk exp(-|s - s'| / walk_length_m) + white)`.

    bias_ratio, walk_ratio, white_ratio: variances of a survey's offset in a tile, of the error correlated along the
    walk and of the white error, over the signal's. r is the distance between places, s the distance walked.
    offset_ratio: survey id -> variance, over the signal's, of what may be left of its sensor's own constant field.
    short_length_m, short_share: of the second kernel of a sum. noise_scale: survey id -> factor on the variances of all
    its errors; 1 for those not named.
    """

    kernel: Kernel
    length_m: float
    signal_sd_uT: Array
    white_ratio: float
    bias_ratio: float = 0.0
    walk_ratio: float = 0.0
    walk_length_m: float = 1.0
    short_length_m: float | None = None
    short_share: float = 0.0
    noise_scale: dict[str, float] = field(default_factory=dict)
    offset_ratio: Mapping[str, float] = field(default_factory=dict)

    @property
    def terms(self) -> tuple[Term, ...]:
        base = base_kernel(self.kernel)
        if self.short_length_m is None:
            return (Term(base, self.length_m, 1.0),)
        return (
            Term(base, self.length_m, 1.0 - self.short_share),
            Term(base, self.short_length_m, self.short_share),
        )

    @property
    def finest_length_m(self) -> float:
        """The length that the functions of a tile must follow."""
        return self.length_m if self.short_length_m is None else self.short_length_m

    @property
    def error_sd_uT(self) -> Array:
        """(c,) sd of one observation about the latent field: offset, correlated and white error together."""
        return np.asarray(self.signal_sd_uT * np.sqrt(self.bias_ratio + self.walk_ratio + self.white_ratio))

    def prior_sd(self, basis: Basis) -> Array:
        """(m,) sd of the weight of every function, over the signal's sd."""
        return _prior_sd(self.terms, basis.at_origin())

    def detail_ratio(self, basis: Basis) -> float:
        """Share of the signal's variance finer than the basis can follow.

        A slab is learned on the lattice it is used on, where detail shows as white error: there is no more of it. And
        a potential's signal is that of a field with sources everywhere: where there are none little of it is detail.
        """
        tail = sum(
            share * variance_beyond(kernel, basis.cutoff_rad_per_m, length_m, basis.dimensions, basis.potential)
            for kernel, length_m, share in self.terms
        )
        share = DETAIL_IN_AIR if basis.potential else 1.0
        return share * min(tail, self.white_ratio) if isinstance(basis, SlabBasis) else tail

    def white_ratio_in(self, basis: Basis, survey_id: str = "") -> float:
        """Of white error as the functions of a tile see it, detail included."""
        own = self.white_ratio if isinstance(basis, SlabBasis) else self.white_ratio + self.detail_ratio(basis)
        return own * self.noise_scale.get(survey_id, 1.0)

    def bias_ratio_of(self, survey_id: str) -> float:
        scale = self.noise_scale.get(survey_id, 1.0)
        return self.bias_ratio * scale + self.offset_ratio.get(survey_id, 0.0)

    def source_variance_ratio(self, basis: Basis) -> float:
        """Variance of the divergence allowed in air, over the signal's variance, 1/m^2; only of a potential."""
        sd = self.prior_sd(basis) * basis.frequencies_squared
        return float(SOURCE_FREE**2 * np.sum(np.square(sd)) / basis.volume)

    def walk_noise_in(self, basis: Basis) -> WalkNoise:
        """The shape of the errors along a walk as seen by this basis."""
        if self.walk_ratio == 0.0:
            return WHITE
        return WalkNoise(self.walk_ratio / self.white_ratio_in(basis), self.walk_length_m)

    def as_json(self) -> dict[str, object]:
        """Plain JSON with units in the names; standard deviations are per component."""
        short = {}
        if self.short_length_m is not None:
            short = {"short_length_m": self.short_length_m, "short_share": self.short_share}
        noisier = {name: scale for name, scale in self.noise_scale.items() if scale != 1.0}
        return {
            "kernel": self.kernel,
            "length_m": self.length_m,
            **short,
            "signal_sd_ut": self.signal_sd_uT.tolist(),
            "white_noise_sd_ut": (self.signal_sd_uT * np.sqrt(self.white_ratio)).tolist(),
            "walk_noise_sd_ut": (self.signal_sd_uT * np.sqrt(self.walk_ratio)).tolist(),
            "walk_noise_length_m": self.walk_length_m,
            "survey_bias_sd_ut": (self.signal_sd_uT * np.sqrt(self.bias_ratio)).tolist(),
            **({"survey_noise_scale": noisier} if noisier else {}),
        }


def weight_variance(terms: Sequence[Term], basis: Basis) -> Array:
    """(terms, m) variance of the weight of every function, by term of the kernel, shares included."""
    variance = np.stack(
        [
            share * spectral_density(kernel, basis.frequencies_squared, length_m, basis.dimensions, basis.potential)
            for kernel, length_m, share in terms
        ]
    )
    if isinstance(basis, SlabBasis) and basis.long_waves:
        variance[:, -basis.long_waves :] = np.array([[term.share * LONG_WAVES] for term in terms])
    return variance


@lru_cache(maxsize=8)
def _prior_sd(terms: tuple[Term, ...], basis: Basis) -> Array:
    """The same for all tiles of a lattice, wherever their corner."""
    sd = np.sqrt(weight_variance(terms, basis).sum(axis=0))
    sd.setflags(write=False)
    return np.asarray(sd)
