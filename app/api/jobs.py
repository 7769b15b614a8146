"""Background work as a user sees it: OGC API Processes status objects, cancel, and a stream of events."""

import asyncio
import json
from collections.abc import AsyncIterator
from datetime import datetime
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query, Request
from fastapi.concurrency import run_in_threadpool
from pydantic import BaseModel, Field
from sse_starlette import EventSourceResponse

from app.api.auth import MapWriting, SurveyReading, actor, secret_of, until_refused
from app.api.context import ContextDep
from app.api.listing import Page, PagingDep, list_page
from app.api.models import Id
from app.api.ownership import find_own, own
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Job
from app.jobs import FINAL_STATES
from app.jobs.admission import HIGH, LOW, NORMAL
from app.services.audit_log import record

__all__ = ["PRIORITIES", "JobView", "Priority", "router", "show_job"]

router = APIRouter(prefix="/v1/jobs", tags=["jobs"], responses=ERROR_RESPONSES)
JobStatus = Literal["accepted", "running", "successful", "failed", "dismissed"]
Priority = Literal["low", "normal", "high"]
PRIORITIES: dict[Priority, int] = {"low": LOW, "normal": NORMAL, "high": HIGH}
_WORDS = {number: word for word, number in PRIORITIES.items()}


class JobView(BaseModel):
    """The status of a job (OGC API Processes)."""

    id: str
    kind: str
    status: JobStatus
    progress: Annotated[int, Field(ge=0, le=100)]
    message: str
    priority: Annotated[Priority, Field(description="among the waiting jobs of the organisation")]
    floor_id: str
    map_id: str | None
    created: datetime
    started: datetime | None
    finished: datetime | None
    result: dict[str, Any] | None


def show_job(row: Job) -> JobView:
    return JobView.model_validate(
        {
            "created": row.created_at, "started": row.started_at, "finished": row.finished_at,
            "priority": _WORDS[row.priority],
            **{name: getattr(row, name) for name in
               ("id", "kind", "status", "progress", "message", "floor_id", "map_id", "result")},
        }
    )  # fmt: skip


@router.get("", summary="List jobs")
def list_jobs(
    context: ContextDep,
    identity: SurveyReading,
    paging: PagingDep,
    status: Annotated[JobStatus | None, Query()] = None,
    floor_id: Annotated[str | None, Query(max_length=64, pattern=r"^[A-Za-z0-9_-]+$")] = None,
) -> Page[JobView]:
    statement = own(identity, Job)
    if status is not None:
        statement = statement.where(Job.status == status)
    if floor_id is not None:
        statement = statement.where(Job.floor_id == floor_id)
    with context.transaction() as session:
        return list_page(session, statement, Job.id, paging, show_job)


@router.get("/{job_id}", summary="One job's status and progress")
def get_job(job_id: Id, context: ContextDep, identity: SurveyReading) -> JobView:
    with context.transaction() as session:
        return show_job(find_own(session, identity, Job, job_id))


@router.delete("/{job_id}", summary="Cancel a job")
def cancel_job(job_id: Id, request: Request, context: ContextDep, identity: MapWriting) -> JobView:
    """A waiting job is dismissed at once; a running one when it next reports progress; an ended one stays as it is."""
    with context.transaction() as session:
        job = find_own(session, identity, Job, job_id)
        if job.status not in FINAL_STATES:
            context.queue.request_cancel(session, job)
            record(session, actor(request, identity), "cancel", job, floor_id=job.floor_id)
        return show_job(job)


@router.get(
    "/{job_id}/events",
    summary="A job's progress as server-sent events",
    response_class=EventSourceResponse,
    responses={200: {"content": {"text/event-stream": {"schema": {"type": "string"}}}}},
)
async def job_events(job_id: Id, request: Request, context: ContextDep, identity: SurveyReading) -> EventSourceResponse:
    """One `status` event whenever the status changes, the last one when the job has ended. Ends with the key, too."""

    def read() -> JobView:
        with context.transaction() as session:
            return show_job(find_own(session, identity, Job, job_id))

    first = await run_in_threadpool(read)

    async def events() -> AsyncIterator[dict[str, str]]:
        view, sent = first, None
        refused = asyncio.create_task(until_refused(context, secret_of(request)))
        try:
            while not refused.done():
                content = view.model_dump(mode="json")
                if content != sent:
                    sent = content
                    yield {"event": "status", "data": json.dumps(content)}
                if view.status in FINAL_STATES or await request.is_disconnected():
                    return
                await asyncio.sleep(0.5)
                view = await run_in_threadpool(read)
        finally:
            refused.cancel()

    return EventSourceResponse(events())
