"""How a running job shows where it is, and learns that it should stop."""

import logging
import time
from collections.abc import Callable

from sqlalchemy import update
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Job
from app.errors import JobCancelled

__all__ = ["JobReporter"]

log = logging.getLogger(__name__)


class JobReporter:
    """Writes progress and message of one job into its row, and reads the cancel flag in the same statement."""

    def __init__(
        self,
        sessions: sessionmaker[Session],
        job_id: str,
        still_owner: Callable[[int], None],
        interval_s: float = 1.0,
        owner_interval_s: float = 5.0,
    ) -> None:
        """`still_owner(progress)` raises when the job has been given to another worker. Reports closer together than
        `interval_s` are dropped, so a chatty fit costs at most one small transaction a second. The owner is asked for
        only every `owner_interval_s`: who begins a step owns the job, and a worker that lost its lease ends itself."""
        self._sessions, self.job_id, self._still_owner = sessions, job_id, still_owner
        self._interval_s, self._next_s = interval_s, 0.0
        self._owner_interval_s, self._ask_s = owner_interval_s, time.monotonic() + owner_interval_s

    def report(self, fraction: float, message: str) -> None:
        """Show that `fraction` (0 to 1) is done. Raises JobCancelled if a cancel was requested, or the row is gone."""
        if time.monotonic() < self._next_s:
            return
        progress = round(100 * min(max(fraction, 0.0), 1.0))
        if time.monotonic() >= self._ask_s:
            self._still_owner(progress)
            self._ask_s = time.monotonic() + self._owner_interval_s
        statement = (
            update(Job)
            .where(Job.id == self.job_id, Job.status == "running")
            .values(progress=progress, message=message)
            .returning(Job.cancel_requested)
        )
        try:
            with self._sessions.begin() as session:
                cancelled = session.scalar(statement)
        except DBAPIError:  # hours of work must not end because a report could not be written
            log.warning("progress of job %s could not be written", self.job_id, exc_info=True)
            cancelled = False
        if cancelled is not False:
            raise JobCancelled("the job was asked to stop")
        self._next_s = time.monotonic() + self._interval_s
