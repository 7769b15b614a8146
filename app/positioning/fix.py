"""A fix: what is believed after a window was matched against the maps of some floors."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array

__all__ = [
    "AblEstimate", "ContourEstimate", "Fix", "LocateOptions", "MadEstimate", "MlEstimate", "MlrEstimate", "Mode",
    "Posterior", "Prior", "Status",
]  # fmt: skip

Status = Literal["fix", "ambiguous", "inconsistent", "unmapped"]


@dataclass(frozen=True, slots=True)
class LocateOptions:
    """Parameters of the techniques (Shockley 8.2, 8.3), of the gate, and what is known of the window's errors.

    The techniques' defaults follow from benchmarks/availability.py.

    bias_sd_uT                   what is not known of the sensor's constant offset, per axis, beyond what surveys of the
                                 map differ by
    step_scale_sd                relative sd of the scale of the window's displacements
    heading_drift_sd_rad_per_m   sd of the drift of the window's heading, per metre walked
    walkable                     (floor id, x_m (nx,), y_m (ny,)) -> (ny, nx) where the device may be; None: anywhere
    out_of_time                  asked now and then; once it says so the search ends with what it has
    """

    mlr_ratio: float = 10.0
    mlr_min_distance_m: float = 5.0
    abl_bin_m: float = 2.0
    abl_min_probability: float = 0.7  # that the heaviest bin must hold
    abl_threshold: float | None = None  # least peak of the likelihood, as a multiple of the uniform one; None: any
    gate_probability: float = 0.997  # chi-square gate on the best pose (Shockley 8.5)
    feature_rms_uT: float | None = (
        None  # a feature whose best match is worse than this is unknown; None: the gate judges
    )
    bias_sd_uT: float = 0.5
    step_scale_sd: float = 0.05
    heading_drift_sd_rad_per_m: float = 0.003
    walkable: Callable[[str, Array, Array], NDArray[np.bool_]] | None = None
    out_of_time: Callable[[], bool] | None = None


@dataclass(frozen=True, slots=True)
class Prior:
    """Where the device is thought to be now (last sample), before the window is looked at."""

    position_m: tuple[float, float, float]
    sd_m: float


@dataclass(frozen=True, slots=True)
class MlEstimate:
    """Maximum likelihood (Shockley 8.1): always answers if any pose was searched.

    The best pose of the lattice, refined between the cells, and the log-likelihood of the window there, not tempered.
    """

    floor_id: str
    position_m: tuple[float, float, float]
    heading_rad: float | None
    log_likelihood: float
    residual_rms_uT: float  # RSS / sqrt(n c) (Shockley 8.7), the sensor's estimated offset taken out


@dataclass(frozen=True, slots=True)
class MlrEstimate:
    """Maximum likelihood ratio (Shockley 8.2). `available` False: position is None and `reason` says why.

    `ratio` is that of the tempered likelihoods, and a lower bound where no rival is within what was searched."""

    available: bool
    ratio: float | None
    floor_id: str | None = None
    position_m: tuple[float, float, float] | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class AblEstimate:
    """Aggregate bin likelihood (Shockley 8.3), bins in the plane."""

    available: bool
    bin_probability: float | None = None
    peak_over_uniform: float | None = None
    floor_id: str | None = None
    position_m: tuple[float, float, float] | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class MadEstimate:
    """Least mean absolute deviation of norms (Cuenca 1.10), among the likely poses.

    `ratio`: deviation of the best place elsewhere over that of the best: near one, two places fit alike."""

    available: bool
    mad_uT: float | None = None
    ratio: float | None = None
    floor_id: str | None = None
    position_m: tuple[float, float, float] | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class ContourEstimate:
    """The nearest place to the MAD estimate on the contour of the last reading's norm (Cuenca 1.11), `moved_m` off."""

    available: bool
    moved_m: float | None = None
    floor_id: str | None = None
    position_m: tuple[float, float, float] | None = None
    reason: str | None = None


@dataclass(frozen=True, slots=True)
class Mode:
    """One place the device may be."""

    floor_id: str
    position_m: tuple[float, float, float]
    heading_rad: float | None
    probability: float


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """The belief. `radius_*_m` are horizontal radii about `position_m` holding that share of the mass on that floor,
    position and covariance those of the strongest floor: the mean of its strongest mode, and the second moment of its
    mass about it. When less than 0.4 of the probability is on maps, or much of it was not weighed, radii and
    covariance are those of the whole searched area. `off_map_probability`: that less than half of the window was walked
    where something is mapped.
    `missed_probability`: at most this much mass lies in poses the search left out.
    """

    floor_probability: dict[str, float]
    floor_id: str
    position_m: tuple[float, float, float]
    covariance_m2: Array  # (2, 2)
    radius_50_m: float
    radius_68_m: float
    radius_90_m: float
    radius_95_m: float
    modes: tuple[Mode, ...] = field(default=())
    off_map_probability: float = 0.0
    missed_probability: float = 0.0


@dataclass(frozen=True, slots=True)
class Fix:
    """The answer to a window. `ml` and `posterior` are None only when no floor had a map to search."""

    status: Status
    reason: str | None  # for every status but "fix": what is wrong and what would help
    ml: MlEstimate | None
    mlr: MlrEstimate
    abl: AblEstimate
    mad: MadEstimate
    contour: ContourEstimate
    posterior: Posterior | None
