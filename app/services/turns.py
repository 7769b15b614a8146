"""Threads for work that takes a processor: few at once, the others in order of arrival, and no longer queue than helps.

Whoever would wait longer than `longest_wait_s` is told so at once: a queue that only grows serves nobody.
"""

import asyncio
from collections import deque
from collections.abc import Awaitable, Callable
from concurrent.futures import Future
from threading import Lock
from time import monotonic
from typing import Any, TypeVar

from app.errors import Overloaded
from app.telemetry.facts import ContextExecutor

__all__ = ["Turns"]

T = TypeVar("T")
_LATELY = 10  # pieces of work that say how long the next will take
_MOST_WAITING = 2000
_LOOKS_AFTER_S = 0.05  # of waiting: has the client gone?
_TOLD_WITHIN_S = 5.0  # by the event loop, which may have stopped for good


class Turns(ContextExecutor):
    """`threads` at work at once. `submit` takes any work; `run` and `check` refuse what would wait too long, and `run`
    what did, because nothing was known yet of how long work takes.

    As long as it is `patient` nobody is refused for that: a first start compiles for a minute, and then is quick.
    """

    def __init__(self, threads: int, name: str, longest_wait_s: float, patient: bool = False) -> None:
        super().__init__(threads, thread_name_prefix=name)
        self.patient = patient
        self._most_at_once, self._longest_wait_s = threads, longest_wait_s
        self._pending, self._mean_s = 0, 0.0
        self._lately: deque[float] = deque(maxlen=_LATELY)
        self._counting = Lock()

    def hurry(self) -> None:
        """Be patient no more; what was begun until now says nothing of what follows."""
        self.patient = False

    def submit(self, fn: Callable[..., T], /, *args: Any, **kwargs: Any) -> Future[T]:
        with self._counting:
            self._pending += 1
        future = super().submit(self._timed, fn, *args, **kwargs)
        future.add_done_callback(self._done)
        return future

    @property
    def expected_wait_s(self) -> float:
        """How long work that comes now would wait, by how long it took lately."""
        return max(self._pending + 1 - self._most_at_once, 0) * self._mean_s / self._most_at_once

    def check(self) -> None:
        """Raise Overloaded when work would wait too long; `retry_after_s` is when what waits will have been done."""
        wait_s = self.expected_wait_s
        if (wait_s > self._longest_wait_s and not self.patient) or self._pending > _MOST_WAITING:
            raise Overloaded(
                f"{self._pending} others wait already, about {wait_s:.0f} s; try again later", retry_after_s=wait_s
            )

    async def run(
        self, work: Callable[[], T], gone: Callable[[], Awaitable[bool]] | None = None, admitted: bool = False
    ) -> T:
        """The work's result, when its turn has come. Raises Overloaded, unless it was `admitted` before, as part of a
        whole; and when `gone` says that nobody waits for it any more. Then it is not done."""
        if not admitted:
            self.check()
        loop, came, patient = asyncio.get_running_loop(), monotonic(), self.patient

        def begin() -> T:
            waited_s = monotonic() - came
            if not admitted and not patient and waited_s > self._longest_wait_s:
                raise Overloaded(
                    f"its turn did not come within {waited_s:.0f} s; try again later", retry_after_s=waited_s
                )
            if gone is not None and waited_s > _LOOKS_AFTER_S:
                left = asyncio.run_coroutine_threadsafe(_said(gone), loop)
                try:
                    if left.result(_TOLD_WITHIN_S):
                        raise Overloaded("the client has gone")
                except TimeoutError:
                    left.cancel()
                    raise Overloaded("the server is stopping, or too busy to go on; try again later") from None
            return work()

        return await loop.run_in_executor(self, begin)

    def _timed(self, fn: Callable[..., T], *args: Any, **kwargs: Any) -> T:
        start, starting = monotonic(), self.patient
        try:
            return fn(*args, **kwargs)
        finally:
            if not starting:
                self._note(monotonic() - start)

    def _note(self, taken_s: float) -> None:
        with self._counting:  # the one that took longest, the first of all perhaps, says little of the others
            self._lately.append(taken_s)
            self._mean_s = (sum(self._lately) - max(self._lately)) / max(len(self._lately) - 1, 1)

    def _done(self, _: Future[Any]) -> None:
        with self._counting:
            self._pending -= 1


async def _said(gone: Callable[[], Awaitable[bool]]) -> bool:
    return await gone()
