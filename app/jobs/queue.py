"""Asking for background work, in the caller's transaction.

Every change to the jobs of a floor locks the floor's row first, so it is serial per floor on both databases; locks are
always taken in the order floor, job, anything else, and last the one of the admission: whoever adds or ends a job
admits those that are next (`app.jobs.admission`) before it commits.
"""

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import cast

from dbos import EnqueueOptions
from sqlalchemy import ColumnElement, Engine, Table, select, update
from sqlalchemy.orm import Session

from app.db.tables import BUILD, REBUILD, Floor, Job, Map
from app.errors import NotFound
from app.jobs.admission import IN_HAND, LOW, NORMAL, admit_next
from app.jobs.engine import APPLICATION_VERSION, QUEUE, open_client
from app.telemetry.facts import request_id
from app.telemetry.tracing import traceparent

__all__ = ["FINAL_STATES", "JobQueue", "claim_generation", "lock_floor", "locked_job"]

_FLOOR = cast(Table, Floor.__table__)  # a statement on the mapped class costs more than the rest of its transaction
FINAL_STATES = ("successful", "failed", "dismissed")


class JobQueue:
    """Enqueues and cancels; runs nothing. One per process, safe to use from several threads."""

    def __init__(self, engine: Engine) -> None:
        """`engine`: where the sessions given to the methods are bound; migrated (`app.db.engine.migrate`)."""
        self._client = open_client(engine)

    def enqueue_rebuild(self, session: Session, floor: Floor) -> Job:
        """The rebuild that will see what this transaction writes: a new job, or the one already waiting.

        The waiting rebuild of a floor is number `claimed_generation + 1`; when it starts it claims that number, so
        what comes later gets the next. Raises NotFound if the floor is gone.
        """
        generation = lock_floor(session, floor.id) + 1
        job = _job_named(session, _rebuild_id(floor.id, generation))
        if job is not None and job.status not in FINAL_STATES:
            return job
        if job is not None:  # ended before it started
            claim_generation(session, floor.id, generation)
            generation += 1
        job = Job(
            organisation_id=floor.organisation_id,
            floor_id=floor.id,
            kind=REBUILD,
            priority=LOW,
            workflow_id=_rebuild_id(floor.id, generation),
        )
        return self._add(session, job)

    def enqueue_build(self, session: Session, map_row: Map, priority: int = NORMAL) -> Job:
        """The job that builds this map row; the same one when asked again. Raises NotFound if the floor is gone."""
        session.flush()
        lock_floor(session, map_row.floor_id)
        workflow_id = f"{BUILD}:{map_row.id}"
        job = _job_named(session, workflow_id)
        if job is not None:
            return job
        job = Job(
            organisation_id=map_row.organisation_id,
            floor_id=map_row.floor_id,
            map_id=map_row.id,
            kind=BUILD,
            priority=priority,
            workflow_id=workflow_id,
        )
        return self._add(session, job)

    def admit(self, session: Session) -> None:
        """Hand the jobs that are next to the engine, as far as slots of live workers are free."""
        for job in admit_next(session):
            options = EnqueueOptions(
                workflow_name=job.kind,
                workflow_id=job.workflow_id,
                queue_name=QUEUE,
                queue_partition_key=job.floor_id,
                app_version=APPLICATION_VERSION,
            )
            self._client.enqueue_in_transaction(session, options, *_arguments(job))  # known already: it stays as it is

    def request_cancel(self, session: Session, job: Job) -> Job:
        """End a waiting job now; ask a running one to end at its next report. A job that has ended stays as it is.

        The engine's own entry of a waiting job that was admitted is not touched: when its turn comes it finds the job
        dismissed and ends, so there is no moment in which the two disagree.
        """
        generation = lock_floor(session, job.floor_id) + 1
        session.refresh(job)
        if job.status in FINAL_STATES:
            return job
        job.cancel_requested = True
        if job.status == "accepted":
            _dismiss(session, job)
            if job.workflow_id == _rebuild_id(job.floor_id, generation):
                claim_generation(session, job.floor_id, generation)
            self.admit(session)
        session.flush()
        return job

    def enqueue_again(self, session: Session, job: Job, why: str) -> None:
        """Let a job that had not ended wait anew under its old name, where the engine knows nothing of it.

        After a restore, which does not bring the engine's own tables back, and where its record was lost.
        """
        job.status, job.progress, job.started_at, job.admitted_at = "accepted", 0, None, None
        job.fencing_token = job.plan = None
        job.message = f"waiting for a worker, anew: {why}"
        begun = update(Map).where(Map.id == job.map_id, Map.status == "running")
        session.execute(begun.values(status="accepted"))

    def recorded(self, session: Session) -> Iterator[object]:
        """What every job in hand was claimed to do: its plan. What waits has none."""
        jobs = session.execute(select(Job.workflow_id, Job.plan).where(IN_HAND)).all()
        for _, plan in jobs:
            yield plan
        for workflow_id, _ in jobs:  # a worker of an older version let the engine keep it
            for step in self._client.list_workflow_steps(workflow_id):
                yield step["output"]

    def knows_jobs(self) -> bool:
        """Whether the engine has a record of any job, ended or not."""
        return bool(self._client.list_workflows(limit=1, load_input=False, load_output=False))

    def close(self) -> None:
        self._client.destroy()

    def _add(self, session: Session, job: Job) -> Job:
        job.request_id, job.traceparent = request_id(), traceparent()
        session.add(job)
        self.admit(session)
        return job


def lock_floor(session: Session, floor_id: str) -> int:
    """Lock the floor's row until the transaction ends, and return its `claimed_generation`. Raises NotFound."""
    generation = _lock(session, _FLOOR.c.id == floor_id)
    if generation is None:
        raise NotFound(f"no floor {floor_id}")
    return generation


def locked_job(session: Session, workflow_id: str) -> Job:
    """The job, its floor locked before it. Raises NotFound."""
    of_job = select(Job.floor_id).where(Job.workflow_id == workflow_id).scalar_subquery()
    if _lock(session, _FLOOR.c.id == of_job) is None or (job := _job_named(session, workflow_id)) is None:
        raise NotFound(f"no job for {workflow_id}, or no floor for it")
    return job


def _lock(session: Session, floor: ColumnElement[bool]) -> int | None:
    session.flush()
    unchanged = update(_FLOOR).values(claimed_generation=_FLOOR.c.claimed_generation)
    generation: int | None = session.scalar(unchanged.where(floor).returning(_FLOOR.c.claimed_generation))
    return generation


def claim_generation(session: Session, floor_id: str, generation: int) -> None:
    """From here on whoever asks for a rebuild of the floor gets a later one than `generation`. Locks the floor."""
    if generation == 0:  # of a build of a given map
        return
    statement = (
        update(Floor)
        .where(Floor.id == floor_id, Floor.claimed_generation < generation)
        .values(claimed_generation=generation)
    )
    session.execute(statement)


def _dismiss(session: Session, job: Job) -> None:
    job.status, job.message, job.finished_at = "dismissed", "cancelled before it started", datetime.now(UTC)
    ended = update(Map).where(Map.id == job.map_id, Map.status == "accepted")
    session.execute(ended.values(status="dismissed", finished_at=job.finished_at))


def _arguments(job: Job) -> tuple[str | int, ...]:
    """What the job's workflow is called with (`workers.workflows`)."""
    if job.kind == REBUILD:
        return job.floor_id, int(job.workflow_id.rsplit(":", 1)[1])
    return (str(job.map_id),)


def _rebuild_id(floor_id: str, generation: int) -> str:
    return f"{REBUILD}:{floor_id}:{generation}"


def _job_named(session: Session, workflow_id: str) -> Job | None:
    return session.scalar(select(Job).where(Job.workflow_id == workflow_id).execution_options(populate_existing=True))
