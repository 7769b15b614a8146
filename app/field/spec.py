"""What to build: the parameters of a map, and what a fit gives back."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal

from app.field.grid import FieldGrid
from app.field.samples import Components
from app.geometry import Array

__all__ = [
    "ComponentConsistency",
    "ConsistencyReport",
    "FittedMap",
    "Engine",
    "Kernel",
    "MapSpec",
    "Progress",
    "Score",
    "SegmentConsistency",
]

Engine = Literal["hilbert", "exact"]
Kernel = Literal["squared_exponential", "matern32", "matern52"]
Progress = Callable[[float, str], None]  # (fraction 0..1, message); may raise JobCancelled


@dataclass(frozen=True, slots=True)
class MapSpec:
    """The parameters of a map. `heights_m` None: one layer at the samples' median height."""

    components: Components = "vector"
    engine: Engine = "hilbert"
    kernel: Kernel = "matern32"
    resolution_m: float = 0.25
    heights_m: tuple[float, ...] | None = None


@dataclass(frozen=True, slots=True)
class Score:
    """Leave-one-survey-out score: each survey predicted from all the others (predictive sd includes the noise).

    rmse_ut, coverage_2sigma: one per component. nlpd: mean negative log predictive density per sample and component.
    """

    rmse_ut: tuple[float, ...]
    coverage_2sigma: tuple[float, ...]
    nlpd: float
    held_out_samples: int


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
    layers: dict[str, Array] = field(default_factory=dict)
