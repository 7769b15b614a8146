"""The workflows: claim what to build, fit it in a child process, publish it.

The engine hands a job to a worker, and to another when that one dies; then all of it is done again, but the plan is
that of the first claim. Whoever claims a job gets a fencing token, and what comes of it is written only while the job
has that token, in one transaction: who lost a job without knowing it cannot spoil it (docs/decisions/0018).
"""

import logging
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TypeVar

from dbos import DBOS
from opentelemetry import trace
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import open_blob_store
from app.db.tables import BUILD, REBUILD, Job, new_id
from app.errors import IsodynError, JobCancelled, NotFound, Unavailable
from app.jobs.admission import live_slots
from app.jobs.progress import JobReporter
from app.jobs.queue import FINAL_STATES, JobQueue, claim_generation, locked_job
from app.jobs.tile_chunks import ChunkBoard
from app.telemetry.facts import add_facts, with_facts
from app.telemetry.metrics import JOB_STEP_SECONDS, JOBS_ENDED
from app.telemetry.tracing import link_to
from workers.builder import Builder, Plan, Result
from workers.fit_process import FitFailed, FitProcessDied, FitProcesses
from workers.slots import Slots

__all__ = ["FENCED", "Claim", "Fenced", "JobRun", "WorkflowContext", "register_workflows"]

FENCED = 3  # the exit code of a worker that others took for dead
FIT_ATTEMPTS = 3
WAITS_S = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0, 60.0)  # for what cannot be reached: two minutes in all
MOST_RECOVERIES = 5  # a job that takes its worker down with it must not do so for ever

R = TypeVar("R")

log = logging.getLogger(__name__)
_tracer = trace.get_tracer("isodyn")


@dataclass(frozen=True)
class WorkflowContext:
    """What jobs are done with. `builder` is the module `builder_name`; the fit's child process imports it anew."""

    sessions: sessionmaker[Session]
    queue: JobQueue
    blob_url: str
    builder: Builder
    builder_name: str
    slots: Slots
    worker_id: str
    fits: FitProcesses = field(default_factory=FitProcesses)


def register_workflows(context: WorkflowContext) -> None:
    """Make the workflows known to the engine of this process; before it is launched."""

    def run(workflow_id: str, generation: int) -> str:
        with with_facts(workflow_id=workflow_id), context.slots.taken():
            try:
                ended = JobRun(context, workflow_id, generation).run()
            except Fenced:
                log.error("worker %s was declared dead and ends: others may hold its jobs", context.worker_id)
                os._exit(FENCED)
            JOBS_ENDED.labels(REBUILD if workflow_id.startswith(f"{REBUILD}:") else BUILD, ended).inc()
            log.info("the job ended: %s", ended)
            return ended

    @DBOS.workflow(name=REBUILD, max_recovery_attempts=MOST_RECOVERIES)
    def rebuild(floor_id: str, generation: int) -> str:
        return run(f"{REBUILD}:{floor_id}:{generation}", generation)

    @DBOS.workflow(name=BUILD, max_recovery_attempts=MOST_RECOVERIES)
    def build(map_id: str) -> str:
        return run(f"{BUILD}:{map_id}", 0)


class Fenced(BaseException):
    """This worker was declared dead, and does not know it yet. The engine must record nothing: the job is another's."""


@dataclass(frozen=True)
class Claim:
    """A job that is ours. `may_share`: other workers could help; `was_claimed`: by somebody who has died since."""

    job_id: str
    plan: Plan
    may_share: bool
    was_claimed: bool


class JobRun:
    """One try of a worker at a job. Each transaction locks the floor before it looks at the job."""

    def __init__(self, context: WorkflowContext, workflow_id: str, generation: int) -> None:
        """`generation` is 0 for a build of a given map."""
        self._context, self._workflow_id, self._generation = context, workflow_id, generation
        self._fencing_token = new_id()
        self._traceparent: str | None = None
        self._claimed = False

    def run(self) -> str:
        """From claim to end, which is published, failed, cancelled, or skipped: it is, or was, somebody else's."""
        with self._step("claim"):
            try:
                claimed = _patiently(self.claim)
            except IsodynError as error:
                return self._close("failed", str(error))
            except Exception:  # the engine notes an error, if the job is still ours there, and so ends it
                log.exception("%s could not be claimed", self._workflow_id)
                raise
        if not isinstance(claimed, Claim):
            return claimed
        self._claimed = True
        try:
            with self._step("fit"):
                result = self._fit(claimed)
            with self._step("publish"):
                return _patiently(lambda: self.publish(claimed.plan, result))
        except JobCancelled:
            return self._close("cancelled")
        except (IsodynError, FitFailed) as error:
            return self._close("failed", str(error))
        except Exception as error:
            log.exception("%s stopped", self._workflow_id)
            return self._close("failed", _describe(error))

    def claim(self) -> Claim | str:
        """From here on uploads ask for the next generation, and this one sees all that came before.

        How the job ended, where it has. Raises IsodynError where it cannot be built, and Fenced where this worker was
        declared dead: whoever then claims the job waits for the floor that is locked here, and comes after.
        """
        with self._context.sessions.begin() as session:
            job = locked_job(session, self._workflow_id)
            self._traceparent = job.traceparent
            add_facts(job_id=job.id, floor_id=job.floor_id, request_id=job.request_id)
            link_to(job.traceparent)
            slots = live_slots(session)
            if self._context.worker_id not in slots:
                raise Fenced
            if job.status in FINAL_STATES:
                return "skipped"
            was_claimed = job.status == "running"
            claim_generation(session, job.floor_id, self._generation)
            if job.cancel_requested:
                return self._end(session, job, "cancelled")
            # An older version claimed without leaving a plan here.
            plan = job.plan if was_claimed else None
            plan = plan or self._context.builder.claim_build(session, job.id)
            job.plan, job.fencing_token = plan, self._fencing_token
            return Claim(job.id, plan, sum(slots.values()) > 1, was_claimed)

    def publish(self, plan: Plan, result: Result) -> str:
        """How it ended: published, cancelled at the last moment, or skipped where the job is not ours any more."""
        with self._context.sessions.begin() as session:
            job = locked_job(session, self._workflow_id)
            if job.fencing_token == self._fencing_token and job.status == "successful":
                return "published"  # before, but the answer was lost
            if not self._holds(job):
                return "skipped"
            if job.cancel_requested:
                return self._end(session, job, "cancelled")
            self._context.builder.publish_build(session, job.id, plan, result)
            job.plan = None
            self._context.queue.admit(session)
        return "published"

    def close(self, ended: str, message: str) -> str:
        """Give the job its last state, where it is ours, or was never anybody's."""
        with self._context.sessions.begin() as session:
            job = locked_job(session, self._workflow_id)
            if not (self._holds(job) or (job.status == "accepted" and not self._claimed)):
                return "skipped"
            claim_generation(session, job.floor_id, self._generation)
            return self._end(session, job, ended, message)

    def _holds(self, job: Job) -> bool:
        return job.status == "running" and job.fencing_token == self._fencing_token

    def _end(self, session: Session, job: Job, ended: str, message: str = "") -> str:
        if ended == "cancelled":
            self._context.builder.dismiss_build(session, job.id)
        else:
            self._context.builder.fail_build(session, job.id, message)
        job.plan = None
        self._context.queue.admit(session)
        return ended

    def _close(self, ended: str, message: str = "") -> str:
        """A floor or a job that is gone needs no last state."""
        try:
            with self._step("close"):
                return _patiently(lambda: self.close(ended, message))
        except NotFound as error:
            log.info("%s: nothing to close: %s", self._workflow_id, error)
            return ended

    @contextmanager
    def _step(self, name: str) -> Iterator[None]:
        with _tracer.start_as_current_span(f"job {name}"), JOB_STEP_SECONDS.labels(name).time():
            link_to(self._traceparent)
            yield

    def _fit(self, claimed: Claim) -> Result:
        """Raises Unavailable where the blob store stays away for the whole wait, and FitProcessDied at the last try."""
        context = self._context
        reporter = JobReporter(context.sessions, claimed.job_id, self._fencing_token)
        board = ChunkBoard(context.sessions, open_blob_store(context.blob_url, make=False), claimed.job_id)
        if claimed.was_claimed:
            board.clear()
        shared = board if claimed.may_share else None
        deaths, waits_s = 0, list(WAITS_S)
        while True:
            try:
                return context.fits.run(
                    context.builder_name, {"plan": claimed.plan}, context.blob_url, reporter.report, shared
                )
            except FitProcessDied as error:
                deaths += 1
                if deaths == FIT_ATTEMPTS:
                    raise
                log.warning("%s; trying again", error)
                time.sleep(deaths)  # where memory ran out, others may give some back
            except Unavailable as error:
                if not waits_s:
                    raise
                log.warning("a fit waits %.0f s: %s", waits_s[0], error)
                _wait(waits_s.pop(0), reporter)


def _wait(seconds: float, reporter: JobReporter) -> None:
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        reporter.report(0.0, "waiting for the blob store")  # and may be cancelled meanwhile
        time.sleep(0.25)


def _patiently(call: Callable[[], R]) -> R:
    """The call's value, once there is a database. Raises DBAPIError where it stays away for the whole wait."""
    for wait_s in WAITS_S:
        try:
            return call()
        except (DBAPIError, PoolTimeout) as error:
            log.warning("a job waits %.0f s: %s", wait_s, error)
            time.sleep(wait_s)
    return call()


def _describe(error: Exception) -> str:
    if isinstance(error, FitProcessDied):
        return f"{error}, {FIT_ATTEMPTS} times; give the worker more memory, or build from fewer surveys"
    return f"internal error ({type(error).__name__}: {error}); the worker's log has its trace"
