"""Tracks in the database: what is read to go on from, and batches of steps written many at a time.

A batch is committed before it is answered. To force a commit to the disk takes milliseconds, however little is in it:
the batches of all tracks that wait meanwhile go into the next one together.
"""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from datetime import datetime
from hashlib import sha256
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from typing import Any

import msgspec
import zstandard
from sqlalchemy import Connection, Engine, bindparam, delete, insert, select, update
from sqlalchemy.orm import Session

from app import __version__
from app.db.tables import Track, TrackState, TrackSteps, utc_now
from app.errors import CorruptArtefact

__all__ = ["Batch", "TrackLog", "Write", "batches_of", "delete_track", "end_idle", "end_track", "read_state"]

MOST_TOGETHER = 200
_CHUNK = 200  # batches read at a time
_WRITTEN_BY = f"{__version__}-1"
"""A state is a cache of the version that wrote it; another follows the steps again."""


@dataclass(frozen=True, slots=True)
class Batch:
    """Steps that were followed together, and all that was said of them.

    steps      as they were sent; the track waits for `next_step` after them
    estimate   the one that was answered, after the last of them
    path       a row a step (`app.services.track_estimate.PATH_NAMES`)
    settled    rows of places smoothed for good
    """

    sequence: int
    steps: tuple[dict[str, Any], ...]
    next_step: int
    estimate: dict[str, Any]
    path: list[list[Any]]
    settled: list[list[Any]]

    def digest(self) -> str:
        """SHA-256 of all that was said, every bit of every number included."""
        return sha256(msgspec.json.encode([self.estimate, self.path, self.settled])).hexdigest()


@dataclass(frozen=True, slots=True)
class Write:
    """One track's next write: it takes place if the track is active, and at `version` still."""

    track_id: str
    version: int
    next_step: int
    batches: int
    waiting: Sequence[dict[str, Any]]
    gaps: Sequence[tuple[int, int]]
    batch: Batch | None
    state: bytes | None = None


class TrackLog:
    """Writes in one thread, which takes all that waits into one transaction."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine
        self._queue: SimpleQueue[tuple[Write, Future[bool]] | None] = SimpleQueue()
        self._thread: Thread | None = None
        self._lock = Lock()

    def write(self, write: Write) -> "Future[bool]":
        """Whether it took place, once it is on the disk; False when somebody else wrote to the track first."""
        done: Future[bool] = Future()
        with self._lock:
            if self._thread is None:
                self._thread = Thread(target=self._run, name="track-log", daemon=True)
                self._thread.start()
        self._queue.put((write, done))
        return done

    def close(self) -> None:
        """Write what waits, and stop."""
        with self._lock:
            thread, self._thread = self._thread, None
        if thread is not None:
            self._queue.put(None)
            thread.join(timeout=30)

    def _run(self) -> None:
        while (first := self._queue.get()) is not None:
            waiting, ended = [first], False
            with contextlib.suppress(Empty):
                while len(waiting) < MOST_TOGETHER:
                    if (another := self._queue.get_nowait()) is None:
                        ended = True
                        break
                    waiting.append(another)
            self._commit(waiting)
            if ended:
                return

    def _commit(self, waiting: Sequence[tuple[Write, "Future[bool]"]]) -> None:
        try:
            with self._engine.connect() as connection:
                taken = _write_all(connection, [write for write, _ in waiting])
        except BaseException as error:
            for _, done in waiting:
                done.set_exception(error)
            return
        for write, done in waiting:
            done.set_result(write.track_id in taken)


def _write_all(connection: Connection, writes: Sequence[Write]) -> set[str]:
    """In one transaction; the ids of tracks whose write took place."""
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql("BEGIN IMMEDIATE")  # before the versions are read
    ids = [write.track_id for write in writes]
    versions = {row.id: row.version for row in connection.execute(_VERSIONS, {"ids": ids})}
    taken = [write for write in writes if versions.get(write.track_id) == write.version]
    if taken:
        now = utc_now()
        connection.execute(_UPDATE, [_track_row(write, now) for write in taken])
        rows = [_batch_row(write.track_id, write.batch) for write in taken if write.batch is not None]
        if rows:
            connection.execute(insert(TrackSteps), rows)
        states = [write for write in taken if write.state is not None]
        if states:
            connection.execute(delete(TrackState).where(TrackState.track_id.in_([each.track_id for each in states])))
            connection.execute(insert(TrackState), [_state_row(write) for write in states])
    connection.commit()
    return {write.track_id for write in taken}


_VERSIONS = (
    select(Track.id, Track.version)
    .where(Track.id.in_(bindparam("ids", expanding=True)), Track.status == "active")
    .order_by(Track.id)
    .with_for_update()
)
_UPDATE = (
    update(Track.__table__)  # type: ignore[arg-type]
    .where(Track.__table__.c.id == bindparam("track_id"))
    .values(
        version=bindparam("to_version"), next_step=bindparam("to_step"), batches=bindparam("to_batches"),
        waiting=bindparam("to_waiting"), gaps=bindparam("to_gaps"), touched_at=bindparam("now"),
    )
)  # fmt: skip


def _track_row(write: Write, now: datetime) -> dict[str, Any]:
    return {
        "track_id": write.track_id, "to_version": write.version + 1, "to_step": write.next_step,
        "to_batches": write.batches, "to_waiting": list(write.waiting), "to_gaps": [list(gap) for gap in write.gaps],
        "now": now,
    }  # fmt: skip


def _batch_row(track_id: str, batch: Batch) -> dict[str, Any]:
    told = msgspec.json.encode({"steps": batch.steps, "estimate": batch.estimate, "path": batch.path})
    return {
        "track_id": track_id, "sequence": batch.sequence, "next_step": batch.next_step,
        "data": zstandard.ZstdCompressor(level=1).compress(told), "settled": batch.settled or None,
        "sha256": batch.digest(),
    }  # fmt: skip


def _state_row(write: Write) -> dict[str, Any]:
    return {"track_id": write.track_id, "batches": write.batches, "written_by": _WRITTEN_BY, "data": write.state}


def read_state(session: Session, track_id: str) -> tuple[int, bytes] | None:
    """How many batches a kept state has followed, and the state; None where there is none of this version."""
    row = session.execute(
        select(TrackState.batches, TrackState.data).where(
            TrackState.track_id == track_id, TrackState.written_by == _WRITTEN_BY
        )
    ).one_or_none()
    return None if row is None else (row.batches, row.data)


def batches_of(
    open_session: Callable[[], contextlib.AbstractContextManager[Session]],
    track_id: str, first: int = 0, stop: int | None = None, from_step: int = 0,
) -> Iterator[tuple[Batch, str]]:  # fmt: skip
    """Batches in order, each with the digest of what was said then; of sequences [first, stop), or that hold steps from
    `from_step` on. A few at a time are in memory."""
    while stop is None or first < stop:
        last = first + _CHUNK if stop is None else min(first + _CHUNK, stop)
        statement = (
            select(TrackSteps)
            .where(TrackSteps.track_id == track_id, TrackSteps.sequence >= first, TrackSteps.next_step > from_step)
            .order_by(TrackSteps.sequence)
            .limit(last - first)
        )
        with open_session() as session:
            rows = session.scalars(statement).all()
        for row in rows:
            if stop is not None and row.sequence >= stop:
                return
            yield _batch_of(row), row.sha256
        if len(rows) < last - first:
            return
        first = rows[-1].sequence + 1


def _batch_of(row: TrackSteps) -> Batch:
    try:
        told = msgspec.json.decode(zstandard.ZstdDecompressor().decompress(row.data))
        return Batch(
            row.sequence, tuple(told["steps"]), row.next_step, told["estimate"], told["path"], row.settled or []
        )
    except (zstandard.ZstdError, msgspec.DecodeError, KeyError, TypeError) as error:
        raise CorruptArtefact(f"stored steps of track {row.track_id} cannot be read: {error}") from error


def end_track(session: Session, track: Track, reason: str, at: datetime) -> None:
    """No further steps are taken, also not by a process that follows it at this moment."""
    _end(session, reason, at, Track.id == track.id)
    session.refresh(track)


def end_idle(session: Session, before: datetime, at: datetime) -> int:
    """End every track that was last touched before a time; how many they were."""
    return _end(session, "idle", at, Track.touched_at < before)


def _end(session: Session, reason: str, at: datetime, *which: Any) -> int:
    done: Any = session.execute(
        update(Track)
        .where(Track.status == "active", *which)
        .values(status="ended", ended_reason=reason, ended_at=at, version=Track.version + 1)
        .execution_options(synchronize_session=False)
    )
    return int(done.rowcount)


def delete_track(session: Session, track_id: str) -> None:
    """And all its rows. Locked first: whoever writes to it now is waited for, and whoever comes later finds nothing."""
    session.execute(update(Track).where(Track.id == track_id).values(status="ended", version=Track.version + 1))
    for table in (TrackState, TrackSteps):
        session.execute(delete(table).where(table.track_id == track_id))
    session.execute(delete(Track).where(Track.id == track_id))
