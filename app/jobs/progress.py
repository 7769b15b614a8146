"""How a running job shows where it is, and learns that it should stop."""

import logging
import time
from typing import cast

from sqlalchemy import Table, update
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Job
from app.errors import JobCancelled

__all__ = ["JobReporter"]

log = logging.getLogger(__name__)


class JobReporter:
    """Writes progress and message of one job into its row, and reads the cancel flag in the same statement."""

    def __init__(
        self, sessions: sessionmaker[Session], job_id: str, fencing_token: str, interval_s: float = 1.0
    ) -> None:
        """`fencing_token`: of whoever reports. Reports closer together than `interval_s`, or to the start, are dropped,
        so a chatty fit costs at most one small transaction a second, and a short one none."""
        self._sessions, self._job_id = sessions, job_id
        ours = Job.id == job_id, Job.status == "running", Job.fencing_token == fencing_token
        self._mine = update(cast(Table, Job.__table__)).where(*ours).returning(Job.cancel_requested)
        self._interval_s, self._next_s = interval_s, time.monotonic() + interval_s

    def report(self, fraction: float, message: str) -> None:
        """Show that `fraction` (0 to 1) is done.

        Raises JobCancelled if a cancel was requested, or the job is not ours any more: it ended, was given to another
        worker, or is gone.
        """
        if time.monotonic() < self._next_s:
            return
        statement = self._mine.values(progress=round(100 * min(max(fraction, 0.0), 1.0)), message=message)
        try:
            with self._sessions.begin() as session:
                cancelled = session.scalar(statement)
        except (DBAPIError, PoolTimeout):  # hours of work must not end because a report could not be written
            log.warning("progress of job %s could not be written", self._job_id, exc_info=True)
            cancelled = False
        if cancelled is not False:
            raise JobCancelled("the job was asked to stop, or is somebody else's")
        self._next_s = time.monotonic() + self._interval_s
