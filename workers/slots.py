"""When a worker looks for its next job: as soon as a slot becomes free, now and then while one is, never while none is.

The engine polls at one pace, with free slots or without, and a poll costs several statements in each worker. Its queue
thread sleeps in the event that tells it to stop, so an event that knows the slots, and whether any job was admitted
that has not begun, decides when it wakes.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from dbos import DBOS, Queue
from dbos._queue import queue_worker_thread  # nothing public takes jobs at a pace of one's own

__all__ = ["POLL_S", "Slots"]

POLL_S = 0.25
FIRST_POLL_S = 0.02  # the engine has a last word to write of the job that ended
POLL_ANYWAY_S = 1.0  # for jobs of the dead, which have begun
STOP_S = 10.0


class Slots(threading.Event):
    """The slots of this process. Set, nothing is taken any more."""

    def __init__(self, count: int) -> None:
        """`count`: the jobs that run at one time."""
        super().__init__()
        self._count, self._free = count, count
        self._ended, self._pause_s = False, FIRST_POLL_S
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._is_wanted: Callable[[], bool] = lambda: True

    @property
    def free(self) -> int:
        """How many no job has."""
        return self._free

    @property
    def are_used(self) -> bool:
        """Whether any job has one."""
        return self._free < self._count

    def fill(self, engine: DBOS, queue: Queue, is_wanted: Callable[[], bool]) -> None:
        """Take jobs from the queue from now on; the engine must not listen to it.

        `is_wanted` says, at less cost than a poll, whether a job waits in the queue that has not begun.
        """
        self._is_wanted = is_wanted
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
        """Until the next poll; whether to stop. Looks become rarer, down to `timeout`, when they find nothing."""
        anyway_s = time.monotonic() + POLL_ANYWAY_S
        while not self._wait_for_look(timeout) and time.monotonic() < anyway_s and not self._is_wanted():
            pass
        return self.is_set()

    def _wait_for_look(self, timeout: float | None) -> bool:
        """True where there is nothing to look for: to stop, or to poll at once because a job has ended."""
        with self._changed:
            self._changed.wait_for(lambda: self.is_set() or self._ended, self._pause_s)
            self._changed.wait_for(lambda: self.is_set() or self._free > 0)
            if not self._ended:
                self._pause_s = min(2.0 * self._pause_s, max(timeout or 0.0, POLL_S))
                return self.is_set()
            self._ended, self._pause_s = False, FIRST_POLL_S
            self._changed.wait_for(self.is_set, FIRST_POLL_S)
            return True
