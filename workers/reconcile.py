"""Where the engine's records and our job rows meet: what a worker left behind, jobs the engine gave up, and jobs of
which it has no record."""

import logging
import time
from contextlib import suppress
from datetime import UTC, datetime, timedelta

from dbos import DBOSClient
from sqlalchemy import or_, select

from app.db.tables import Job
from app.errors import NotFound
from app.jobs.admission import IN_HAND
from app.jobs.queue import FINAL_STATES, locked_job
from app.telemetry.metrics import JOBS_ENDED
from workers.workflows import WorkflowContext

__all__ = ["Reconciler", "has_unfinished_jobs"]

ABANDONED = {
    "CANCELLED": "cancelled in the job engine by an operator",
    "ERROR": "internal error in the worker; its log has the trace",
    "SUCCESS": "ended in the job engine without a result here; ask for it again",
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": "given up: its worker died every time it was tried; see the log of the worker",
}

LOST_S = 60.0  # whoever is at work on one may end it meanwhile
NEVER_BEGUN = "accepted", "PENDING"  # here, and in the engine
SETTLED_S = 5.0  # most jobs that are younger end by themselves, and to look for their records costs

log = logging.getLogger(__name__)


def has_unfinished_jobs(client: DBOSClient, worker_id: str) -> bool:
    """Whether the engine still holds running jobs under this worker's id."""
    return bool(
        client.list_workflows(status="PENDING", executor_id=worker_id, load_input=False, load_output=False, limit=1)
    )


class Reconciler:
    """Ends jobs that the engine gave up, and lets those wait anew of which it has no record.

    A record was deleted by hand, or one of the two schemas was restored. Nobody else would end these jobs, and their
    slots and floors would be taken for ever. A worker that is still at one has lost it from then on, and sees so at
    its next report. So it goes with jobs that the engine gave to a worker which never heard so and begins none of them:
    their records are deleted, and then they are lost.
    """

    def __init__(self, lost_s: float = LOST_S, settled_s: float = SETTLED_S) -> None:
        self._lost_s, self._settled = lost_s, timedelta(seconds=settled_s)
        self._since: dict[tuple[str, datetime | None, bool], float] = {}

    def look(self, client: DBOSClient, context: WorkflowContext) -> None:
        """End what was given up, and let wait anew what has been lost for so long."""
        settled = or_(Job.admitted_at < datetime.now(UTC) - self._settled, Job.admitted_at.is_(None))
        with context.sessions() as session:
            in_hand = session.execute(
                select(Job.workflow_id, Job.admitted_at, Job.status).where(IN_HAND, settled)
            ).all()
        known = {}  # asked for later than the jobs: a job and its record are of one transaction
        if in_hand:
            names = [row.workflow_id for row in in_hand]
            entries = client.list_workflows(workflow_ids=names, load_input=False, load_output=False)
            known = {entry.workflow_id: entry.status for entry in entries}
        for workflow_id, status in known.items():
            if status in ABANDONED:
                log.warning("%s ended in the job engine as %s", workflow_id, status)
                _fail(context, workflow_id, ABANDONED[status])
        now_s = time.monotonic()
        unheard = {row.workflow_id for row in in_hand if (row.status, known.get(row.workflow_id)) == NEVER_BEGUN}
        lost = [
            (row.workflow_id, row.admitted_at, row.workflow_id in unheard)
            for row in in_hand
            if row.workflow_id in unheard or row.workflow_id not in known
        ]
        self._since = {each: self._since.get(each, now_s) for each in lost}
        for (workflow_id, admitted_at, has_record), since_s in self._since.items():
            if now_s - since_s < self._lost_s:
                continue
            if has_record:
                log.warning("%s was given to a worker that never began it", workflow_id)
                client.delete_workflows([workflow_id])
            else:
                _let_wait_anew(context, workflow_id, admitted_at)


def _fail(context: WorkflowContext, workflow_id: str, message: str) -> None:
    with suppress(NotFound), context.sessions.begin() as session:
        job = locked_job(session, workflow_id)
        if job.status not in FINAL_STATES:  # nobody else was first
            context.builder.fail_build(session, job.id, message)
            job.plan = None
            JOBS_ENDED.labels(job.kind, "failed").inc()


def _let_wait_anew(context: WorkflowContext, workflow_id: str, admitted_at: datetime | None) -> None:
    with suppress(NotFound), context.sessions.begin() as session:
        job = locked_job(session, workflow_id)
        if job.status in FINAL_STATES or job.admitted_at != admitted_at:  # somebody else was first
            return
        log.warning("%s is not known to the job engine any more; it waits anew", job.workflow_id)
        context.queue.enqueue_again(session, job, "its record in the job engine was lost")
