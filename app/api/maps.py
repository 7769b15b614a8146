"""Maps: ask for one, look at it, ask it for the field, take it away as a file or a picture."""

import json
from datetime import datetime
from hashlib import sha256 as sha256_of
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy import select, update
from sqlalchemy.orm import Session

from app import __version__
from app.api.auth import Identity, MapWriting, Reading, actor
from app.api.caching import immutable, pointer
from app.api.context import Context, ContextDep
from app.api.idempotency import IdempotencyKey, answer_once
from app.api.jobs import PRIORITIES, JobView, Priority, show_job
from app.api.listing import Page, PagingDep, list_page
from app.api.models import Finite, Id, Metres, Point, RequestModel
from app.api.ownership import find_own
from app.api.problems import ERROR_RESPONSES
from app.api.windows import AskedWindowDep
from app.db.tables import Floor, Map, Survey
from app.errors import Conflict, Fault, IncompatibleFrames, InvalidInput, NotFound
from app.field.grid import FieldGrid
from app.field.kernels import base_kernel, is_sum
from app.field.samples import COMPONENT_NAMES, Components, SampleFrame, richest_components
from app.field.spec import Kernel, MapSpec, Noise
from app.services.artefacts import layers_from_bytes, samples_from_bytes
from app.services.audit_log import ACCEPTED, record
from app.services.exact_limit import TOO_MANY, outgrow_exact
from app.services.export_map import EXTENSIONS, MEDIA_TYPES, ExportFormat, export_map
from app.viewer.layers import check_layer, nearest_height

__all__ = ["MapView", "ready_map", "router"]

router = APIRouter(prefix="/v1", tags=["maps"], responses=ERROR_RESPONSES)
MAX_FIELD_POINTS = 100_000
_BINARY = {"schema": {"type": "string", "format": "binary"}}


class NewMap(RequestModel):
    """What to build; everything left out has a good default."""

    model_config = ConfigDict(
        extra="forbid", json_schema_extra={"examples": [{}, {"engine": "hilbert", "priority": "high"}]}
    )
    engine: Literal["hilbert", "exact", "compromise"] = "hilbert"
    components: Annotated[Components | None, Field(description="default: the richest all surveys can give")] = None
    kernel: Annotated[
        Kernel | None,
        Field(description="one, or a sum of two lengths; default matern32, curl-free squared_exponential"),
    ] = None
    curl_free: Annotated[
        bool, Field(description="the field as the gradient of a potential: vector maps, engine hilbert")
    ] = False
    noise: Annotated[
        Noise, Field(description="walk: errors along a walk may be correlated, as far as the data say so; white: never")
    ] = "walk"
    hard_iron: Annotated[
        bool, Field(description="take the sensors' own constant field out of surveys that know their orientation")
    ] = True
    robust: Annotated[bool, Field(description="heavy-tailed errors: stray readings count less")] = False
    refine: Annotated[
        bool, Field(description="correct the surveys' positions where that proves itself: engine hilbert")
    ] = False
    resolution_m: Annotated[Finite, Field(ge=0.05, le=5.0)] = 0.25
    heights_m: Annotated[
        list[Metres], Field(min_length=1, max_length=100, description="one height; default: the samples' median")
    ] | None = None  # fmt: skip
    survey_ids: Annotated[
        list[Annotated[str, Field(max_length=64, pattern=r"^[A-Za-z0-9_-]+$")]], Field(min_length=1, max_length=10_000)
    ] | None = None  # fmt: skip
    activate: bool = True
    priority: Annotated[
        Priority,
        Field(description="among the jobs of your organisation; rebuilds that follow from uploads are low"),
    ] = "normal"


class ScoreView(BaseModel):
    """Leave-one-survey-out score; lists have one value per component."""

    rmse_ut: list[float]
    coverage_2sigma: list[float]
    nlpd: float
    held_out_samples: int
    rmse_vec_ut: Annotated[float | None, Field(description="root of the summed squares of rmse_ut")] = None
    rmse_of_norm_ut: Annotated[float | None, Field(description="of the magnitude, predicted against measured")] = None
    sharpness_ut: Annotated[list[float], Field(description="mean predictive sd, noise included")] = []


class MapView(BaseModel):
    id: str
    floor_id: str
    engine: str
    components: Components | None
    kernel: Annotated[Kernel, Field(description="of the prior; what was asked for, or the default")]
    curl_free: bool
    heights_m: Annotated[list[float] | None, Field(description="as asked; null: one layer at the samples' median")]
    noise: Annotated[Noise, Field(description="engines exact and compromise know white noise only, whatever this says")]
    hard_iron: bool
    robust: bool
    refine: bool
    status: Literal["accepted", "running", "ready", "failed", "dismissed"]
    active: bool
    created_at: datetime
    bounds_m: Annotated[list[float] | None, Field(description="x_min, y_min, z_min, x_max, y_max, z_max")]
    resolution_m: float
    hyperparameters: dict[str, Any] | None
    score: ScoreView | None
    score_reason: Annotated[str | None, Field(description="why there is no score")]
    survey_ids: list[str]
    sha256: Annotated[str | None, Field(description="of the grid: the map's identity and ETag")]


class NewMapAnswer(BaseModel):
    map: MapView
    job: JobView


class FieldQuery(RequestModel):
    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"points_m": [[3.0, 4.0, 1.2]]}]})
    points_m: Annotated[list[Point], Field(min_length=1, max_length=MAX_FIELD_POINTS)]
    gradient: bool = False


class FieldAnswer(BaseModel):
    """One row per point, one column per component; null where nothing was measured."""

    components: list[str]
    mean_ut: list[list[float] | None]
    sd_ut: list[list[float] | None]
    measured: list[bool]
    points_m: Annotated[list[list[float]], Field(description="the points, as asked")]
    gradient_ut_per_m: Annotated[
        list[list[list[float | None]] | None] | None,
        Field(description="per component, with x, y, z; z is null where the map does not know it"),
    ] = None


def show_map(row: Map, active_map_id: str | None) -> MapView:
    asked = MapSpec(**row.spec)
    same = ("engine", "curl_free", "heights_m", "noise", "hard_iron", "robust", "refine", "resolution_m")
    return MapView.model_validate(
        {
            "active": row.id == active_map_id, "sha256": row.grid_sha256, "kernel": asked.covariance,
            "components": row.components or row.spec.get("components"),
            **{name: getattr(asked, name) for name in same},
            **{name: getattr(row, name) for name in
               ("id", "floor_id", "status", "created_at", "bounds_m", "hyperparameters", "score", "score_reason",
                "survey_ids")},
        }
    )  # fmt: skip


def _check_together(body: NewMap) -> None:
    """Refuse what does not go together, one fault each."""
    faults = []
    if body.curl_free and (body.engine != "hilbert" or body.components not in (None, "vector")):
        faults.append(Fault("/body/curl_free", "needs engine hilbert and components vector"))
    if body.robust and body.engine != "hilbert":
        faults.append(Fault("/body/robust", "needs engine hilbert"))
    if body.refine and body.engine != "hilbert":
        faults.append(Fault("/body/refine", "needs engine hilbert"))
    if body.kernel is not None and is_sum(body.kernel) and body.engine != "hilbert":
        faults.append(Fault("/body/kernel", f"a sum needs engine hilbert; ask for {base_kernel(body.kernel)}"))
    if body.kernel is not None and is_sum(body.kernel) and body.curl_free:
        faults.append(Fault("/body/kernel", f"a potential has one length; ask for {base_kernel(body.kernel)}"))
    if body.heights_m is not None and any(b - a < 0.01 for a, b in pairwise(body.heights_m)):
        faults.append(Fault("/body/heights_m", "heights must rise, by a centimetre at least"))
    if faults:
        raise InvalidInput(faults[0].reason, *faults)


def _check_surveys(session: Session, floor_id: str, body: NewMap) -> list[str]:
    """The surveys to build from, sorted; refuses what could only fail later."""
    statement = select(Survey.id, Survey.frame).where(Survey.floor_id == floor_id)
    rows = session.execute(
        statement.where(Survey.included) if body.survey_ids is None else statement.where(Survey.id.in_(body.survey_ids))
    ).all()
    unknown = sorted(set(body.survey_ids or ()) - {row.id for row in rows})
    if unknown:
        raise InvalidInput("some surveys are not on this floor", *[Fault("/body/survey_ids", i) for i in unknown[:20]])
    if not rows:
        raise Conflict("the floor has no included survey to build a map from; upload one first")
    frames: set[SampleFrame] = {row.frame for row in rows}
    best = richest_components(frames)
    order = list(COMPONENT_NAMES)
    if body.curl_free and best != "vector":
        raise IncompatibleFrames(f"surveys in the {' and '.join(sorted(frames))} frame give no vector: no curl either")
    if body.components is not None and order.index(body.components) < order.index(best):
        raise IncompatibleFrames(
            f"surveys in the {' and '.join(sorted(frames))} frame cannot all give a {body.components} map; "
            f"ask for {best}, or leave the others out by survey_ids"
        )
    return sorted(row.id for row in rows)


def _check_engine(session: Session, context: Context, row: Map) -> None:
    """Refuse surveys that hold more than the engine takes."""
    if row.spec["engine"] != "exact":
        return
    stored = session.scalars(select(Survey.samples_sha256).where(Survey.id.in_(row.survey_ids))).all()
    if outgrow_exact(samples_from_bytes(context.blobs.get(sha256)) for sha256 in stored):
        reason = f"{TOO_MANY}: use engine compromise or hilbert, or name fewer survey_ids"
        raise InvalidInput(reason, Fault("/body/engine", reason))


@router.post("/floors/{floor_id}/maps", status_code=202, response_model=NewMapAnswer, summary="Build a map")
def create_map(
    floor_id: Id, body: NewMap, request: Request, context: ContextDep, identity: MapWriting, key: IdempotencyKey = None
) -> Response:
    """A floor with `auto_build` builds by itself after each change; this builds with parameters of your own."""

    _check_together(body)

    def create(session: Session) -> tuple[int, BaseModel]:
        floor = find_own(session, identity, Floor, floor_id)
        row = Map(
            organisation_id=floor.organisation_id,
            floor_id=floor.id,
            status="accepted",
            activate=body.activate,
            spec=body.model_dump(exclude={"survey_ids", "activate", "priority"}, exclude_none=True),
            survey_ids=_check_surveys(session, floor.id, body),
        )
        _check_engine(session, context, row)
        session.add(row)
        session.flush()
        job = context.queue.enqueue_build(session, row, PRIORITIES[body.priority])
        record(session, actor(request, identity), "build", row, ACCEPTED, floor_id=floor.id, job_id=job.id)
        return 202, NewMapAnswer(map=show_map(row, floor.active_map_id), job=show_job(job))

    return answer_once(context, identity, request, key, body.model_dump_json().encode(), create)


@router.get("/floors/{floor_id}/maps", summary="List a floor's maps")
def list_maps(floor_id: Id, context: ContextDep, identity: Reading, paging: PagingDep) -> Page[MapView]:
    with context.transaction() as session:
        active = find_own(session, identity, Floor, floor_id).active_map_id
        mine = select(Map).where(Map.floor_id == floor_id)
        return list_page(session, mine, Map.id, paging, lambda row: show_map(row, active))


@router.get("/maps/{map_id}", response_model=MapView, summary="One map: its state, score and parameters")
def get_map(map_id: Id, request: Request, context: ContextDep, identity: Reading) -> Response:
    with context.transaction() as session:
        row = find_own(session, identity, Map, map_id)
        return pointer(request, show_map(row, session.get_one(Floor, row.floor_id).active_map_id))


@router.post("/maps/{map_id}/activate", summary="Answer with this map from now on")
def activate_map(map_id: Id, request: Request, context: ContextDep, identity: MapWriting) -> MapView:
    """Moves one pointer; works on any finished map of the floor, so it also rolls back. Where the floor is searched,
    the map is made ready first."""
    with context.transaction() as session:
        coming = find_own(session, identity, Map, map_id)
        floor_id, sha256 = coming.floor_id, coming.grid_sha256
    if sha256 is not None:
        context.grids.renew({floor_id: sha256})
    with context.transaction() as session:
        row = find_own(session, identity, Map, map_id)
        if row.status != "ready":
            raise Conflict(f"map {map_id} is {row.status}; only a finished map can be activated")
        session.execute(
            update(Floor)
            .where(Floor.id == row.floor_id)
            .values(active_map_id=row.id, active_sequence=Floor.build_sequence)
        )
        record(session, actor(request, identity), "activate", row, floor_id=row.floor_id)
        return show_map(row, row.id)


@router.post("/maps/{map_id}/field", summary="The field at points")
def read_field(map_id: Id, body: FieldQuery, context: ContextDep, identity: Reading) -> FieldAnswer:
    """Points outside the map or not measured answer null and `measured: false`, never an invented value."""
    grid, _ = _ready_grid(context, identity, map_id)
    values = grid.at(body.points_m)  # type: ignore[arg-type]  # numpy takes the lists as they are
    measured = values.measured.tolist()

    def shown(rows: list[Any]) -> list[Any]:
        return [row if ok else None for row, ok in zip(rows, measured, strict=True)]

    gradient = None
    if body.gradient:
        rows = values.gradient_uT_per_m.tolist()
        gradient = shown([[[*slope, None][:3] for slope in row] for row in rows])
    return FieldAnswer(
        components=list(grid.component_names),
        mean_ut=shown(values.mean_uT.tolist()),
        sd_ut=shown(values.sd_uT.tolist()),
        measured=measured,
        points_m=body.points_m,
        gradient_ut_per_m=gradient,
    )


@router.get("/maps/{map_id}/quality", summary="Score, noise and every survey's consistency")
def get_quality(map_id: Id, request: Request, context: ContextDep, identity: Reading) -> Response:
    with context.transaction() as session:
        row = find_own(session, identity, Map, map_id)
        sha256 = row.quality_sha256
    if sha256 is None:
        raise NotFound(f"map {map_id} is {row.status}; it has no quality report yet")
    return immutable(request, sha256, lambda: context.blobs.get(sha256), "application/json")


@router.get(
    "/maps/{map_id}/export",
    summary="The map as a file",
    response_class=Response,
    responses={200: {"content": dict.fromkeys(MEDIA_TYPES.values(), _BINARY)}},
)
def get_export(
    map_id: Id,
    request: Request,
    context: ContextDep,
    identity: Reading,
    format: Annotated[ExportFormat, Query()],
    gradient: Annotated[bool, Query(description="also the derivatives with x and y (z where the map knows it)")] = True,
    localizability: Annotated[
        bool, Query(description="also gradient norms, information and expected error (10 m window, 0.5 uT noise)")
    ] = False,
) -> Response:
    """Mean, standard deviation, gradient and the layers of the fit, at every height; unmeasured cells are missing."""
    ready = ready_map(context, identity, map_id)

    def file() -> bytes:
        return export_map(ready.grid, format, ready.sha256, ready.stored_layers(context), gradient, localizability)

    tag = ready.tag(format, f"gradient={gradient}", *["localizability"] * localizability)
    response = immutable(request, tag, file, MEDIA_TYPES[format])
    name = f"isodyn-{ready.sha256[:12]}.{EXTENSIONS[format]}"
    response.headers["Content-Disposition"] = f'attachment; filename="{name}"'
    return response


@router.get(
    "/maps/{map_id}/heatmap.png",
    summary="A picture of one layer",
    response_class=Response,
    responses={200: {"content": {"image/png": _BINARY}}},
)
def get_heatmap(
    map_id: Id,
    request: Request,
    context: ContextDep,
    identity: Reading,
    asked: AskedWindowDep,
    layer: Annotated[str, Query(max_length=40, examples=["norm", "bx", "sd", "expected_error"])] = "norm",
    height_m: Annotated[
        Metres | None, Query(description="the nearest of the map's heights, within half a metre, is shown")
    ] = None,
) -> Response:
    """A map's layers follow from its components; an answer to a wrong name lists them.

    Window and sensor are those of the layer `expected_error`; `information` takes `noise_ut`; no other takes any.
    """
    from app.viewer.heatmap import heatmap_png  # matplotlib takes half a second to load, and few calls need it

    ready = ready_map(context, identity, map_id)
    stored = ready.stored_layers(context)
    check_layer(ready.grid, layer, stored)
    used, k = asked.of_layer(request, layer), nearest_height(ready.grid, height_m)

    def picture() -> bytes:
        return heatmap_png(ready.grid, layer, height_index=k, stored=stored, window=asked.model())

    return immutable(request, ready.tag(layer, k, *used), picture, "image/png")


@router.get(
    "/maps/{map_id}/view.html",
    summary="The map as one self-contained 3-D page",
    response_class=Response,
    responses={200: {"content": {"text/html": {"schema": {"type": "string"}}}}},
)
def get_view(map_id: Id, request: Request, context: ContextDep, identity: Reading) -> Response:
    """Every layer at every height, the walks and the outline: needs no server and no network once it is saved."""
    from app.viewer.database_source import rings_of_polygon
    from app.viewer.source import Walk
    from app.viewer.static_view import PAGE_POLICY, static_view_html  # viser is loaded only when somebody looks

    ready = ready_map(context, identity, map_id)
    with context.transaction() as session:
        row = find_own(session, identity, Map, map_id)
        floor = session.get_one(Floor, row.floor_id)
        surveys = session.scalars(select(Survey).where(Survey.id.in_(row.survey_ids)).order_by(Survey.id)).all()

    def page() -> bytes:
        samples = [samples_from_bytes(context.blobs.get(survey.samples_sha256)) for survey in surveys]
        walks = [Walk(s.id, s.name, w) for s, w in zip(surveys, samples, strict=True)]
        rings, title = rings_of_polygon(floor.outline), f"{floor.name}: magnetic map"
        stored = ready.stored_layers(context)
        return static_view_html(ready.grid, walks, title, rings, floor.elevation_m, stored=stored).encode()

    drawn = [[survey.id for survey in surveys], floor.name, floor.elevation_m, floor.outline]
    shown = sha256_of(json.dumps(drawn).encode()).hexdigest()
    answer = immutable(request, ready.tag("view", shown[:16]), page, "text/html")
    answer.headers["Content-Security-Policy"] = f"{PAGE_POLICY}; frame-ancestors 'self'"
    answer.headers["X-Frame-Options"] = "SAMEORIGIN"
    return answer


class ReadyMap(NamedTuple):
    grid: FieldGrid
    sha256: str
    layers_sha256: str | None

    def stored_layers(self, context: Context) -> dict[str, NDArray[np.float32]]:
        """The layers the fit left beside the grid; none for a map older than they are."""
        return {} if self.layers_sha256 is None else layers_from_bytes(context.blobs.get(self.layers_sha256))

    def tag(self, *parts: object) -> str:
        """The name of what is made of the map: its content, what was asked for, and who made it."""
        layers = [] if self.layers_sha256 is None else [self.layers_sha256[:16]]
        return "-".join([self.sha256, *layers, *map(str, parts), __version__])


def ready_map(context: Context, identity: Identity, map_id: str) -> ReadyMap:
    """A finished map of the caller's. Raises NotFound, Conflict."""
    with context.transaction() as session:
        row = find_own(session, identity, Map, map_id)
        sha256, layers_sha256, status = row.grid_sha256, row.layers_sha256, row.status
    if sha256 is None:
        raise Conflict(f"map {map_id} is {status}; it has no field yet")
    return ReadyMap(context.grids.grid(sha256), sha256, layers_sha256)


def _ready_grid(context: Context, identity: Identity, map_id: str) -> tuple[FieldGrid, str]:
    ready = ready_map(context, identity, map_id)
    return ready.grid, ready.sha256
