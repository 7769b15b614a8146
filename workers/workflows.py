"""The workflows: claim what to build, fit it in a child process, publish it.

Steps are recorded by the engine: after a crash those that ended are not run again, the one in the middle is. Their
order and names never change (docs/decisions/0003); a workflow that must differ gets a new name beside the old one.
Whatever ends a step on purpose is in its outcome, because an exception comes back from the record as another type:
`plan`, `result` or `published` when it went well, else `skipped`, `cancelled` or `failed` (with a message).
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, ParamSpec, TypeVar

from dbos import DBOS
from dbos import error as dbos_error
from opentelemetry import trace
from sqlalchemy import select
from sqlalchemy.exc import DBAPIError, SQLAlchemyError
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import open_blob_store
from app.db.tables import BUILD, REBUILD, Job
from app.errors import IsodynError, JobCancelled, NotFound, Unavailable
from app.jobs.admission import live_slots
from app.jobs.progress import JobReporter
from app.jobs.queue import FINAL_STATES, JobQueue, claim_generation, lock_floor
from app.jobs.tile_chunks import ChunkBoard, is_offering
from app.telemetry.facts import add_facts, with_facts
from app.telemetry.metrics import JOB_STEP_SECONDS, JOBS_ENDED
from app.telemetry.tracing import link_to
from workers.builder import Builder, Plan, Result
from workers.fit_process import FitFailed, FitProcessDied, FitProcesses
from workers.slots import Slots

__all__ = ["WorkflowContext", "locked_job", "register_workflows"]

FIT_ATTEMPTS = 3
DATABASE_ATTEMPTS = 8  # a second, two, four ...: two minutes in all
WAITS_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0)  # for what a fit cannot reach: two minutes in all, too
MOST_RECOVERIES = 5  # a job that takes its worker down with it must not do so for ever

Outcome = dict[str, Any]
P = ParamSpec("P")
R = TypeVar("R")

log = logging.getLogger(__name__)
_tracer = trace.get_tracer("isodyn")


@dataclass(frozen=True)
class WorkflowContext:
    """What the steps work with. `builder` is the module `builder_name`; the fit's child process imports it anew."""

    sessions: sessionmaker[Session]
    queue: JobQueue
    blob_url: str
    builder: Builder
    builder_name: str
    slots: Slots
    fits: FitProcesses = field(default_factory=FitProcesses)


def register_workflows(context: WorkflowContext) -> None:
    """Make the workflows known to the engine of this process; before it is launched."""
    steps = _Steps(context)
    claim = _step(steps.claim, DATABASE_ATTEMPTS)
    fit = _step(steps.fit, FIT_ATTEMPTS)
    publish = _step(steps.publish, DATABASE_ATTEMPTS)
    close = _step(steps.close, DATABASE_ATTEMPTS)

    def run(workflow_id: str, generation: int) -> str:
        try:
            outcome = claim(workflow_id, generation)
            if "plan" in outcome:
                plan = outcome["plan"]
                outcome = fit(workflow_id, plan)
                if "result" in outcome:
                    outcome = publish(workflow_id, plan, outcome["result"])
        except Exception as error:
            log.exception("%s stopped", workflow_id)
            outcome = {"failed": _describe(error)}
        if "failed" in outcome or "cancelled" in outcome:
            close(workflow_id, generation, outcome)
        kind = REBUILD if workflow_id.startswith(f"{REBUILD}:") else BUILD
        ended = next(iter(outcome))
        JOBS_ENDED.labels(kind, ended).inc()
        log.info("the job ended: %s", ended)
        return ", ".join(outcome)

    @DBOS.workflow(name=REBUILD, max_recovery_attempts=MOST_RECOVERIES)
    def rebuild(floor_id: str, generation: int) -> str:
        workflow_id = f"{REBUILD}:{floor_id}:{generation}"
        with with_facts(workflow_id=workflow_id), context.slots.taken():
            return run(workflow_id, generation)

    @DBOS.workflow(name=BUILD, max_recovery_attempts=MOST_RECOVERIES)
    def build(map_id: str) -> str:
        workflow_id = f"{BUILD}:{map_id}"
        with with_facts(workflow_id=workflow_id), context.slots.taken():
            return run(workflow_id, 0)


class _Steps:
    """The steps. `generation` is 0 for a build of a given map. Each locks the floor before it looks at the job."""

    def __init__(self, context: WorkflowContext) -> None:
        self._context = context

    def claim(self, workflow_id: str, generation: int) -> Outcome:
        """From here on uploads ask for the next generation, and this one sees all that came before."""
        try:
            with self._context.sessions.begin() as session:
                job = locked_job(session, workflow_id)
                if job.status in FINAL_STATES:
                    return {"skipped": job.status}
                if job.cancel_requested:
                    return {"cancelled": True}
                claim_generation(session, job.floor_id, generation)
                return {"plan": self._context.builder.claim_build(session, job.id)}
        except IsodynError as error:
            return {"failed": str(error)}

    def fit(self, workflow_id: str, plan: Plan) -> Outcome:
        job = self._job_once_there_is_a_database(workflow_id)
        if job is None:
            return {"cancelled": True}
        _say_whose(job)
        reporter = JobReporter(self._context.sessions, job.id, still_owner=_stop_unless_owner)
        try:
            return {"result": self._fit_once_blobs_are_reached(plan, reporter)}
        except JobCancelled:
            return {"cancelled": True}
        except (FitFailed, Unavailable) as error:
            return {"failed": str(error)}

    def _job_once_there_is_a_database(self, workflow_id: str) -> Job | None:
        """Raises DBAPIError where the database stays away for the whole wait; tries of the step are for fits."""
        wanted = select(Job).where(Job.workflow_id == workflow_id)
        for wait_s in WAITS_S:
            try:
                with self._context.sessions() as session:
                    return session.scalar(wanted)
            except DBAPIError as error:
                log.warning("a fit waits %.0f s: %s", wait_s, error)
                time.sleep(wait_s)
        with self._context.sessions() as session:
            return session.scalar(wanted)

    def _fit_once_blobs_are_reached(self, plan: Plan, reporter: JobReporter) -> Result:
        """Raises Unavailable where the blob store stays away for the whole wait."""
        for wait_s in WAITS_S:
            try:
                return self._run_fit(plan, reporter)
            except Unavailable as error:
                log.warning("a fit waits %.0f s: %s", wait_s, error)
                until = time.monotonic() + wait_s
            while time.monotonic() < until:
                reporter.report(0.0, "waiting for the blob store")  # and may be cancelled meanwhile
                time.sleep(0.25)
        return self._run_fit(plan, reporter)

    def _run_fit(self, plan: Plan, reporter: JobReporter) -> Result:
        context, board = self._context, self._board(reporter.job_id)
        return context.fits.run(context.builder_name, {"plan": plan}, context.blob_url, reporter.report, board)

    def _board(self, job_id: str) -> ChunkBoard | None:
        """Where a fit may offer tiles to others; None where there are no others."""
        board = ChunkBoard(self._context.sessions, open_blob_store(self._context.blob_url, make=False), job_id)
        try:
            with self._context.sessions() as session:
                left, others = is_offering(session, job_id), live_slots(session) > 1
        except SQLAlchemyError:  # a fit needs no database
            return None
        if left:
            board.clear()
        return board if others else None

    def publish(self, workflow_id: str, plan: Plan, result: Result) -> Outcome:
        _stop_unless_owner(100)
        try:
            with self._context.sessions.begin() as session:
                job = locked_job(session, workflow_id)
                self._context.builder.publish_build(session, job.id, plan, result)
                self._context.queue.admit(session)
            return {"published": True}
        except IsodynError as error:
            return {"failed": str(error)}

    def close(self, workflow_id: str, generation: int, outcome: Outcome) -> None:
        """Give the job its last state. A floor or a job that is gone needs none."""
        try:
            with self._context.sessions.begin() as session:
                job = locked_job(session, workflow_id)
                claim_generation(session, job.floor_id, generation)
                if "cancelled" in outcome:
                    self._context.builder.dismiss_build(session, job.id)
                else:
                    self._context.builder.fail_build(session, job.id, outcome["failed"])
                self._context.queue.admit(session)
        except NotFound as error:
            log.info("%s: nothing to close: %s", workflow_id, error)


def _step(method: Callable[P, R], attempts: int) -> Callable[P, R]:
    def step(*args: P.args, **kwargs: P.kwargs) -> R:  # the engine marks functions, and cannot mark methods
        with (
            _tracer.start_as_current_span(f"job {method.__name__}"),
            JOB_STEP_SECONDS.labels(method.__name__).time(),
        ):
            return method(*args, **kwargs)

    return DBOS.step(
        name=method.__name__,
        retries_allowed=True,
        max_attempts=attempts,
        interval_seconds=1.0,
        backoff_rate=2.0,
        should_retry=lambda error: isinstance(error, (DBAPIError, FitProcessDied)),
    )(step)


def _stop_unless_owner(progress: int) -> None:
    """The engine ends this execution here if the job was given to another worker meanwhile."""
    DBOS.set_event("progress", progress)


def locked_job(session: Session, workflow_id: str) -> Job:
    """The job, its floor locked before it. Raises NotFound."""
    job = session.scalar(select(Job).where(Job.workflow_id == workflow_id))
    if job is None:
        raise NotFound(f"no job for {workflow_id}")
    _say_whose(job)
    lock_floor(session, job.floor_id)
    session.refresh(job)
    return job


def _say_whose(job: Job) -> None:
    """Log lines and the span from here on are of this job, and of the request that asked for it."""
    add_facts(job_id=job.id, workflow_id=job.workflow_id, floor_id=job.floor_id, request_id=job.request_id)
    link_to(job.traceparent)


def _describe(error: Exception) -> str:
    last = error.errors[-1] if isinstance(error, dbos_error.DBOSMaxStepRetriesExceeded) and error.errors else error
    if isinstance(last, FitProcessDied):
        return f"{last}, {FIT_ATTEMPTS} times; give the worker more memory, or build from fewer surveys"
    return f"internal error ({type(last).__name__}: {last}); the worker's log has its trace"
