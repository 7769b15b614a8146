"""Where the engine's records and our job rows meet: what a worker left behind, and jobs the engine gave up."""

import logging

from dbos import DBOSClient
from sqlalchemy import select

from app.db.tables import Job
from app.jobs.admission import IN_HAND
from workers.workflows import WorkflowContext

__all__ = ["close_abandoned_jobs", "has_unfinished_jobs"]

ABANDONED = {
    "CANCELLED": "cancelled in the job engine by an operator",
    "ERROR": "internal error in the worker; its log has the trace",
    "MAX_RECOVERY_ATTEMPTS_EXCEEDED": "given up: its worker died every time it was tried; see the log of the worker",
}

log = logging.getLogger(__name__)


def has_unfinished_jobs(client: DBOSClient, worker_id: str) -> bool:
    """Whether the engine still holds running jobs under this worker's id."""
    return bool(
        client.list_workflows(status="PENDING", executor_id=worker_id, load_input=False, load_output=False, limit=1)
    )


def close_abandoned_jobs(client: DBOSClient, context: WorkflowContext) -> None:
    """Give a last state to jobs that look open although the engine will never touch them again."""
    with context.sessions() as session:
        rows = session.execute(select(Job.workflow_id, Job.id).where(IN_HAND))
        open_jobs = {row.workflow_id: row.id for row in rows}
    if not open_jobs:
        return
    abandoned = client.list_workflows(
        workflow_ids=list(open_jobs), status=list(ABANDONED), load_input=False, load_output=False
    )
    for entry in abandoned:
        log.warning("%s ended in the job engine as %s", entry.workflow_id, entry.status)
        with context.sessions.begin() as session:
            context.builder.fail_build(session, open_jobs[entry.workflow_id], ABANDONED[entry.status])
