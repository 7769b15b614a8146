"""What to build: the parameters of a map, and what a fit gives back."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray

from app.field.grid import FieldGrid
from app.field.samples import Components

if TYPE_CHECKING:
    from app.field.leave_one_out import HeldOut
    from app.field.tile_fit import FitState

__all__ = [
    "ChangePoint",
    "ComponentChange",
    "BaseKernel",
    "ComponentConsistency",
    "ConsistencyReport",
    "FittedMap",
    "Engine",
    "Kernel",
    "MapSpec",
    "OutOfDateRegion",
    "Noise",
    "Progress",
    "Score",
    "SegmentConsistency",
    "WalkLocalizability",
]

Engine = Literal["hilbert", "exact", "compromise"]
BaseKernel = Literal["squared_exponential", "matern32", "matern52"]
Kernel = Literal[
    "squared_exponential",
    "matern32",
    "matern52",
    "squared_exponential+squared_exponential",
    "matern32+matern32",
    "matern52+matern52",
]
"""One kernel, or the sum of two of different lengths: a building's sway and its beams."""
Noise = Literal["walk", "white"]
Progress = Callable[[float, str], None]  # (fraction 0..1, message); may raise JobCancelled


@dataclass(frozen=True, slots=True)
class MapSpec:
    """The parameters of a map.

    kernel      None: matern32, or for a curl-free map squared_exponential
    heights_m   heights of the layers, rising; None: one layer at the samples' median height
    curl_free   the field is the gradient of a potential, and free of sources where somebody walked (vector maps)
    noise       "walk": errors along a walk may be correlated, as far as the likelihood says; "white": never
    hard_iron   take the sensors' own constant field out of walks that know their orientation
    robust      heavy-tailed (Student) errors: what disagrees with everything near it counts less
    refine      correct the walks' labels where that proves itself (app.field.refinement); engine hilbert
    """

    components: Components = "vector"
    engine: Engine = "hilbert"
    kernel: Kernel | None = None
    resolution_m: float = 0.25
    heights_m: tuple[float, ...] | None = None
    curl_free: bool = False
    noise: Noise = "walk"
    hard_iron: bool = True
    robust: bool = False
    refine: bool = False

    @property
    def covariance(self) -> Kernel:
        """The kernel to use."""
        return self.kernel or ("squared_exponential" if self.curl_free else "matern32")


@dataclass(frozen=True, slots=True)
class Score:
    """Leave-one-survey-out score: each survey predicted from all the others (predictive sd includes the noise).

    rmse_ut, coverage_2sigma, sharpness_ut: one per component; sharpness is the mean predictive sd, noise included.
    nlpd: mean negative log predictive density per sample and component.
    rmse_vec_ut: root of the summed squares of rmse_ut; rmse_of_norm_ut: of |predicted| against |measured|. The two are
    not the same (Kuevor B13); None where a score was made without them.
    """

    rmse_ut: tuple[float, ...]
    coverage_2sigma: tuple[float, ...]
    nlpd: float
    held_out_samples: int
    rmse_vec_ut: float | None = None
    rmse_of_norm_ut: float | None = None
    sharpness_ut: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class ComponentConsistency:
    """One component of Kuevor B14 for one survey against the others' map."""

    component: str
    coverage_2sigma: float  # fraction of errors within two predictive sd
    seed_2sigma_96: bool  # the seed's rule: coverage >= 0.96 (Kuevor, L904)
    rmse_ut: float
    mean_sd_ut: float  # sharpness
    p_value: float  # of a coverage this low if calibrated (0.9545), accounting for autocorrelation


@dataclass(frozen=True, slots=True)
class SegmentConsistency:
    """A stretch of the walk, by sample index [start, stop), judged by the same rule, per component."""

    start: int
    stop: int
    coverage_2sigma: tuple[float, ...]
    consistent: bool


@dataclass(frozen=True, slots=True)
class ComponentChange:
    """Errors of one component (measured minus predicted) before and after a change: their mean and sd, uT."""

    component: str
    mean_before_ut: float
    mean_after_ut: float
    sd_before_ut: float
    sd_after_ut: float


@dataclass(frozen=True, slots=True)
class ChangePoint:
    """Where in the log errors changed: from `sample` on, up to `until_sample` where they changed back (None: the end).

    "Before" is all of the walk outside the changed stretch. p_value: of a change as clear anywhere in a steady walk,
    with autocorrelation and the places looked at accounted for.
    """

    sample: int
    path_m: float
    until_sample: int | None
    until_path_m: float | None
    p_value: float
    components: tuple[ComponentChange, ...]


@dataclass(frozen=True, slots=True)
class WalkLocalizability:
    """Kuevor's gradient localization metric (B30) of one survey, on its judged samples.

    Signal is the map's gradient times `step_m`, noise the length of the error of the map of the others at the true
    position; means are of samples at 2 Hz, percentiles of the ratio over five samples. A ratio to no noise is None.
    """

    step_m: float
    mean_signal_ut: float
    mean_noise_ut: float
    glm_average: float | None
    glm_ratio_of_means: float | None
    glm_p5: float | None
    glm_p50: float | None
    glm_p95: float | None


@dataclass(frozen=True, slots=True)
class ConsistencyReport:
    """The consistency of one survey with the map of *the other* surveys (Kuevor B14), whole and in segments.

    `status`: "consistent" | "inconsistent" | "unjudged" (nothing else was measured near enough; `reason` says).
    """

    status: Literal["consistent", "inconsistent", "unjudged"]
    seed_2sigma_96: bool | None
    judged_samples: int
    nlpd: float | None
    components: tuple[ComponentConsistency, ...] = ()
    segments: tuple[SegmentConsistency, ...] = ()
    reason: str | None = None
    change_point: ChangePoint | None = None
    localizability: WalkLocalizability | None = None


@dataclass(frozen=True, slots=True)
class OutOfDateRegion:
    """Where recent surveys contradict older ones that agree among themselves: metal was moved, added or taken away.

    bounds_m: (x_min, y_min, x_max, y_max). change_ut: recent minus older field per component, in the part of the region
    where it is clearest; components: those whose change is proven. p_value: of one as clear anywhere on the map by
    chance.
    """

    bounds_m: tuple[float, float, float, float]
    components: tuple[str, ...]
    change_ut: tuple[float, ...]
    surveys_before: tuple[str, ...]
    surveys_after: tuple[str, ...]
    p_value: float


@dataclass(frozen=True, slots=True)
class FittedMap:
    """What a fit gives back. `hyperparameters` is plain JSON: kernel, lengths and sds with units in their names.

    `layers`: further layers of the grid by name ("coverage", "conflict"), (nz, ny, nx), NaN where nothing is known.
    """

    grid: FieldGrid
    hyperparameters: dict[str, object]
    score: Score | None
    score_reason: str | None  # why there is no score
    consistency: dict[str, ConsistencyReport] = field(default_factory=dict)  # by survey id
    layers: dict[str, NDArray[np.float32]] = field(default_factory=dict)
    out_of_date: tuple[OutOfDateRegion, ...] = ()
    state: FitState | None = None  # what the next fit with the same parameters can start from
    tiles_refitted: int = 0
    continued: bool = False  # with what an earlier fit had learned
    held_out: Mapping[str, HeldOut] = field(default_factory=dict)  # every survey against the map of the others
    hard_iron: dict[str, object] = field(default_factory=dict)  # the offsets taken out, by session and by survey
