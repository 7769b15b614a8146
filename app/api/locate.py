"""Where am I? A window of magnetometer samples in, a fix out. Nothing is written, nothing queued."""

import asyncio
from collections.abc import Callable
from functools import partial
from time import perf_counter
from typing import Annotated, Any, Literal, Self

import numpy as np
from fastapi import APIRouter, Response
from pydantic import BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator
from sqlalchemy import select

from app.api.auth import Identity, Locating
from app.api.context import Context, ContextDep
from app.api.models import Finite, Id, Point, RequestModel
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Building
from app.errors import Fault, InvalidInput, InvalidWindow, NotFound
from app.geometry import rotate_by_quaternion
from app.positioning.fix import Fix, LocateOptions, Prior
from app.positioning.window import Window
from app.services.locate_window import ActiveMap, active_maps, locate_window
from app.survey.units import field_faults

__all__ = ["router"]

router = APIRouter(prefix="/v1", tags=["locate"], responses=ERROR_RESPONSES)
MAX_BATCH = 100
MAX_SAMPLES = 20_000  # of the description; the setting max_window_samples refuses sooner

Microtesla = Annotated[float, Field(allow_inf_nan=False, ge=-1e9, le=1e9)]
Vector = Annotated[list[Microtesla], Field(min_length=3, max_length=3)]
Quaternion = Annotated[list[Annotated[Finite, Field(ge=-2, le=2)]], Field(min_length=4, max_length=4)]
Radians = Annotated[float, Field(allow_inf_nan=False, ge=-100.0, le=100.0)]
FloorId = Annotated[str, Field(min_length=1, max_length=64, pattern=r"^[A-Za-z0-9_-]+$")]

_EXAMPLE: dict[str, Any] = {
    "window": {
        "frame": "level",
        "b_ut": [[19.8, 2.1, -43.0], [19.1, 2.6, -43.4], [18.2, 3.0, -44.1]],
        "displacement_m": [[0, 0, 0], [0.6, 0, 0], [1.2, 0, 0]],
        "t_s": [0.0, 0.5, 1.0],
        "noise_ut": 0.5,
    },
    "techniques": ["ml", "mlr", "abl"],
}


def _shape_of_field(value: object) -> str:
    first = value[0] if isinstance(value, list) and value else None
    return "magnitudes" if isinstance(first, (int, float)) else "vectors"


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
        "covariance_m2": [[0.02, 0.0], [0.0, 0.03]], "radius_68_m": 0.2, "radius_95_m": 0.5,
        "modes": [{"floor_id": _FLOOR_ID, "position_m": [12.3, 4.5, 1.2], "heading_rad": 1.57, "probability": 0.99}],
    },
    "map_ids": ["01a20150-77aa-7d10-9c3e-0d8f5b2c4e11"],
    "timing_ms": {"search": 12.1, "total": 14.0},
}  # fmt: skip


class WindowBody(RequestModel):
    """Samples in order of time. `displacement_m` is measured from the first sample."""

    frame: Annotated[
        Literal["building", "level", "body", "norm"],
        Field(description="building: b and displacement in the building frame; level: both in the level frame of the "
              "first sample, yaw unknown unless heading_rad is given; body: b in the sensor's axes with orientation; "
              "norm: b_ut is a flat list of |B|, displacement in the level frame"),
    ]  # fmt: skip
    b_ut: Annotated[
        Annotated[list[Vector], Tag("vectors"), Field(min_length=1, max_length=MAX_SAMPLES)]
        | Annotated[list[Microtesla], Tag("magnitudes"), Field(min_length=1, max_length=MAX_SAMPLES)],
        Discriminator(_shape_of_field),
    ]
    displacement_m: Annotated[list[Point], Field(min_length=1, max_length=MAX_SAMPLES)]
    t_s: Annotated[list[Finite], Field(max_length=MAX_SAMPLES)] | None = None
    orientation: Annotated[
        list[Quaternion] | None, Field(max_length=MAX_SAMPLES, description="body to building, [w, x, y, z]")
    ] = None
    heading_rad: Annotated[Radians | None, Field(description="yaw of the first sample's level frame")] = None
    heading_sd_rad: Annotated[Finite, Field(ge=1e-4, le=10)] | None = None
    yaw_rad: Annotated[
        Annotated[list[Radians], Field(max_length=MAX_SAMPLES)] | None,
        Field(description="yaw of the device at each sample from the first; default: it turns with the path"),
    ] = None
    noise_ut: Annotated[Finite, Field(gt=0, le=1000, description="sd of the sensor's noise, per axis")] = 0.5

    @model_validator(mode="after")
    def _lengths_agree(self) -> Self:
        n = len(self.b_ut)
        for name in ("displacement_m", "t_s", "orientation", "yaw_rad"):
            column = getattr(self, name)
            if column is not None and len(column) != n:
                raise ValueError(f"{name} has {len(column)} rows, b_ut has {n}; they must be equal")
        if isinstance(self.b_ut[0], list) == (self.frame == "norm"):
            shape = "a flat list of magnitudes" if self.frame == "norm" else "a list of [bx, by, bz]"
            raise ValueError(f"in the {self.frame} frame b_ut is {shape}")
        if self.heading_sd_rad is not None and self.heading_rad is None:
            raise ValueError("heading_sd_rad says how sure heading_rad is; send both or neither")
        if self.frame == "body" and self.orientation is None:
            raise ValueError("the body frame needs orientation: [[w, x, y, z], ...], body to building")
        return self


class PriorBody(RequestModel):
    position_m: Point
    sd_m: Annotated[Finite, Field(ge=1e-3, le=10_000)]


class OptionsBody(RequestModel):
    """Parameters of the techniques (Shockley 8.2, 8.3)."""

    mlr_ratio: Annotated[Finite, Field(ge=1, le=1e12)] = 2.0
    mlr_min_distance_m: Annotated[Finite, Field(gt=0, le=10_000)] = 5.0
    abl_threshold: Annotated[Finite, Field(ge=0, le=1e9)] | None = None
    abl_bin_m: Annotated[Finite, Field(gt=0, le=1000)] = 2.0


class LocateBody(RequestModel):
    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [_EXAMPLE]})
    window: WindowBody
    composition: Literal["raw", "demeaned", "differenced", "feature"] = "raw"
    techniques: Annotated[
        list[Literal["ml", "mlr", "abl"]],
        Field(min_length=1, max_length=3, default_factory=lambda: ["ml", "mlr", "abl"]),
    ]
    floor_ids: Annotated[list[FloorId], Field(min_length=1, max_length=1000)] | None = None
    prior: PriorBody | None = None
    options: OptionsBody = OptionsBody()


class BatchBody(RequestModel):
    queries: Annotated[list[LocateBody], Field(min_length=1, max_length=MAX_BATCH)]


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
    radius_68_m: float
    radius_95_m: float
    modes: list[ModeView]


class Timing(BaseModel):
    """Milliseconds: the search; and all from when the request was read, waiting for its turn included."""

    search: float
    total: float


class FixView(BaseModel):
    model_config = ConfigDict(json_schema_extra={"examples": [_EXAMPLE_FIX]})
    status: Literal["fix", "ambiguous", "inconsistent", "unmapped"]
    reason: Annotated[str | None, Field(description="for every status but fix: what is wrong and what would help")]
    estimates: dict[Literal["ml", "mlr", "abl"], Estimate]
    posterior: PosteriorView | None
    map_ids: list[str]
    timing_ms: Timing


class BatchAnswer(BaseModel):
    fixes: list[FixView]


@router.post(
    "/buildings/{building_id}/locate", response_model=FixView, summary="Locate a window anywhere in a building"
)
async def locate_in_building(building_id: Id, body: LocateBody, context: ContextDep, identity: Locating) -> Response:
    """Every floor with an active map is searched, or those in `floor_ids`."""
    return _json(await _in_turn(context, partial(_building_maps, context, identity, building_id), body))


@router.post("/floors/{floor_id}/locate", response_model=FixView, summary="Locate a window on one floor")
async def locate_on_floor(floor_id: Id, body: LocateBody, context: ContextDep, identity: Locating) -> Response:
    return _json(await _in_turn(context, partial(_floor_maps, context, identity, floor_id), body))


@router.post(
    "/buildings/{building_id}/locate:batch", response_model=BatchAnswer, summary="Locate many windows in a building"
)
async def locate_batch_in_building(
    building_id: Id, body: BatchBody, context: ContextDep, identity: Locating
) -> Response:
    find_maps = partial(_building_maps, context, identity, building_id)
    return _json(BatchAnswer(fixes=[await _in_turn(context, find_maps, query) for query in body.queries]))


@router.post("/floors/{floor_id}/locate:batch", response_model=BatchAnswer, summary="Locate many windows on one floor")
async def locate_batch_on_floor(floor_id: Id, body: BatchBody, context: ContextDep, identity: Locating) -> Response:
    find_maps = partial(_floor_maps, context, identity, floor_id)
    return _json(BatchAnswer(fixes=[await _in_turn(context, find_maps, query) for query in body.queries]))


async def _in_turn(context: Context, find_maps: Callable[[LocateBody], list[ActiveMap]], body: LocateBody) -> FixView:
    """One window's answer, when its turn comes. A batch queues anew for each of its windows: others come in between."""
    start = perf_counter()
    loop = asyncio.get_running_loop()
    return await loop.run_in_executor(context.searches, lambda: _locate(context, find_maps(body), body, start))


def _json(answer: BaseModel) -> Response:
    """A response as it goes out. FastAPI would check the model, which was checked as it was made, once more."""
    return Response(answer.model_dump_json(), media_type="application/json")


def _building_maps(context: Context, identity: Identity, building_id: str, body: LocateBody) -> list[ActiveMap]:
    with context.engine.connect() as connection:
        maps = active_maps(connection, identity.organisation_id, building_id=building_id, floor_ids=body.floor_ids)
        if not maps and connection.scalars(
            select(Building.id).where(Building.id == building_id, Building.organisation_id == identity.organisation_id)
        ).first() is None:  # fmt: skip
            raise NotFound(f"no building {building_id}")
    return maps


def _floor_maps(context: Context, identity: Identity, floor_id: str, body: LocateBody) -> list[ActiveMap]:
    if body.floor_ids is not None and body.floor_ids != [floor_id]:
        raise InvalidInput("floor_ids is for buildings", Fault("/body/floor_ids", "leave it out on a floor"))
    with context.engine.connect() as connection:
        return active_maps(connection, identity.organisation_id, floor_ids=[floor_id])


def _locate(context: Context, maps: list[ActiveMap], body: LocateBody, start: float) -> FixView:
    if len(body.window.b_ut) > context.settings.max_window_samples:
        limit = context.settings.max_window_samples
        raise InvalidWindow(f"the window has more than {limit} samples", Fault("/body/window/b_ut", "send fewer"))
    if body.composition not in ("raw", "demeaned"):
        offered = Fault("/body/composition", f"{body.composition} is not offered yet; use raw, or demeaned")
        raise InvalidInput(offered.reason, offered)
    result = locate_window(
        maps,
        context.grids,
        _window(body.window),
        composition=body.composition,
        techniques=body.techniques,
        prior=Prior((*body.prior.position_m,), body.prior.sd_m) if body.prior else None,  # type: ignore[arg-type]
        options=LocateOptions(**body.options.model_dump()),
    )
    timing = Timing(search=result.search_ms, total=1e3 * (perf_counter() - start))
    return show_fix(result.fix, body.techniques, list(result.map_ids), timing)


def _window(body: WindowBody) -> Window:
    """The window in one of the core's frames: a body window is turned to the building frame here."""
    B = np.asarray(body.b_ut, dtype=np.float64).reshape(len(body.b_ut), -1)
    frame = body.frame
    norm_uT = B[:, 0] if frame == "norm" else np.linalg.norm(B, axis=1)
    message, faults = field_faults(norm_uT, lambda sample: f"/body/window/b_ut/{sample}")
    if message is not None:
        raise InvalidWindow(message, *faults)
    t_s = None if body.t_s is None else np.asarray(body.t_s)
    if t_s is not None and (backwards := np.flatnonzero(np.diff(t_s) <= 0.0)).size:
        at = int(backwards[0]) + 1
        reason = f"{t_s[at]:g} s does not come after {t_s[at - 1]:g} s"
        raise InvalidWindow("the window's time does not increase", Fault(f"/body/window/t_s/{at}", reason))
    if frame == "body":
        q = np.asarray(body.orientation, dtype=np.float64)
        norms = np.linalg.norm(q, axis=1)
        if (np.abs(norms - 1.0) > 0.1).any():
            bad = int(np.argmax(np.abs(norms - 1.0) > 0.1))
            raise InvalidWindow(
                "an orientation is not a unit quaternion",
                Fault(f"/body/window/orientation/{bad}", f"its norm is {norms[bad]:.3g}, not 1"),
            )
        B, frame = rotate_by_quaternion(q / norms[:, None], B), "building"
    return Window(
        frame=frame,
        B_uT=B,
        displacement_m=np.asarray(body.displacement_m, dtype=np.float64),
        noise_uT=body.noise_ut,
        t_s=t_s,
        heading_rad=body.heading_rad,
        heading_sd_rad=body.heading_sd_rad,
        yaw_rad=None if body.yaw_rad is None else np.asarray(body.yaw_rad),
    )


def show_fix(fix: Fix, techniques: list[Literal["ml", "mlr", "abl"]], map_ids: list[str], timing: Timing) -> FixView:
    """The fix as the contract shows it, with the techniques that were asked for."""
    nothing = Estimate(available=False, reason=fix.reason or "no candidate floor has a map")
    estimates: dict[Literal["ml", "mlr", "abl"], Estimate] = {
        "ml": Estimate(available=True, **_fields(fix.ml)) if fix.ml else nothing,
        "mlr": Estimate.model_validate(_fields(fix.mlr)),
        "abl": Estimate.model_validate(_fields(fix.abl)),
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
        timing_ms=timing,
    )


def _fields(value: object) -> dict[str, Any]:
    """The fields of a frozen, slotted dataclass, tuples as lists."""
    fields = {name: getattr(value, name) for name in value.__slots__}  # type: ignore[attr-defined]
    return {name: list(field) if isinstance(field, tuple) else field for name, field in fields.items()}
