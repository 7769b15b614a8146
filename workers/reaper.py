"""Looks after the dead and the forgotten: hands the jobs of dead workers over, closes jobs that the engine gave up,
lets those that it lost wait anew, and admits those that nobody admitted."""

import logging
import threading
from dataclasses import dataclass, field

from dbos import DBOSClient
from sqlalchemy import select

from app.db.tables import Job
from app.jobs.lease import Lease
from app.telemetry.metrics import WORKERS_TAKEN_OVER
from workers.janitor import hand_over
from workers.lifeline import Lifeline
from workers.reconcile import Reconciler, has_unfinished_jobs
from workers.workflows import WorkflowContext

__all__ = ["Reaper"]

LOOK_EVERY_S = 5.0

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Reaper:
    """Runs in every worker; the lease sees to it that each dead worker has one heir."""

    database_url: str
    lease: Lease
    lifeline: Lifeline
    client: DBOSClient
    context: WorkflowContext
    reconciler: Reconciler = field(default_factory=Reconciler)

    def run(self, stop: threading.Event) -> None:
        """Look at once, and then again and again, until told to stop."""
        while True:
            try:
                self._bury_the_dead()
                self.reconciler.look(self.client, self.context)
                self._admit_the_waiting()
            except Exception:  # whatever it was: a worker that stops looking leaves the dead unburied
                log.exception("could not look after dead workers; trying again")
            if stop.wait(min(self.lease.ttl_s / 4, LOOK_EVERY_S)):
                return

    def _bury_the_dead(self) -> None:
        cut = self.lifeline.cut()
        for dead_id in self.lease.take_over_from_dead(cut):
            WORKERS_TAKEN_OVER.inc()
            if has_unfinished_jobs(self.client, dead_id):
                log.warning("worker %s died; its jobs go back to their queue", dead_id)
                hand_over(self.database_url, dead_id)
            self.lease.bury(dead_id)
        for dead_id in cut:
            self.lifeline.bury(dead_id)

    def _admit_the_waiting(self) -> None:
        """For the case that nobody adds or ends a job: workers start, and workers die."""
        waiting = select(Job.id).where(Job.status == "accepted", Job.admitted_at.is_(None)).limit(1)
        with self.context.sessions.begin() as session:
            if session.scalar(waiting) is not None:
                self.context.queue.admit(session)
