"""Who is signed in to the page: random session ids, kept in this process's memory until they expire.

A session remembers the key it was opened with (the cookie never carries it), so that the page is closed within
`RECHECK_SECONDS` of the key's end.
"""

import asyncio
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field

from sqlalchemy.exc import SQLAlchemyError
from starlette.concurrency import run_in_threadpool

from app.errors import Unavailable
from app.services.reach import Reach
from app.viewer.source import Authenticate, Identity, may_view

__all__ = ["RECHECK_SECONDS", "Session", "SignedIn"]

RECHECK_SECONDS = 5.0
_MOST_SESSIONS = 10_000
_MOST_SESSIONS_OF_A_KEY = 100  # one more signs the oldest out


@dataclass(slots=True, eq=False)
class Session:
    """One signed-in browser. `ended` is set when it signs out, expires or loses its key.

    name: what its views are filed under; not a secret, unlike the id.
    """

    id: str = field(repr=False)
    key: str = field(repr=False)
    reach: Reach
    scopes: frozenset[str]
    expires_at: float
    checked_at: float
    name: str = field(default_factory=lambda: secrets.token_hex(8))
    ended: asyncio.Event = field(default_factory=asyncio.Event)


class SignedIn:
    """Every session of this process. `clock` counts seconds and never goes back; `lifetime_s` is a session's life."""

    def __init__(self, authenticate: Authenticate, lifetime_s: float, clock: Callable[[], float]) -> None:
        self._authenticate = authenticate
        self._lifetime_s = lifetime_s
        self._clock = clock
        self._sessions: dict[str, Session] = {}

    def __len__(self) -> int:
        return len(self._sessions)

    async def open(self, key: str) -> Session | None:
        """A new session for a key that may see maps, else None."""
        identity = await self._identity(key)
        if identity is None:
            return None
        self._drop_expired()
        own = [each for each in self._sessions.values() if each.key == key]
        for oldest in own[: max(len(own) + 1 - _MOST_SESSIONS_OF_A_KEY, 0)]:
            self.close(oldest)
        now = self._clock()
        session = Session(
            secrets.token_urlsafe(32), key, identity.reach, frozenset(identity.scopes),
            now + self._lifetime_s, checked_at=now,
        )  # fmt: skip
        self._sessions[session.id] = session
        return session

    async def find(self, session_id: str | None) -> Session | None:
        """The live session with this id, its key checked again when the last check is `RECHECK_SECONDS` old."""
        session = self._sessions.get(session_id or "")
        if session is None:
            return None
        now = self._clock()
        if now >= session.expires_at:
            self.close(session)
            return None
        if now - session.checked_at >= RECHECK_SECONDS:
            session.checked_at = now
            identity = await self._identity(session.key)
            if identity is None or identity.reach != session.reach:
                self.close(session)
                return None
        return None if session.ended.is_set() else session

    def close(self, session: Session) -> None:
        """End a session: its cookie is worthless from now on and its open pages are told."""
        self._sessions.pop(session.id, None)
        session.ended.set()

    def close_all(self) -> None:
        for session in list(self._sessions.values()):
            self.close(session)

    async def until_ended(self, session: Session, every_s: float = RECHECK_SECONDS) -> None:
        """Return when the session signs out, expires or loses its key; looks `every_s` seconds, sooner near expiry."""
        while await self._lives(session):
            wait_s = max(0.05, min(every_s, session.expires_at - self._clock()))
            try:
                await asyncio.wait_for(session.ended.wait(), wait_s)
            except TimeoutError:
                continue

    async def _lives(self, session: Session) -> bool:
        try:
            return await self.find(session.id) is not None
        except (Unavailable, SQLAlchemyError):
            return not session.ended.is_set()  # nobody can tell just now

    async def _identity(self, key: str) -> Identity | None:
        identity = await run_in_threadpool(self._authenticate, key)
        return identity if identity is not None and may_view(identity) else None

    def _drop_expired(self) -> None:
        now = self._clock()
        for session in [s for s in self._sessions.values() if now >= s.expires_at]:
            self.close(session)
        while len(self._sessions) >= _MOST_SESSIONS:
            self.close(min(self._sessions.values(), key=lambda s: s.expires_at))
