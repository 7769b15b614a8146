"""Tracks: follow a device step by step, read where it was, and follow it again."""

import asyncio
from collections.abc import AsyncIterator, Iterator, Sequence
from datetime import UTC, datetime
from secrets import randbits
from typing import Annotated, Any, Literal

import msgspec
from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from fastapi.responses import StreamingResponse
from pydantic import BaseModel
from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app import __version__
from app.api.auth import Identity, Locating, TrackReading, actor
from app.api.context import Context, ContextDep
from app.api.idempotency import IdempotencyKey, RawBody, answer_once
from app.api.listing import Page, PagingDep, list_page
from app.api.locate_request import FloorId
from app.api.models import Id
from app.api.ownership import find_own, own
from app.api.problems import ERROR_RESPONSES
from app.api.track_answer import (
    EstimateView,
    PathView,
    ReplayedEnd,
    StepsAnswer,
    StepsPage,
    TrackDetail,
    TrackView,
    path_points,
    show_track,
    smoothed_points,
    steps_answer,
)
from app.api.track_ground import read_ground
from app.api.track_request import NewTrack, StepsBody, core_options, core_prior, raw_steps
from app.db.tables import Building, Floor, Track, TrackSteps
from app.errors import Conflict, Fault, InvalidInput, TooMany
from app.services.audit_log import record
from app.services.calibrations import find_calibration
from app.services.estimate_attitude import check_vector, earth_as_reference
from app.services.locate_window import ActiveMap, active_maps
from app.services.replay_track import ReplayedBatch, replay_track
from app.services.step_order import RawStep
from app.services.track_estimate import SEARCHING, unsettled_rows
from app.services.track_log import batches_of, delete_track, end_track
from app.services.track_spec import StepKind, check_walkable, make_spec, step_kind

__all__ = ["router"]

router = APIRouter(prefix="/v1/tracks", tags=["tracks"], responses=ERROR_RESPONSES)
FromStep = Annotated[int, Query(ge=0, le=2**53 - 1, description="the first number that is answered")]
Limit = Annotated[int, Query(ge=1, le=5000, description="most on one page")]


@router.post("", status_code=201, response_model=TrackDetail, summary="Begin a track")
def create_track(
    body: NewTrack, raw: RawBody, request: Request, context: ContextDep, identity: Locating,
    key: IdempotencyKey = None,
) -> Response:  # fmt: skip
    """The maps that floors answer with now are pinned: the track is followed on them to its end, whatever is built
    meanwhile. Steps go to `POST /v1/tracks/{track_id}/steps`, or over the WebSocket `/v1/tracks/{track_id}/stream`."""

    def create(session: Session) -> tuple[int, BaseModel]:
        _check_count(session, context, identity)
        floors, maps = _floors_and_maps(session, identity, body)
        ground = read_ground(body.options, {each.floor_id: floors[each.floor_id].outline for each in maps})
        calibration = find_calibration(session, identity.organisation_id, body.calibration_id, body.device)
        attitude = _attitude(session, identity, body, next(iter(floors.values())), context, maps)
        row = Track(
            organisation_id=identity.organisation_id, key_id=identity.key_id, name=body.name, frame=body.frame,
            building_id=next(iter(floors.values())).building_id, seed=randbits(53) if body.seed is None else body.seed,
            spec=make_spec(maps, core_options(body.options), core_prior(body.prior), ground,
                           body.orientation_frame, calibration, attitude),
        )  # fmt: skip
        check_walkable(context.follower.trackers.make(row.spec, row.frame, row.seed))
        session.add(row)
        session.flush()
        record(session, actor(request, identity), "create", row, building_id=row.building_id)
        return 201, _detail(context, row, SEARCHING)

    return answer_once(context, identity, request, key, raw, create)


def _attitude(
    session: Session, identity: Identity, body: NewTrack, floor: Floor, context: Context, maps: Sequence[ActiveMap]
) -> dict[str, Any] | None:
    """The reference of the track's own attitude, pinned. Raises InvalidInput, IncompatibleFrames."""
    if body.attitude is None:
        return None
    kind = body.attitude.reference
    if kind == "map":
        for each in maps:
            check_vector(context.grids.grid(each.grid_sha256))
    if kind != "wmm":
        return {"reference": kind}
    today = datetime.now(UTC).date()
    return {"reference": kind} | earth_as_reference(session, identity.reach, floor.building_id, None, today)


def _check_count(session: Session, context: Context, identity: Identity) -> None:
    """Raise TooMany when the key has as many active tracks as it may."""
    count = session.scalar(
        select(func.count()).where(
            Track.key_id == identity.key_id, Track.status == "active", Track.touched_at >= context.follower.idle_before
        )
    )
    most = context.settings.max_tracks_per_key
    if (count or 0) >= most:
        raise TooMany(
            f"this key has {most} active tracks, which is the most; end or delete some, or wait until they are idle",
            retry_after_s=min(context.settings.track_idle_timeout_s, 60.0),
        )


def _floors_and_maps(session: Session, identity: Identity, body: NewTrack) -> tuple[dict[str, Floor], list[ActiveMap]]:
    """The floors asked for that have a map, by id, and their maps. Raises NotFound, Conflict, InvalidInput."""
    if body.building_id is not None:
        find_own(session, identity, Building, body.building_id)
    maps = active_maps(session.connection(), identity.reach, building_id=body.building_id, floor_ids=body.floor_ids)
    mapped = [each.floor_id for each in maps]
    if bare := [floor_id for floor_id in body.floor_ids or () if floor_id not in mapped]:
        raise Conflict(f"floor {bare[0]} has no map yet; upload surveys and wait for its job, or leave it out")
    if not maps:
        raise Conflict(f"no floor of building {body.building_id} has a map yet; upload surveys and wait for their job")
    floors = {row.id: row for row in session.scalars(select(Floor).where(Floor.id.in_(mapped)))}
    if len({row.building_id for row in floors.values()}) > 1:
        reason = "the floors are of several buildings, which have frames of their own; make a track in each"
        raise InvalidInput(reason, Fault("/body/floor_ids", reason))
    return floors, maps


@router.get("", summary="List tracks")
def list_tracks(
    context: ContextDep,
    identity: TrackReading,
    paging: PagingDep,
    building_id: Annotated[FloorId | None, Query()] = None,
    status: Annotated[Literal["active", "ended"] | None, Query()] = None,
) -> Page[TrackView]:
    statement = own(identity, Track)
    if building_id is not None:
        statement = statement.where(Track.building_id == building_id)
    idle = (Track.status == "ended") | (Track.touched_at < context.follower.idle_before)
    if status is not None:
        statement = statement.where(idle if status == "ended" else ~idle)
    with context.transaction() as session:
        return list_page(session, statement, Track.id, paging, lambda row: _show(context, row))


@router.get("/{track_id}", summary="One track, with its last estimate")
def get_track(track_id: Id, context: ContextDep, identity: TrackReading) -> TrackDetail:
    with context.transaction() as session:
        row = find_own(session, identity, Track, track_id)
    last = next(batches_of(context.sessions, row.id, max(row.batches - 1, 0), row.batches), None)
    return _detail(context, row, SEARCHING if last is None else last[0].estimate)


@router.delete("/{track_id}", status_code=204, summary="End a track and remove all of it")
def remove_track(track_id: Id, request: Request, context: ContextDep, identity: Locating) -> None:
    with context.transaction() as session:
        row = find_own(session, identity, Track, track_id)
        record(session, actor(request, identity), "delete", row, building_id=row.building_id)
        delete_track(session, row.id)
    context.follower.forget(track_id)


@router.post("/{track_id}/end", summary="End a track; what it followed stays")
def stop_track(track_id: Id, request: Request, context: ContextDep, identity: Locating) -> TrackView:
    """No further steps are taken. To end one that has ended changes nothing."""
    with context.transaction() as session:
        row = find_own(session, identity, Track, track_id)
        if row.status == "active":
            idle = context.follower.is_idle(row.touched_at)
            record(session, actor(request, identity), "end", row, building_id=row.building_id)
            end_track(session, row, "idle" if idle else "asked", context.follower.now())
    context.follower.forget(track_id)
    return _show(context, row)


@router.post("/{track_id}/steps", response_model=StepsAnswer, summary="Follow steps")
async def post_steps(track_id: Id, body: StepsBody, context: ContextDep, identity: Locating) -> Response:
    """Whole, or not at all: a fault anywhere refuses the batch. Send again what was not answered: a step that was
    followed already is a duplicate, and changes nothing. What is answered is stored."""
    context.follows.check()
    kind = await run_in_threadpool(_kind_of, context, identity, track_id)
    steps = raw_steps(body, kind)
    wait_s = context.step_rate.take(track_id, len(steps))
    if wait_s > 0.0:
        raise TooMany(
            f"more than {context.settings.max_track_steps_per_s:g} steps a second; send these again in {wait_s:.1f} s",
            retry_after_s=wait_s,
        )
    outcome = await context.follower.follow(track_id, identity.reach, steps, body.flush)
    return Response(msgspec.json.encode(steps_answer(outcome)), media_type="application/json")


@router.get("/{track_id}/path", summary="Where the device was, step by step")
def get_path(
    track_id: Id,
    context: ContextDep,
    identity: TrackReading,
    smoothed: Annotated[bool, Query(description="in the light of what came later, every half metre")] = False,
    from_step: FromStep = 0,
    limit: Limit = 1000,
) -> PathView:
    """As it was estimated at each step; or smoothed: settled places, and those that later steps may still change."""
    with context.transaction() as session:
        row = find_own(session, identity, Track, track_id)
    floor_ids = [each[0] for each in row.spec["maps"]]
    if smoothed:
        points = smoothed_points(*_smoothed(context, identity, row, from_step), floor_ids)
    else:
        rows = (each for batch, _ in batches_of(context.sessions, row.id, 0, row.batches, from_step)
                for each in batch.path if each[0] >= from_step)  # fmt: skip
        points = path_points(_first(rows, limit + 1), floor_ids)
    links = _next(f"/v1/tracks/{row.id}/path?smoothed={str(smoothed).lower()}", points, limit, lambda each: each.step)
    return PathView(track_id=row.id, smoothed=smoothed, points=points[:limit], links=links)


def _smoothed(
    context: Context, identity: Identity, row: Track, from_step: int
) -> tuple[list[list[Any]], list[list[Any]]]:
    """Rows of settled places, and of those not settled, from a step on."""
    live = context.follower.live(row.id, identity.reach)
    with context.sessions() as session:
        stored = session.scalars(
            select(TrackSteps.settled)
            .where(TrackSteps.track_id == row.id, TrackSteps.next_step > from_step, TrackSteps.settled.is_not(None))
            .order_by(TrackSteps.sequence)
        ).all()
    settled = [each for batch in stored for each in batch or () if each[0] >= from_step]
    return settled, [each for each in unsettled_rows(live.state) if each[0] >= from_step]


@router.get("/{track_id}/steps", summary="The steps that were followed, as they were sent")
def get_steps(
    track_id: Id, context: ContextDep, identity: TrackReading, from_step: FromStep = 0, limit: Limit = 1000
) -> StepsPage:
    with context.transaction() as session:
        row = find_own(session, identity, Track, track_id)
    sent = (step for batch, _ in batches_of(context.sessions, row.id, 0, row.batches, from_step)
            for step in batch.steps if step["number"] >= from_step)  # fmt: skip
    steps: list[RawStep] = _first(sent, limit + 1)
    links = _next(f"/v1/tracks/{row.id}/steps?", steps, limit, lambda step: int(step["number"]))
    return StepsPage(track_id=row.id, steps=steps[:limit], links=links)


@router.post(
    "/{track_id}/replay",
    summary="Follow all steps again, from the seed on the pinned maps",
    response_class=StreamingResponse,
    responses={200: {"description": "JSON lines: an estimate a batch of steps; and at last whether all are as then",
                     "content": {"application/x-ndjson": {"schema": {"type": "string"}}}}},
)  # fmt: skip
async def replay(track_id: Id, context: ContextDep, identity: TrackReading) -> StreamingResponse:
    """Every line says whether it is equal, bit for bit, to what was answered then. It is, on the same machine and
    version of the program. Nothing is changed; a client that goes away ends the work."""

    def begin() -> Iterator[ReplayedBatch]:
        with context.transaction() as session:
            row = find_own(session, identity, Track, track_id)
        return replay_track(context.sessions, context.follower.trackers, row)

    begun = await run_in_threadpool(begin)
    return StreamingResponse(_lines(context, begun), media_type="application/x-ndjson")


async def _lines(context: Context, begun: Iterator[ReplayedBatch]) -> AsyncIterator[bytes]:
    loop = asyncio.get_running_loop()
    batches = different = 0
    digest: str | None = None
    while (each := await loop.run_in_executor(context.follows, lambda: next(begun, None))) is not None:
        batches, different, digest = batches + 1, different + (not each.equal), each.sha256
        line = {"kind": "estimate", "equal": each.equal, "steps": each.steps, "estimate": each.estimate}
        yield msgspec.json.encode(line) + b"\n"
    end = ReplayedEnd(
        equal=not different, batches=batches, different=different, sha256=digest, version=__version__
    )  # fmt: skip
    yield end.model_dump_json().encode() + b"\n"


def _kind_of(context: Context, identity: Identity, track_id: str) -> StepKind:
    """Raises NotFound. Asks the database only for a track that is not in memory."""
    kind = context.follower.kind_of(track_id, identity.reach)
    if kind is None:
        with context.transaction() as session:
            row = find_own(session, identity, Track, track_id)
            kind = step_kind(row.spec, row.frame)
    return kind


def _show(context: Context, row: Track) -> TrackView:
    return show_track(row, context.follower.is_idle(row.touched_at), context.settings.track_idle_timeout_s)


def _detail(context: Context, row: Track, estimate: dict[str, Any]) -> TrackDetail:
    return TrackDetail(**dict(_show(context, row)), estimate=EstimateView.model_validate(estimate))


def _first(items: Iterator[Any], count: int) -> list[Any]:
    return [item for item, _ in zip(items, range(count), strict=False)]


def _next(path: str, items: list[Any], limit: int, number: Any) -> dict[str, str]:
    if len(items) <= limit:
        return {}
    mark = "" if path.endswith("?") else "&"
    return {"next": f"{path}{mark}from_step={number(items[limit])}&limit={limit}"}
