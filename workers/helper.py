"""A worker with free slots helps others with the tiles of large floors (docs/decisions/0017).

Jobs come first: a chunk is taken only for a slot that no job has, and a job that comes meanwhile does not wait for it.
Whatever becomes of a chunk, the job it is of does not depend on it.
"""

import logging
import threading
from dataclasses import dataclass, field

from app.blobs import open_blob_store
from app.errors import Unavailable
from app.jobs.tile_chunks import Chunk, bring_chunk, take_chunk
from app.telemetry.facts import with_facts
from workers.fit_process import FitFailed, FitProcessDied, FitProcesses
from workers.workflows import WorkflowContext

__all__ = ["Helper"]

LOOK_EVERY_S = 0.5
MAX_SILENCE_S = 120.0  # between two tiles, or until the first

log = logging.getLogger(__name__)


@dataclass
class Helper:
    """One of a worker."""

    context: WorkflowContext
    worker_id: str
    _fits: FitProcesses = field(default_factory=FitProcesses)
    _helping: int = 0
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def run(self, stop: threading.Event) -> None:
        """Look for chunks whenever a slot is free, until told to stop."""
        while not stop.wait(LOOK_EVERY_S):
            while self._reserve():
                chunk = self._take()
                if chunk is None:
                    self._free()
                    break
                threading.Thread(target=self._help, args=(chunk, stop), name="helping", daemon=True).start()
        self._fits.close()

    def _reserve(self) -> bool:
        with self._lock:
            free = self._helping < self.context.slots.free
            self._helping += free
            return free

    def _free(self) -> None:
        with self._lock:
            self._helping -= 1

    def _take(self) -> Chunk | None:
        try:
            with self.context.sessions.begin() as session:
                return take_chunk(session, self.worker_id)
        except Exception:  # whatever it was: the next look may be better, and jobs go on meanwhile
            log.exception("no tiles of others could be looked for")
            return None

    def _help(self, chunk: Chunk, stop: threading.Event) -> None:
        """Fit chunk after chunk in the slot reserved, as long as no job wants it."""
        following: Chunk | None = chunk
        try:
            while following is not None:
                self._fit(following)
                wanted = self._helping > self.context.slots.free
                following = None if wanted or stop.is_set() else self._take()
        finally:
            self._free()

    def _fit(self, chunk: Chunk) -> None:
        work = {"chunk": {"order_sha256": chunk.order_sha256, "number": chunk.number}}
        context = self.context
        with with_facts(job_id=chunk.job_id):
            try:
                result = self._fits.run(
                    context.builder_name, work, context.blob_url, lambda *_: None, silence_s=MAX_SILENCE_S
                )
                with context.sessions.begin() as session:
                    wanted = bring_chunk(session, chunk, result["fits_sha256"])
                if not wanted:
                    open_blob_store(context.blob_url, make=False).discard(result["fits_sha256"])
            except (FitFailed, FitProcessDied, Unavailable) as error:
                log.info("tiles %d of a job of another worker are left to it: %s", chunk.number, error)
            except Exception:
                log.exception("tiles of another worker's job are left to it")
