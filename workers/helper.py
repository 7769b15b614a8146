"""A worker with free slots helps others with the tiles of large floors (docs/decisions/0017).

Jobs come first: a chunk is taken only for a slot that no job has, and a job that comes meanwhile does not wait for it.
Whatever becomes of a chunk, the job it is of does not depend on it.
"""

import logging
import threading
import time
from dataclasses import dataclass, field

from app.blobs import open_blob_store
from app.errors import JobCancelled, Unavailable
from app.jobs.tile_chunks import Chunk, bring_chunk, take_chunk
from app.telemetry.facts import with_facts
from workers.fit_process import FitFailed, FitProcessDied
from workers.workflows import WorkflowContext

__all__ = ["Helper"]

LOOK_EVERY_S = 0.5
AFTER_FAILURE_S = 30.0
"""A worker that failed leaves chunks to those that may do better."""
LONGEST_S = 2.0
"""Of a chunk whose slot a job wants."""
MAX_SILENCE_S = 120.0  # between two tiles, or until the first

log = logging.getLogger(__name__)


@dataclass
class Helper:
    """One of a worker."""

    context: WorkflowContext
    _helping: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _not_before_s: float = 0.0

    def run(self, stop: threading.Event) -> None:
        """Look for chunks whenever a slot is free, until told to stop."""
        while not stop.wait(LOOK_EVERY_S):
            while self._reserve():
                chunk = self._take()
                if chunk is None:
                    self._free()
                    break
                threading.Thread(target=self._help, args=(chunk, stop), name="helping", daemon=True).start()

    def _reserve(self) -> bool:
        with self._lock:
            free = self._helping < self.context.slots.free and time.monotonic() >= self._not_before_s
            self._helping += free
            return free

    def _free(self) -> None:
        with self._lock:
            self._helping -= 1

    def _is_wanted(self) -> bool:
        """Whether jobs have come for slots that are used, or kept, to help."""
        return self._helping > self.context.slots.free or self.context.slots.free <= 0

    def _take(self) -> Chunk | None:
        try:
            with self.context.sessions.begin() as session:
                return take_chunk(session, self.context.worker_id)
        except Exception:  # whatever it was: a later look may be better, and jobs go on meanwhile
            log.exception("no tiles of others could be looked for; trying again in %.0f s", AFTER_FAILURE_S)
            self._not_before_s = time.monotonic() + AFTER_FAILURE_S
            return None

    def _help(self, chunk: Chunk, stop: threading.Event) -> None:
        """Fit chunk after chunk in the slot reserved, as long as no job wants it."""
        following: Chunk | None = chunk
        try:
            while following is not None:
                with with_facts(job_id=following.job_id):
                    did_well = self._fit(following)
                if not did_well:
                    self._not_before_s = time.monotonic() + AFTER_FAILURE_S
                go_on = did_well and not self._is_wanted() and not stop.is_set()
                following = self._take() if go_on else None
        finally:
            self._free()

    def _fit(self, chunk: Chunk) -> bool:
        """Fit a chunk and bring it. False where that went wrong, and would again."""
        context, began_s = self.context, time.monotonic()
        work = {"chunk": {"order_sha256": chunk.order_sha256, "number": chunk.number}}

        def give_way(_fraction: float, _message: str) -> None:
            if time.monotonic() - began_s > LONGEST_S and self._is_wanted():
                raise JobCancelled("a job wants the slot")

        try:
            result = context.fits.run(context.builder_name, work, context.blob_url, give_way, silence_s=MAX_SILENCE_S)
            fits_sha256 = result.get("fits_sha256")
            if fits_sha256 is not None:
                with context.sessions.begin() as session:
                    wanted = bring_chunk(session, chunk, fits_sha256)
                if not wanted:
                    open_blob_store(context.blob_url, make=False).discard(fits_sha256)
        except JobCancelled:
            return True
        except (FitFailed, FitProcessDied, Unavailable) as error:
            log.warning("chunk %d of a job is left to the worker that builds its map: %s", chunk.number, error)
            return False
        except Exception:
            log.exception("chunk %d of a job is left to the worker that builds its map", chunk.number)
            return False
        return True
