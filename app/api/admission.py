"""Refuse at once what could not be served soon: too many requests at one time, too many bytes of bodies in memory."""

import asyncio
from collections import deque
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from starlette.types import ASGIApp, Receive, Scope, Send

from app.api.problems import isodyn_problem
from app.errors import Overloaded

__all__ = ["Admission", "BodyMemory"]

ALWAYS = frozenset({"/healthz", "/readyz", "/metrics"})
_IN_SCOPE = "isodyn.admitted"


class Admission:
    """At most so many requests at one time, whoever asks, and beside them a quarter as many streams of events, which
    stay open for long; whether the process is well can be asked always."""

    def __init__(self, app: ASGIApp, most: int) -> None:
        self.app = app
        self._most = {"requests": most, "streams of events": max(most // 4, 1)}
        self._open = dict.fromkeys(self._most, 0)

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["path"] in ALWAYS or _IN_SCOPE in scope:
            await self.app(scope, receive, send)
            return
        kind = "streams of events" if scope["path"].endswith("/events") else "requests"
        if self._open[kind] >= self._most[kind]:
            told = f"{self._most[kind]} {kind} are open, the most; try again in a moment"
            await isodyn_problem(Overloaded(told, retry_after_s=1.0))(scope, receive, send)
            return
        scope[_IN_SCOPE] = True
        self._open[kind] += 1
        try:
            await self.app(scope, receive, send)
        finally:
            self._open[kind] -= 1


class BodyMemory:
    """Bytes of request bodies held at one time. An upload waits for room before it is read, a small body takes its own
    as it comes. All of it in the event loop."""

    def __init__(self, total_bytes: int, longest_wait_s: float) -> None:
        self._free, self._total, self._longest_wait_s = total_bytes, total_bytes, longest_wait_s
        self._waiting: deque[tuple[int, asyncio.Future[None]]] = deque()

    def take(self, count: int) -> None:
        """Raises Overloaded."""
        if count > self._free:
            raise self._full()
        self._free -= count

    def give(self, count: int) -> None:
        self._free += count
        while self._waiting and self._waiting[0][0] <= self._free:
            wanted, turn = self._waiting.popleft()
            if not turn.done():
                self._free -= wanted
                turn.set_result(None)

    @asynccontextmanager
    async def room(self, count: int) -> AsyncIterator[None]:
        """Hold so many bytes, at most all there are. Raises Overloaded when none come free in time."""
        count = min(count, self._total)
        await self._wait_for(count)
        try:
            yield
        finally:
            self.give(count)

    async def _wait_for(self, count: int) -> None:
        if not self._waiting and count <= self._free:
            self._free -= count
            return
        turn = asyncio.get_running_loop().create_future()
        self._waiting.append((count, turn))
        try:
            async with asyncio.timeout(self._longest_wait_s):
                await turn
        except BaseException as error:
            if turn.done() and not turn.cancelled():
                self.give(count)
            else:
                turn.cancel()
                self._waiting = deque(each for each in self._waiting if each[1] is not turn)
                self.give(0)
            if isinstance(error, TimeoutError):
                raise self._full() from None
            raise

    def _full(self) -> Overloaded:
        reason = f"bodies of {self._total / 2**20:,.0f} MiB are being received, the most at one time; send it again"
        return Overloaded(reason, retry_after_s=2.0)
