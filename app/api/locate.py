"""Where am I? A window of magnetometer samples in, a fix out. Nothing is written, nothing queued."""

from collections.abc import Callable, Sequence
from functools import partial
from time import perf_counter
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from opentelemetry import trace
from pydantic import BaseModel
from sqlalchemy import select

from app.api.auth import Identity, Locating
from app.api.context import Context, ContextDep
from app.api.locate_answer import BatchAnswer, FixView, Timing, show_fix
from app.api.locate_request import BatchBody, LocateBody, core_options, core_window
from app.api.models import Id
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Building
from app.errors import Fault, InvalidInput, InvalidWindow, NotFound
from app.positioning.fix import Prior
from app.services.calibrations import AppliedCalibration, find_calibration
from app.services.locate_window import ActiveMap, LocateResult, active_maps, locate_window
from app.telemetry.metrics import (
    LOCATE_ESTIMATES,
    LOCATE_FIXES,
    LOCATE_FLOORS,
    LOCATE_SEARCH_SECONDS,
    LOCATE_SECONDS,
    LOCATE_WAITING_SECONDS,
)

__all__ = ["router"]

_tracer = trace.get_tracer("isodyn")
router = APIRouter(prefix="/v1", tags=["locate"], responses=ERROR_RESPONSES)
Explain = Annotated[
    bool, Query(description="also answer the likelihood over the floor, residuals, and the runner-up; takes longer")
]


@router.post(
    "/buildings/{building_id}/locate", response_model=FixView, summary="Locate a window anywhere in a building"
)
async def locate_in_building(
    building_id: Id, body: LocateBody, request: Request, context: ContextDep, identity: Locating,
    explain: Explain = False,
) -> Response:  # fmt: skip
    """Every floor with an active map is searched, or those in `floor_ids`."""
    find_maps = partial(_building_maps, context, identity, building_id)
    return _json(await _in_turn(context, identity, find_maps, request, body, explain))


@router.post("/floors/{floor_id}/locate", response_model=FixView, summary="Locate a window on one floor")
async def locate_on_floor(
    floor_id: Id, body: LocateBody, request: Request, context: ContextDep, identity: Locating,
    explain: Explain = False,
) -> Response:  # fmt: skip
    find_maps = partial(_floor_maps, context, identity, floor_id)
    return _json(await _in_turn(context, identity, find_maps, request, body, explain))


@router.post(
    "/buildings/{building_id}/locate:batch", response_model=BatchAnswer, summary="Locate many windows in a building"
)
async def locate_batch_in_building(
    building_id: Id, body: BatchBody, request: Request, context: ContextDep, identity: Locating
) -> Response:
    find_maps = partial(_building_maps, context, identity, building_id)
    return _json(await _each_in_turn(context, identity, find_maps, request, body))


@router.post("/floors/{floor_id}/locate:batch", response_model=BatchAnswer, summary="Locate many windows on one floor")
async def locate_batch_on_floor(
    floor_id: Id, body: BatchBody, request: Request, context: ContextDep, identity: Locating
) -> Response:
    find_maps = partial(_floor_maps, context, identity, floor_id)
    return _json(await _each_in_turn(context, identity, find_maps, request, body))


FindMaps = Callable[[LocateBody], list[ActiveMap]]


async def _in_turn(
    context: Context, identity: Identity, find_maps: FindMaps, request: Request, body: LocateBody,
    explain: bool = False, admitted: bool = False,
) -> FixView:  # fmt: skip
    """One window's answer, when its turn comes. Raises Overloaded where that would take too long."""
    start = perf_counter()
    return await context.searches.run(
        lambda: _locate(context, identity, find_maps(body), body, start, explain),
        request.is_disconnected, admitted,
    )  # fmt: skip


async def _each_in_turn(
    context: Context, identity: Identity, find_maps: FindMaps, request: Request, body: BatchBody
) -> BatchAnswer:
    """A batch queues anew for each of its windows: others come in between. For its key's rate it counts as many."""
    context.key_limits.take(identity.key_id, len(body.queries) - 1)
    fixes: list[FixView] = []
    for query in body.queries:
        fixes.append(await _in_turn(context, identity, find_maps, request, query, admitted=bool(fixes)))
    return BatchAnswer(fixes=fixes)


def _json(answer: BaseModel) -> Response:
    """A response as it goes out. FastAPI would check the model, which was checked as it was made, once more."""
    unasked = {"explanation"} if isinstance(answer, FixView) and answer.explanation is None else None
    return Response(answer.model_dump_json(exclude=unasked), media_type="application/json")


def _building_maps(context: Context, identity: Identity, building_id: str, body: LocateBody) -> list[ActiveMap]:
    with context.engine.connect() as connection:
        maps = active_maps(connection, identity.reach, building_id=building_id, floor_ids=body.floor_ids)
        if not maps:
            owner = connection.scalars(select(Building.organisation_id).where(Building.id == building_id)).first()
            if owner is None or not identity.reach.holds(owner, building_id):
                raise NotFound(f"no building {building_id}")
    return maps


def _floor_maps(context: Context, identity: Identity, floor_id: str, body: LocateBody) -> list[ActiveMap]:
    if body.floor_ids is not None and body.floor_ids != [floor_id]:
        raise InvalidInput("floor_ids is for buildings", Fault("/body/floor_ids", "leave it out on a floor"))
    with context.engine.connect() as connection:
        return active_maps(connection, identity.reach, floor_ids=[floor_id])


def _calibration(context: Context, identity: Identity, body: LocateBody) -> AppliedCalibration | None:
    window = body.window
    if window.calibration_id is None and window.device is None:
        return None
    with context.transaction() as session:
        return find_calibration(session, identity.organisation_id, window.calibration_id, window.device)


def _locate(
    context: Context, identity: Identity, maps: list[ActiveMap], body: LocateBody, start: float, explained: bool
) -> FixView:
    LOCATE_WAITING_SECONDS.observe(perf_counter() - start)
    if len(body.window.b_ut) > context.settings.max_window_samples:
        limit = context.settings.max_window_samples
        raise InvalidWindow(f"the window has more than {limit} samples", Fault("/body/window/b_ut", "send fewer"))
    calibration = _calibration(context, identity, body)
    with _tracer.start_as_current_span("search"):
        result = locate_window(
            maps,
            context.grids,
            core_window(body.window, None if calibration is None else calibration.model),
            composition=body.composition,
            techniques=body.techniques,
            prior=Prior((*body.prior.position_m,), body.prior.sd_m) if body.prior else None,  # type: ignore[arg-type]
            options=core_options(body, perf_counter),
            explained=explained,
        )
    timing = Timing(search=result.search_ms, total=1e3 * (perf_counter() - start))
    _count(result, body.techniques, timing)
    return show_fix(result.fix, body.techniques, list(result.map_ids), timing, result.explanation, calibration)


def _count(result: LocateResult, techniques: Sequence[str], timing: Timing) -> None:
    LOCATE_SECONDS.observe(1e-3 * timing.total)
    LOCATE_SEARCH_SECONDS.observe(1e-3 * timing.search)
    LOCATE_FLOORS.observe(len(result.map_ids))
    LOCATE_FIXES.labels(result.fix.status).inc()
    for technique in techniques:
        found = getattr(result.fix, technique)
        available = found is not None and getattr(found, "available", True)
        LOCATE_ESTIMATES.labels(technique, str(available).lower()).inc()
