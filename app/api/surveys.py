"""Surveys: upload a walk, see what was read, how it fits the others, leave it out, delete it."""

import json
from dataclasses import dataclass
from datetime import UTC, datetime
from hashlib import sha256
from typing import Annotated, Any, Literal, Self

from fastapi import APIRouter, Query, Request, Response
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, ConfigDict, Field, model_validator
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.api.auth import Identity, SurveyReading, SurveyWriting, actor
from app.api.body import upload
from app.api.caching import IfMatch, check_unchanged, state
from app.api.calibration_request import CalibrationId, DeviceQuery
from app.api.context import Context, ContextDep
from app.api.idempotency import IdempotencyKey, answer_once
from app.api.jobs import JobView, show_job
from app.api.listing import Page, PagingDep, list_page
from app.api.models import Finite, Id, Name, RequestModel, unchanged
from app.api.ownership import find_own
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Building, Floor, Job, Map, Survey
from app.errors import IsodynError, NotFound
from app.field.spec import ChangePoint, ComponentConsistency, SegmentConsistency, WalkLocalizability
from app.geodesy import Anchor
from app.jobs.queue import lock_floor
from app.services.artefacts import samples_from_bytes
from app.services.audit_log import ACCEPTED, DONE, record
from app.services.calibrations import AppliedCalibration, find_calibration
from app.services.disturbances import checked_stretches, union_s
from app.services.receive_survey import find_replaced, parse_survey, record_survey, was_replaced
from app.telemetry.metrics import UPLOAD_BYTES, UPLOAD_PARSE_SECONDS, UPLOADS

__all__ = ["SURVEY_FILES", "SurveyFormat", "SurveyView", "router"]

router = APIRouter(prefix="/v1", tags=["surveys"], responses=ERROR_RESPONSES)
SurveyFormat = Literal["csv", "parquet", "ndjson", "indoor-location-2020"]

SURVEY_FILES: dict[str, Any] = {
    "required": True,
    "content": {
        "text/csv": {
            "schema": {"type": "string"},
            "example": "t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut\n"
            "0.0,1.0,2.0,1.2,19.8,2.1,-43.0\n0.1,1.1,2.0,1.2,19.9,2.0,-43.1\n",
        },
        "application/x-ndjson": {"schema": {"type": "string"}},
        "application/vnd.apache.parquet": {"schema": {"type": "string", "format": "binary"}},
        "text/plain": {"schema": {"type": "string"}},
        "application/octet-stream": {"schema": {"type": "string", "format": "binary"}},
    },
}


_JOB_LINK: dict[str, Any] = {
    "Link": {
        "description": "the rebuild it set off (RFC 8288, relation `monitor`); none when there is none",
        "schema": {"type": "string"},
        "example": '</v1/jobs/0197c1a2-0b7e-7c3d-9a52-5f0e8d6b4c21>; rel="monitor"',
    }
}


class SurveyView(BaseModel):
    id: str
    floor_id: str
    name: str
    format: str
    frame: str
    sample_count: int
    included: bool
    sha256: Annotated[str, Field(description="of the uploaded bytes")]
    created_at: datetime
    session: Annotated[str | None, Field(description="the sensor's calibration session, where it is known")] = None
    calibration_id: Annotated[
        str | None, Field(description="the device's calibration that was applied to its readings; null: none")
    ] = None
    excluded_s: Annotated[
        list[list[float]], Field(description="stretches of its time that no map is built from, [[start, end], ...]")
    ] = []
    replaces: Annotated[str | None, Field(description="the survey whose place it took")] = None


class ReceivedSurvey(BaseModel):
    """The survey, and the job that maps it (null when the floor does not build by itself)."""

    survey: SurveyView
    job: JobView | None


class SurveyPatch(RequestModel):
    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"included": False}]})
    included: Annotated[bool, Field(description="false leaves the survey out of maps built from now on")] = unchanged()
    excluded_s: Annotated[
        list[Annotated[list[Finite], Field(min_length=2, max_length=2)]],
        Field(max_length=1000, description="stretches of its time to leave out of maps, [[start, end], ...]; [] takes "
              "all in again"),
    ] = unchanged()  # fmt: skip
    exclude_disturbed: Annotated[
        Literal[True], Field(description="leave out every stretch that `disturbances` tells, besides those left out")
    ] = unchanged()

    @model_validator(mode="after")
    def _something(self) -> Self:
        if not self.model_fields_set:
            raise ValueError("say what to change: included, excluded_s or exclude_disturbed")
        return self


class PatchedSurvey(SurveyView):
    job: Annotated[JobView | None, Field(description="the rebuild it set off; null when there is none")]


class SurveySamples(BaseModel):
    """Samples as the map sees them, evenly thinned to `limit`; columns by name."""

    frame: str
    count: int
    columns: list[str]
    rows: list[list[float]]


def show_survey(row: Survey) -> SurveyView:
    names = ("id", "floor_id", "name", "format", "frame", "sample_count", "included", "created_at", "calibration_id")
    told = {name: row.report.get(name) for name in ("session", "replaces")}
    told |= {"sha256": row.raw_sha256, "excluded_s": row.excluded_s or []}
    return SurveyView.model_validate(told | {name: getattr(row, name) for name in names})


def _lock_survey(session: Session, identity: Identity, survey_id: str) -> Survey:
    """The survey, read again once its floor is locked: whoever came first has changed or deleted it."""
    survey = find_own(session, identity, Survey, survey_id)
    lock_floor(session, survey.floor_id)
    session.expunge(survey)
    return find_own(session, identity, Survey, survey_id)


@router.post(
    "/floors/{floor_id}/surveys",
    status_code=202,
    response_model=ReceivedSurvey,
    responses={200: {"model": ReceivedSurvey, "description": "The same bytes, or equal samples, were uploaded before"}},
    openapi_extra={"requestBody": SURVEY_FILES},
    summary="Upload a survey",
)
async def upload_survey(
    floor_id: Id,
    request: Request,
    context: ContextDep,
    identity: SurveyWriting,
    format: Annotated[SurveyFormat, Query(description="what the bytes are")] = "csv",
    frame: Annotated[
        Literal["building", "level", "norm"], Query(description="what b is when there is no quaternion")
    ] = "building",
    name: Annotated[Name | None, Query()] = None,
    session: Annotated[
        Name | None,
        Query(
            description="label of the sensor's calibration session: surveys that share it share one hard-iron offset; "
            "for tables with qw,qx,qy,qz (a trace says its own)",
            examples=["robot-7 2026-03-02"],
        ),
    ] = None,
    calibration_id: CalibrationId = None,
    device: DeviceQuery = None,
    replaces: Annotated[
        str | None,
        Query(
            max_length=64,
            pattern=r"^[A-Za-z0-9_-]+$",
            description="a survey of this floor whose place it takes",
            examples=["0197c1a2-0b7e-7c3d-9a52-5f0e8d6b4c21"],
        ),
    ] = None,
    key: IdempotencyKey = None,
) -> Response:
    """The body is the file; `Content-Encoding: gzip` or `zstd` is understood. It is parsed now and refused with line
    and reason if it cannot be read; once accepted it is on disk, and a job maps it.

    The answer 200 gives the survey that is there already, as it is: one left out of maps stays so, and has no job.
    With `replaces` the old survey is deleted and the new one recorded in one step, and mapped by one job.

    With `calibration_id`, or `device` for that device's newest, readings in the sensor's axes (a table with
    quaternions, a trace) are calibrated before anything else; the survey and its report say by which. Where the
    building has an anchor, the walk is checked against the Earth's field there: `reference_field` and `warnings` of the
    report.
    """
    told = await run_in_threadpool(_told_of, context, identity, floor_id, replaces, calibration_id, device)

    def receive(data: bytes) -> Response:
        UPLOAD_BYTES.observe(len(data))
        checked = replaces is None and _check_room(context, floor_id, data)
        with UPLOAD_PARSE_SECONDS.time(), UPLOADS.labels("refused").count_exceptions(IsodynError):
            parsed = parse_survey(
                context.blobs, data, format=format, frame=frame, name=name or "survey", elevation_m=told.elevation_m,
                session=session, calibration=told.calibration,
                at=None if told.anchor is None else (told.anchor, datetime.now(UTC).date()),
                read=context.files.survey,
            )  # fmt: skip

        def create(transaction: Session) -> tuple[int, BaseModel]:
            floor = find_own(transaction, identity, Floor, floor_id)
            survey, job, new = record_survey(transaction, context.queue, floor, parsed, replaces)
            UPLOADS.labels("new" if new else "known").inc()
            if new:
                context.quotas.check_surveys_of_floor(transaction, floor.id)
                if not checked:
                    context.quotas.check_surveys(transaction, floor.organisation_id)
                record(transaction, actor(request, identity), "upload", survey, ACCEPTED if job else DONE,
                       floor_id=floor.id, replaces=replaces, job_id=job.id if job else None)  # fmt: skip
            view = ReceivedSurvey(survey=show_survey(survey), job=show_job(job) if job else None)
            return 202 if new else 200, view

        return answer_once(context, identity, request, key, parsed.raw_sha256.encode(), create)

    context.uploads.check()
    async with upload(request, context.settings.max_upload_bytes, context.bodies, identity.organisation_id) as data:
        return await context.uploads.run(lambda: receive(data), request.is_disconnected)


@dataclass(frozen=True, slots=True)
class _Told:
    """What is known of a survey before it is read."""

    elevation_m: float
    anchor: Anchor | None
    calibration: AppliedCalibration | None


def _check_room(context: Context, floor_id: str, data: bytes) -> bool:
    """Raise QuotaExceeded before anything is stored. False, and unchecked: the file is there already."""
    with context.transaction() as session:
        known = Survey.raw_sha256 == sha256(data).hexdigest()
        there = select(Survey.id).where(Survey.floor_id == floor_id, known).limit(1)
        if session.scalars(there).first() is not None:
            return False
        context.quotas.check_surveys_of_floor(session, floor_id, coming=1)
        floor = session.get_one(Floor, floor_id)
        context.quotas.check_surveys(session, floor.organisation_id, coming=1, coming_bytes=len(data))
        return True


def _told_of(
    context: Context, identity: Identity, floor_id: str, replaces: str | None, calibration_id: str | None,
    device: str | None,
) -> _Told:  # fmt: skip
    """Raises NotFound and InvalidInput before anything is stored."""
    with context.transaction() as session:
        floor = find_own(session, identity, Floor, floor_id)
        if replaces is not None and not was_replaced(session, floor, replaces):
            find_own(session, identity, Survey, replaces)
            find_replaced(session, floor, replaces)
        anchor = session.scalars(select(Building.anchor).where(Building.id == floor.building_id)).one()
        return _Told(
            floor.elevation_m,
            None if anchor is None else Anchor(**anchor),
            find_calibration(session, identity.organisation_id, calibration_id, device),
        )


@router.get("/floors/{floor_id}/surveys", summary="List a floor's surveys")
def list_surveys(floor_id: Id, context: ContextDep, identity: SurveyReading, paging: PagingDep) -> Page[SurveyView]:
    with context.transaction() as session:
        find_own(session, identity, Floor, floor_id)
        return list_page(session, select(Survey).where(Survey.floor_id == floor_id), Survey.id, paging, show_survey)


@router.get("/surveys/{survey_id}", response_model=SurveyView, summary="One survey")
def get_survey(survey_id: Id, request: Request, context: ContextDep, identity: SurveyReading) -> Response:
    with context.transaction() as session:
        return state(request, show_survey(find_own(session, identity, Survey, survey_id)))


@router.get("/surveys/{survey_id}/report", summary="What was read, and what the reader assumed")
def get_report(survey_id: Id, context: ContextDep, identity: SurveyReading) -> dict[str, Any]:
    with context.transaction() as session:
        return find_own(session, identity, Survey, survey_id).report


class ConsistencyView(BaseModel):
    """One survey against the map of *the other* surveys, whole and in segments, per component (Kuevor B14)."""

    survey_id: str
    map_id: str
    status: Annotated[
        Literal["consistent", "inconsistent", "unjudged"], Field(description="unjudged: nothing else was measured near")
    ]
    seed_2sigma_96: Annotated[bool | None, Field(description="at least 96 % of errors within 2 sd, every component")]
    judged_samples: int
    nlpd: float | None
    components: list[ComponentConsistency]
    segments: list[SegmentConsistency]
    reason: str | None
    change_point: Annotated[
        ChangePoint | None, Field(description="where in the log errors changed; null when nowhere clearly")
    ] = None
    localizability: Annotated[
        WalkLocalizability | None, Field(description="Kuevor's GLM (B30); null when too few samples can be judged")
    ] = None


@router.get("/surveys/{survey_id}/consistency", summary="How the survey fits the map of the others (Kuevor B14)")
def get_consistency(
    survey_id: Id,
    context: ContextDep,
    identity: SurveyReading,
    map_id: Annotated[
        str | None, Query(max_length=64, pattern=r"^[A-Za-z0-9_-]+$", description="default: the floor's active map")
    ] = None,
) -> ConsistencyView:
    with context.transaction() as session:
        survey = find_own(session, identity, Survey, survey_id)
        wanted = map_id or session.scalars(select(Floor.active_map_id).where(Floor.id == survey.floor_id)).one()
        map_row = session.get(Map, wanted) if wanted else None
        if map_row is None or map_row.floor_id != survey.floor_id or map_row.quality_sha256 is None:
            raise NotFound("this floor has no such finished map yet; wait for its job, or name another map_id")
        quality_sha256, map_id = map_row.quality_sha256, map_row.id
    report = json.loads(context.blobs.get(quality_sha256))["surveys"].get(survey_id)
    if report is None:
        raise NotFound(f"survey {survey_id} is not part of map {map_id}")
    return ConsistencyView(survey_id=survey_id, map_id=map_id, **report)


class DisturbanceView(BaseModel):
    """A stretch of a survey's time with a disturbed field: something passed by, was switched on, or attached."""

    start_s: float
    end_s: float
    kind: Annotated[
        str, Field(description="map: it departs from the map of the others; all else the walk shows itself")
    ]
    reason: str
    size_ut: float
    p_value: Annotated[float, Field(description="of anything as clear in an undisturbed walk of its length")]


class DisturbancesView(BaseModel):
    survey_id: str
    map_id: Annotated[str | None, Field(description="whose other surveys it was compared with; null: there is none")]
    stretches: list[DisturbanceView]
    excluded_s: Annotated[list[list[float]], Field(description="what is left out of maps, by PATCH")]


def _disturbances(context: Context, identity: Identity, survey_id: str) -> DisturbancesView:
    """Told by the survey's report, and by the quality report of the floor's active map, if it has one."""
    with context.transaction() as session:
        survey = find_own(session, identity, Survey, survey_id)
        active = session.scalars(select(Floor.active_map_id).where(Floor.id == survey.floor_id)).one()
        row = session.get(Map, active) if active else None
        quality_sha256 = None if row is None else row.quality_sha256
        map_id = None if row is None or quality_sha256 is None else row.id
        told, excluded_s = list(survey.report.get("disturbances") or []), survey.excluded_s or []
    if quality_sha256 is not None:
        told += json.loads(context.blobs.get(quality_sha256)).get("disturbances", {}).get(survey_id, [])
    stretches = sorted((DisturbanceView(**each) for each in told), key=lambda each: each.start_s)
    return DisturbancesView(survey_id=survey_id, map_id=map_id, stretches=stretches, excluded_s=excluded_s)


@router.get("/surveys/{survey_id}/disturbances", summary="Where the field was disturbed while it was walked")
def get_disturbances(survey_id: Id, context: ContextDep, identity: SurveyReading) -> DisturbancesView:
    """What the walk shows by itself (a step, a hum, a change while standing still, a place that read otherwise before),
    and where it departs from the floor's active map of the other surveys. Nothing is left out of maps by itself: PATCH
    the survey with `exclude_disturbed` or with stretches of your own, `excluded_s`."""
    return _disturbances(context, identity, survey_id)


@router.get("/surveys/{survey_id}/samples", summary="The samples as the map sees them")
def get_samples(
    survey_id: Id,
    context: ContextDep,
    identity: SurveyReading,
    limit: Annotated[int, Query(ge=1, le=100_000, description="evenly thinned to at most this many")] = 10_000,
) -> SurveySamples:
    with context.transaction() as session:
        sha256 = find_own(session, identity, Survey, survey_id).samples_sha256
    samples = samples_from_bytes(context.blobs.get(sha256))
    kept = slice(None, None, -(-len(samples) // limit))
    field_columns = ["b_ut"] if samples.frame == "norm" else ["bx_ut", "by_ut", "bz_ut"]
    rows = [
        [float(t), *map(float, p), *map(float, b)]
        for t, p, b in zip(samples.t_s[kept], samples.p_building_m[kept], samples.B_uT[kept], strict=True)
    ]
    return SurveySamples(
        frame=samples.frame, count=len(samples), columns=["t_s", "x_m", "y_m", "z_m", *field_columns], rows=rows
    )


@router.patch("/surveys/{survey_id}", summary="Leave a survey out of maps, or take it in again")
def patch_survey(
    survey_id: Id, body: SurveyPatch, request: Request, context: ContextDep, identity: SurveyWriting, _: IfMatch = None
) -> PatchedSurvey:
    disturbed = []
    if "exclude_disturbed" in body.model_fields_set:
        disturbed = [[each.start_s, each.end_s] for each in _disturbances(context, identity, survey_id).stretches]
    with context.transaction() as session:
        survey = _lock_survey(session, identity, survey_id)
        check_unchanged(request, show_survey(survey))
        before = survey.included, survey.excluded_s or []
        if "included" in body.model_fields_set:
            survey.included = body.included
        if "excluded_s" in body.model_fields_set:
            survey.excluded_s = checked_stretches(body.excluded_s, "/body/excluded_s")
        if disturbed:
            survey.excluded_s = union_s([*(survey.excluded_s or []), *disturbed])
        changed = before != (survey.included, survey.excluded_s or []) and (before[0] or survey.included)
        session.flush()
        job = _rebuild(session, context, survey.floor_id) if changed else None
        record(
            session, actor(request, identity), "change", survey, ACCEPTED if job else DONE,
            fields=sorted(body.model_fields_set), included=survey.included, job_id=job.id if job else None,
        )  # fmt: skip
        return PatchedSurvey(**show_survey(survey).model_dump(), job=show_job(job) if job else None)


@router.delete(
    "/surveys/{survey_id}", status_code=204, responses={204: {"headers": _JOB_LINK}}, summary="Delete a survey"
)
def delete_survey(survey_id: Id, request: Request, context: ContextDep, identity: SurveyWriting) -> Response:
    """Maps already built keep what they learned from it; the next build does not have it.

    The header `Link` names the job of the rebuild that it set off, when there is one.
    """
    with context.transaction() as session:
        survey = _lock_survey(session, identity, survey_id)
        floor_id = survey.floor_id
        session.delete(survey)
        session.flush()
        job = _rebuild(session, context, floor_id)
        record(session, actor(request, identity), "delete", survey, ACCEPTED if job else DONE, floor_id=floor_id,
               job_id=job.id if job else None)  # fmt: skip
        headers = {"Link": f'</v1/jobs/{job.id}>; rel="monitor"'} if job else {}
    return Response(status_code=204, headers=headers)


def _rebuild(session: Session, context: Context, floor_id: str) -> Job | None:
    """Set off a rebuild if the floor builds by itself; with nothing left to build from it has no map any more."""
    floor = session.get_one(Floor, floor_id)
    if not floor.auto_build:
        return None
    if session.scalars(select(Survey.id).where(Survey.floor_id == floor_id, Survey.included).limit(1)).first():
        return context.queue.enqueue_rebuild(session, floor)
    floor.active_map_id, floor.active_sequence = None, floor.build_sequence
    return None
