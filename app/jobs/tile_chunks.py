"""The tiles of a large floor, offered in chunks to workers that have nothing else to do (docs/decisions/0017).

Nobody waits for a chunk that somebody took, so it needs no lease; whoever builds the map fits what is not brought.
"""

import logging
from collections.abc import Callable, Mapping
from typing import NamedTuple, TypeVar

from sqlalchemy import ColumnElement, delete, select, update
from sqlalchemy.exc import DBAPIError
from sqlalchemy.orm import Session, sessionmaker

from app import __version__
from app.db.tables import Job, TileChunk

__all__ = ["BUILDER", "Chunk", "ChunkBoard", "bring_chunk", "delete_stale_chunks", "take_chunk"]

BUILDER = "builder"
"""Who takes what the worker that builds the map fits itself."""

R = TypeVar("R")

log = logging.getLogger(__name__)


class Chunk(NamedTuple):
    """Tiles that a worker took, number so and so of an order."""

    job_id: str
    order_sha256: str
    number: int


class ChunkBoard:
    """What one job offers. A database that is away costs it the help of others and nothing else."""

    def __init__(self, sessions: sessionmaker[Session], job_id: str) -> None:
        self._sessions, self._job_id = sessions, job_id

    def offer(self, order_sha256: str, chunks: int) -> None:
        """Let workers of this version take chunks 0 to `chunks` - 1 of this order, and of no other of the job."""

        def change(session: Session) -> None:
            session.execute(delete(TileChunk).where(TileChunk.job_id == self._job_id))
            session.add_all(
                TileChunk(job_id=self._job_id, number=number, order_sha256=order_sha256, version=__version__)
                for number in range(chunks)
            )

        self._attempt(change, None)

    def begin(self, number: int) -> None:
        """Take a chunk, where nobody has, so that nobody else does."""
        here = TileChunk.job_id == self._job_id, TileChunk.number == number, TileChunk.taken_by.is_(None)
        self._attempt(lambda session: session.execute(update(TileChunk).where(*here).values(taken_by=BUILDER)), None)

    def taken(self) -> Mapping[int, str | None]:
        """The chunks others have taken, with the hash of their fits where they have brought them."""
        theirs = TileChunk.job_id == self._job_id, TileChunk.taken_by != BUILDER
        chunks = select(TileChunk.number, TileChunk.fits_sha256).where(*theirs)
        return self._attempt(lambda session: {row.number: row.fits_sha256 for row in session.execute(chunks)}, {})

    def withdraw(self) -> None:
        """Let nobody take anything any more."""
        mine = delete(TileChunk).where(TileChunk.job_id == self._job_id)
        self._attempt(lambda session: session.execute(mine), None)

    def _attempt(self, change: Callable[[Session], R], otherwise: R) -> R:
        try:
            with self._sessions.begin() as session:
                return change(session)
        except DBAPIError:
            log.warning("the tiles of job %s could not be shared with other workers", self._job_id, exc_info=True)
            return otherwise


def take_chunk(session: Session, worker_id: str) -> Chunk | None:
    """The last chunk of the oldest job that offers one to this version; None when there is none."""
    free = select(TileChunk.job_id, TileChunk.order_sha256, TileChunk.number).join(Job, Job.id == TileChunk.job_id)
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


def delete_stale_chunks(session: Session) -> int:
    """Forget what jobs offered that do not run any more."""
    running = select(Job.id).where(Job.status == "running")
    stale = delete(TileChunk).where(TileChunk.job_id.not_in(running)).returning(TileChunk.number)
    return len(session.scalars(stale).all())


def _is(chunk: Chunk) -> tuple[ColumnElement[bool], ...]:
    return (
        TileChunk.job_id == chunk.job_id,
        TileChunk.number == chunk.number,
        TileChunk.order_sha256 == chunk.order_sha256,
    )
