"""Refuse at once what could not be served soon: too many requests at one time, too many bytes of bodies in memory."""

import asyncio
from collections import Counter
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field

from starlette.types import ASGIApp, Receive, Scope, Send

from app.api.problems import isodyn_problem
from app.errors import Overloaded, TooMany

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
    as it comes. All of it in the event loop.

    Uploads of one organisation hold half of it at most, or one what it needs: others still get in, however slowly
    those come.
    """

    def __init__(self, total_bytes: int, longest_wait_s: float) -> None:
        self._free, self._total, self._longest_wait_s = total_bytes, total_bytes, longest_wait_s
        self._held: Counter[str] = Counter()
        self._waiting: list[_Upload] = []

    def take(self, count: int) -> None:
        """Raises Overloaded."""
        if count > self._free:
            raise self._full()
        self._free -= count

    def give(self, count: int) -> None:
        self._free += count
        self._let_in()

    @asynccontextmanager
    async def room(self, count: int, organisation_id: str) -> AsyncIterator[None]:
        """Hold so many bytes, at most all there are. Raises Overloaded when none come free in time, and TooMany when
        the organisation's own uploads are why."""
        upload = _Upload(min(count, self._total), organisation_id)
        await self._wait_for(upload)
        try:
            yield
        finally:
            self._release(upload)

    async def _wait_for(self, upload: "_Upload") -> None:
        self._waiting.append(upload)
        self._let_in()
        try:
            async with asyncio.timeout(self._longest_wait_s):
                await upload.let_in.wait()
        except BaseException as error:
            within = self._within_share(upload)
            if upload in self._waiting:
                self._waiting.remove(upload)
                self._let_in()
            else:
                self._release(upload)
            if isinstance(error, TimeoutError):
                raise (self._full() if within else self._share_is_full()) from None
            raise

    def _let_in(self) -> None:
        """In order of arrival, but for those that wait for others of their own organisation."""
        for upload in self._waiting.copy():
            if not self._within_share(upload):
                continue
            if upload.count > self._free:
                return
            self._waiting.remove(upload)
            self._free -= upload.count
            self._held[upload.organisation_id] += upload.count
            upload.let_in.set()

    def _release(self, upload: "_Upload") -> None:
        self._held[upload.organisation_id] -= upload.count
        self._held += Counter()  # forgets who holds nothing
        self.give(upload.count)

    def _within_share(self, upload: "_Upload") -> bool:
        held = self._held[upload.organisation_id]
        return held == 0 or held + upload.count <= self._total // 2

    def _full(self) -> Overloaded:
        reason = f"bodies of {self._total / 2**20:,.0f} MiB are being received, the most at one time; send it again"
        return Overloaded(reason, retry_after_s=2.0)

    def _share_is_full(self) -> TooMany:
        most = f"{self._total / 2**21:,.0f} MiB"
        reason = f"this organisation's uploads take {most} of memory, the most at one time; wait for their answers"
        return TooMany(reason, retry_after_s=2.0)


@dataclass(slots=True, eq=False)
class _Upload:
    count: int
    organisation_id: str
    let_in: asyncio.Event = field(default_factory=asyncio.Event)
