"""What a client is answered: estimates, posterior, status, and why if it asked."""

import base64
from collections.abc import Sequence
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from app.api.locate_request import Technique
from app.api.models import AppliedView
from app.positioning.explanation import ExplainedPlace, Explanation
from app.positioning.fix import Fix
from app.services.calibrations import AppliedCalibration
from app.viewer.likelihood import likelihood_png

__all__ = ["BatchAnswer", "FixView", "Timing", "show_fix"]

_FLOOR_ID = "01a2014f-5d0e-7a53-8f2c-6f2f3d1a9b10"
_EXAMPLE_FIX: dict[str, Any] = {
    "status": "fix",
    "reason": None,
    "estimates": {
        "ml": {"available": True, "floor_id": _FLOOR_ID, "position_m": [12.3, 4.5, 1.2], "heading_rad": 1.57,
               "log_likelihood": -14.7},
        "mlr": {"available": True, "ratio": 41.0, "floor_id": _FLOOR_ID, "position_m": [12.3, 4.5, 1.2]},
        "abl": {"available": False, "reason": "the likelihood is spread out: its peak is 12 times the uniform share"},
    },
    "posterior": {
        "floor_probability": {_FLOOR_ID: 1.0}, "floor_id": _FLOOR_ID, "position_m": [12.3, 4.5, 1.2],
        "covariance_m2": [[0.02, 0.0], [0.0, 0.03]], "radius_50_m": 0.15, "radius_68_m": 0.2, "radius_90_m": 0.4,
        "radius_95_m": 0.5, "off_map_probability": 0.01, "missed_probability": 0.0,
        "modes": [{"floor_id": _FLOOR_ID, "position_m": [12.3, 4.5, 1.2], "heading_rad": 1.57, "probability": 0.99}],
    },
    "map_ids": ["01a20150-77aa-7d10-9c3e-0d8f5b2c4e11"],
    "timing_ms": {"search": 12.1, "total": 14.0},
}  # fmt: skip


class Estimate(BaseModel):
    """One technique's answer; when it is not available, `reason` says why."""

    available: bool
    reason: str | None = None
    floor_id: str | None = None
    position_m: list[float] | None = None
    heading_rad: float | None = None
    log_likelihood: float | None = None
    ratio: float | None = None
    bin_probability: float | None = None
    peak_over_uniform: float | None = None
    residual_rms_ut: float | None = None
    mad_ut: float | None = None
    moved_m: float | None = None


class ModeView(BaseModel):
    floor_id: str
    position_m: list[float]
    heading_rad: float | None
    probability: float


class PosteriorView(BaseModel):
    """The belief about where the device was at the last sample.

    Position, covariance and radii are those of the most probable floor, given that it is the right one.
    """

    floor_probability: dict[str, float]
    floor_id: str
    position_m: list[float]
    covariance_m2: list[list[float]]
    radius_50_m: float
    radius_68_m: float
    radius_90_m: float
    radius_95_m: float
    off_map_probability: Annotated[float, Field(description="that the window was walked where nothing is mapped")]
    missed_probability: Annotated[float, Field(description="at most this much was left out, as it is searched")]
    modes: list[ModeView]


class Timing(BaseModel):
    """Milliseconds: the search; and all from when the request was read, waiting for its turn included."""

    search: float
    total: float


class LikelihoodView(BaseModel):
    """Log-likelihood of the last sample's place on the best match's floor, less that of the best place of all.

    The first cell is centred on `origin_m`; rows run along y. Null: far below anything that matters. `png`: base64.
    """

    floor_id: str
    height_m: float
    origin_m: list[float]
    resolution_m: float
    log_likelihood: list[list[float | None]]
    png: str


class ExplainedPlaceView(BaseModel):
    """How the window fits at a place: what was estimated beside the place, and what is left sample by sample.

    `residual_ut`: window less map in the building frame; `residual_sds`: in the sensor's axes, less its offset, in
    standard deviations of one reading.
    """

    floor_id: str
    position_m: list[float]
    heading_rad: float | None
    probability: float
    log_likelihood: float
    bias_ut: list[float]
    step_scale: float
    heading_drift_rad_per_m: float
    path_m: list[float]
    residual_ut: list[list[float]]
    residual_sds: list[list[float]]


class ExplanationView(BaseModel):
    likelihood: LikelihoodView
    best: ExplainedPlaceView
    runner_up: ExplainedPlaceView | None
    effective_samples: Annotated[float, Field(description="independent readings the window is worth in the search")]


class FixView(BaseModel):
    model_config = ConfigDict(json_schema_extra={"examples": [_EXAMPLE_FIX]})
    status: Literal["fix", "ambiguous", "inconsistent", "unmapped"]
    reason: Annotated[str | None, Field(description="for every status but fix: what is wrong and what would help")]
    estimates: dict[Technique, Estimate]
    posterior: PosteriorView | None
    map_ids: list[str]
    calibration: Annotated[AppliedView | None, Field(description="that was applied to the window; null: none")] = None
    timing_ms: Timing
    explanation: Annotated[ExplanationView | None, Field(description="only with explain=true")] = None


class BatchAnswer(BaseModel):
    fixes: list[FixView]


def show_fix(
    fix: Fix,
    techniques: Sequence[Technique],
    map_ids: list[str],
    timing: Timing,
    explanation: Explanation | None = None,
    calibration: AppliedCalibration | None = None,
) -> FixView:
    """The fix as the contract shows it, with the techniques that were asked for."""
    nothing = Estimate(available=False, reason=fix.reason or "no candidate floor has a map")
    estimates: dict[Technique, Estimate] = {
        "ml": Estimate(available=True, **_fields(fix.ml)) if fix.ml else nothing,
        "mlr": Estimate.model_validate(_fields(fix.mlr)),
        "abl": Estimate.model_validate(_fields(fix.abl)),
        "mad": Estimate.model_validate(_fields(fix.mad)),
        "contour": Estimate.model_validate(_fields(fix.contour)),
    }
    posterior = None
    if fix.posterior is not None:
        posterior = PosteriorView.model_validate(
            {**_fields(fix.posterior), "covariance_m2": fix.posterior.covariance_m2.tolist(),
             "modes": [_fields(mode) for mode in fix.posterior.modes]}
        )  # fmt: skip
    return FixView(
        status=fix.status,
        reason=fix.reason,
        estimates={technique: estimates[technique] for technique in techniques},
        posterior=posterior,
        map_ids=map_ids,
        calibration=None if calibration is None else AppliedView(**calibration.told),
        timing_ms=timing,
        explanation=None if explanation is None else _explained(explanation),
    )


def _explained(explanation: Explanation) -> ExplanationView:
    surface = explanation.surface
    rounded = np.round(surface.log_likelihood, 3).tolist()
    return ExplanationView(
        likelihood=LikelihoodView(
            floor_id=surface.floor_id,
            height_m=surface.height_m,
            origin_m=list(surface.origin_m),
            resolution_m=surface.resolution_m,
            log_likelihood=[[value if np.isfinite(value) else None for value in row] for row in rounded],
            png=base64.b64encode(likelihood_png(explanation)).decode(),
        ),
        best=_explained_place(explanation.best),
        runner_up=None if explanation.runner_up is None else _explained_place(explanation.runner_up),
        effective_samples=explanation.effective_samples,
    )


def _explained_place(place: ExplainedPlace) -> ExplainedPlaceView:
    return ExplainedPlaceView(
        floor_id=place.floor_id,
        position_m=list(place.position_m),
        heading_rad=place.heading_rad,
        probability=place.probability,
        log_likelihood=place.log_likelihood,
        bias_ut=place.bias_uT.tolist(),
        step_scale=place.step_scale,
        heading_drift_rad_per_m=place.heading_drift_rad_per_m,
        path_m=place.path_m.tolist(),
        residual_ut=place.residual_uT.tolist(),
        residual_sds=place.standardised.tolist(),
    )


def _fields(value: object) -> dict[str, Any]:
    """The fields of a frozen, slotted dataclass, tuples as lists."""
    fields = {name.replace("_uT", "_ut"): getattr(value, name) for name in value.__slots__}  # type: ignore[attr-defined]
    return {name: list(field) if isinstance(field, tuple) else field for name, field in fields.items()}
