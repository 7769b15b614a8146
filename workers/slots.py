"""When a worker looks for its next job: as soon as a slot becomes free, now and then while one is, never while none is.

The engine polls at one pace, with free slots or without, and a poll costs a transaction in each worker. Its queue
thread sleeps in the event that tells it to stop, so an event that knows the slots decides when it wakes.
"""

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from dbos import DBOS, Queue
from dbos._queue import queue_worker_thread  # nothing public takes jobs at a pace of one's own

__all__ = ["POLL_S", "Slots"]

POLL_S = 0.25
FIRST_POLL_S = 0.02  # the engine has a last word to write of the job that ended
STOP_S = 10.0


class Slots(threading.Event):
    """The slots of this process. Set, nothing is taken any more."""

    def __init__(self, count: int) -> None:
        """`count`: the jobs that run at one time."""
        super().__init__()
        self._free, self._ended, self._pause_s = count, False, FIRST_POLL_S
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None

    @property
    def free(self) -> int:
        """How many no job has."""
        return self._free

    def fill(self, engine: DBOS, queue: Queue) -> None:
        """Take jobs from the queue from now on; the engine must not listen to it."""
        self._thread = threading.Thread(
            target=queue_worker_thread, args=(self, engine, queue), name="queue", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Take no more, and see that nothing is being taken."""
        self.set()
        if self._thread is not None:
            self._thread.join(STOP_S)

    @contextmanager
    def taken(self) -> Iterator[None]:
        """One slot, by a job that runs."""
        with self._changed:
            self._free -= 1
        try:
            yield
        finally:
            with self._changed:
                self._free += 1
                self._ended = True
                self._changed.notify_all()

    def set(self) -> None:
        super().set()
        with self._changed:
            self._changed.notify_all()

    def wait(self, timeout: float | None = None) -> bool:
        """Until the next poll; whether to stop. Polls become rarer, down to `timeout`, when they find nothing."""
        with self._changed:
            self._changed.wait_for(lambda: self.is_set() or self._ended, self._pause_s)
            self._changed.wait_for(lambda: self.is_set() or self._free > 0)
            if self._ended:
                self._ended, self._pause_s = False, FIRST_POLL_S
                self._changed.wait_for(self.is_set, FIRST_POLL_S)
            else:
                self._pause_s = min(2.0 * self._pause_s, max(timeout or 0.0, POLL_S))
        return self.is_set()
