"""The tiles of a large floor, offered in chunks to workers that have nothing else to do (docs/decisions/0017).

Nobody waits for a chunk that somebody took, so it needs no lease; whoever builds the map fits what is not brought.
"""

import logging
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import NamedTuple, TypeVar

from sqlalchemy import ColumnElement, delete, select, update
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session, sessionmaker

from app import __version__
from app.blobs import BlobStore
from app.db.tables import Job, TileChunk, new_id
from app.errors import Unavailable

__all__ = ["BUILDER", "Chunk", "ChunkBoard", "bring_chunk", "discard_stale_chunks", "take_chunk"]

BUILDER = "builder"
"""Who takes what the worker that builds the map fits itself."""
AWAY_S = 10.0
"""So long a database that failed is not asked again for help."""

R = TypeVar("R")

log = logging.getLogger(__name__)


class Chunk(NamedTuple):
    """Tiles that a worker took, number so and so of an offer."""

    offer_id: str
    number: int
    order_sha256: str
    job_id: str


class ChunkBoard:
    """What a job offers, one order at a time. A database that is away costs it the help of others and nothing else."""

    def __init__(self, sessions: sessionmaker[Session], blobs: BlobStore, job_id: str) -> None:
        self._sessions, self._blobs, self._job_id = sessions, blobs, job_id
        self._offer_id: str | None = None
        self._not_before_s = 0.0

    def offer(self, order_sha256: str, chunks: int) -> None:
        """Let workers of this version take chunks 0 to `chunks` - 1 of this order, and of no other of the job."""
        self._offer_id = offer_id = new_id()
        rows = [
            TileChunk(offer_id=offer_id, number=number, job_id=self._job_id, order_sha256=order_sha256,
                      version=__version__)
            for number in range(chunks)
        ]  # fmt: skip

        def change(session: Session) -> set[str]:
            named = _delete(session, TileChunk.job_id == self._job_id)
            session.add_all(rows)
            return named - {order_sha256}

        _discard(self._blobs, self._attempt(change, set()))

    def clear(self) -> None:
        """Forget what a worker offered that had the job before, and died."""
        mine = TileChunk.job_id == self._job_id
        _discard(self._blobs, self._attempt(lambda session: _delete(session, mine), set()))

    def begin(self, number: int) -> None:
        """Take a chunk, where nobody has, so that nobody else does."""
        free = TileChunk.offer_id == self._offer_id, TileChunk.number == number, TileChunk.taken_by.is_(None)
        self._attempt(lambda session: session.execute(update(TileChunk).where(*free).values(taken_by=BUILDER)), None)

    def taken(self) -> Mapping[int, str | None]:
        """The chunks others have taken, with the hash of their fits where they have brought them."""
        theirs = TileChunk.offer_id == self._offer_id, TileChunk.taken_by != BUILDER
        chunks = select(TileChunk.number, TileChunk.fits_sha256).where(*theirs)
        return self._attempt(lambda session: {row.number: row.fits_sha256 for row in session.execute(chunks)}, {})

    def withdraw(self) -> None:
        """Let nobody take anything any more, and forget what was brought."""
        if self._offer_id is not None:
            mine = TileChunk.offer_id == self._offer_id
            self._offer_id, self._not_before_s = None, 0.0
            _discard(self._blobs, self._attempt(lambda session: _delete(session, mine), set()))

    def _attempt(self, change: Callable[[Session], R], otherwise: R) -> R:
        if time.monotonic() < self._not_before_s:
            return otherwise
        try:
            with self._sessions.begin() as session:
                return change(session)
        except SQLAlchemyError as error:
            self._not_before_s = time.monotonic() + AWAY_S
            log.warning("the tiles of job %s are not shared with other workers for now: %s", self._job_id, error)
            return otherwise


def take_chunk(session: Session, worker_id: str) -> Chunk | None:
    """The last chunk of the oldest job that offers one to this version; None when there is none."""
    free = select(*(getattr(TileChunk, name) for name in Chunk._fields)).join(Job, Job.id == TileChunk.job_id)
    free = free.where(TileChunk.taken_by.is_(None), TileChunk.version == __version__, Job.status == "running")
    while row := session.execute(free.order_by(TileChunk.job_id, TileChunk.number.desc()).limit(1)).one_or_none():
        chunk = Chunk(*row)
        still_free = *_is(chunk), TileChunk.taken_by.is_(None)
        taken = update(TileChunk).where(*still_free).values(taken_by=worker_id).returning(TileChunk.number)
        if session.scalar(taken) is not None:
            return chunk
    return None


def bring_chunk(session: Session, chunk: Chunk, fits_sha256: str) -> bool:
    """Say where the fits of a chunk are. False: nobody wants them any more."""
    brought = update(TileChunk).where(*_is(chunk)).values(fits_sha256=fits_sha256).returning(TileChunk.number)
    return session.scalar(brought) is not None


def discard_stale_chunks(sessions: sessionmaker[Session], blobs: BlobStore) -> int:
    """Forget what jobs offered that do not run any more: how many chunks it was."""
    running = select(Job.id).where(Job.status == "running")
    with sessions.begin() as session:
        count = len(session.scalars(select(TileChunk.number).where(TileChunk.job_id.not_in(running))).all())
        named = _delete(session, TileChunk.job_id.not_in(running)) if count else set()
    _discard(blobs, named)
    return count


def _delete(session: Session, which: ColumnElement[bool]) -> set[str]:
    """The blobs that the deleted rows named."""
    deleted = delete(TileChunk).where(which).returning(TileChunk.order_sha256, TileChunk.fits_sha256)
    return {sha256 for row in session.execute(deleted) for sha256 in row if sha256 is not None}


def _discard(blobs: BlobStore, named: Iterable[str]) -> None:
    with suppress(Unavailable):  # `isodyn clean` finds them
        for sha256 in named:
            blobs.discard(sha256)


def _is(chunk: Chunk) -> tuple[ColumnElement[bool], ...]:
    return TileChunk.offer_id == chunk.offer_id, TileChunk.number == chunk.number
