"""Keeps tables from growing for ever: the engine's finished entries, old idempotency keys, what ended
jobs offered to share and, where asked, old tracks.

In small batches, so that nobody waits for them; running it twice at once does no harm. What has not ended is never
touched, and no name is used twice for want of an old entry: generations only grow, and ids of maps are unique. Rows of
jobs stay: they are what users see.
"""

import logging
import threading
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from dbos import DBOSClient
from sqlalchemy import delete, select, tuple_
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import BlobStore
from app.db.tables import Idempotency, Job, Track, TrackState, TrackSteps
from app.jobs.queue import FINAL_STATES
from app.jobs.tile_chunks import discard_stale_chunks

__all__ = ["Upkeep"]

ENDED = ["SUCCESS", "ERROR", "CANCELLED", "MAX_RECOVERY_ATTEMPTS_EXCEEDED"]
IDEMPOTENCY_DAYS = 7.0
EVERY_S, PAUSE_S = 600.0, 1.0
BATCH, BATCH_OF_TRACKS = 200, 20  # a track may have thousands of rows

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Upkeep:
    """`job_history_days`: how long the engine's entries stay after they ended; `track_history_days`: how long tracks
    do, None for ever."""

    client: DBOSClient
    sessions: sessionmaker[Session]
    blobs: BlobStore
    job_history_days: float
    track_history_days: float | None

    def run(self, stop: threading.Event) -> None:
        """Now and then, until told to stop; batch after batch while there is more."""
        wait_s = PAUSE_S
        while not stop.wait(wait_s):
            try:
                wait_s = PAUSE_S if self.clean() else EVERY_S
            except Exception:  # whatever it was: the next time may be better, and jobs go on meanwhile
                log.exception("old rows could not be cleaned away; trying again")
                wait_s = EVERY_S

    def clean(self) -> int:
        """One batch of each kind: how many were deleted."""
        deleted = self._clean_engine() + self._clean_idempotency() + self._clean_chunks()
        return deleted + (self._clean_tracks(self.track_history_days) if self.track_history_days is not None else 0)

    def _clean_engine(self) -> int:
        entries = self.client.list_workflows(
            status=ENDED,
            completed_before=_days_ago(self.job_history_days).isoformat(),
            limit=BATCH,
            load_input=False,
            load_output=False,
        )
        names = {entry.workflow_id for entry in entries}
        with self.sessions() as session:
            still_open = session.scalars(
                select(Job.workflow_id).where(Job.workflow_id.in_(names), Job.status.not_in(FINAL_STATES))
            )
            names -= set(still_open)
        if names:
            self.client.delete_workflows(sorted(names))
        return len(names)

    def _clean_idempotency(self) -> int:
        key = (Idempotency.organisation_id, Idempotency.key)
        with self.sessions.begin() as session:
            old = session.execute(
                select(*key).where(Idempotency.created_at < _days_ago(IDEMPOTENCY_DAYS)).limit(BATCH)
            ).all()
            if old:
                session.execute(delete(Idempotency).where(tuple_(*key).in_([tuple(row) for row in old])))
        return len(old)

    def _clean_chunks(self) -> int:
        return discard_stale_chunks(self.sessions, self.blobs)

    def _clean_tracks(self, days: float) -> int:
        with self.sessions.begin() as session:
            old = session.scalars(
                select(Track.id).where(Track.status == "ended", Track.ended_at < _days_ago(days)).limit(BATCH_OF_TRACKS)
            ).all()
            for column in (TrackState.track_id, TrackSteps.track_id, Track.id):
                session.execute(delete(column.class_).where(column.in_(old)))
        return len(old)


def _days_ago(days: float) -> datetime:
    return datetime.now(UTC) - timedelta(days=days)
