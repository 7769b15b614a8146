"""Every blob that the database names, and what for: what must be in a backup, and must not be cleaned away.

A test sees to it that every column that could hold a hash is here, or is known to hold none.
"""

import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, select
from sqlalchemy.orm import InstrumentedAttribute, Session

from app.db.tables import Calibration, Floor, Map, Survey, TileChunk, Track
from app.jobs.queue import JobQueue

__all__ = ["CACHES", "IN_HAND", "IN_JSON", "NAMING", "References", "carried_by_jobs", "references"]

NAMING: tuple[InstrumentedAttribute[Any], ...] = (
    Survey.raw_sha256,
    Survey.samples_sha256,
    Map.grid_sha256,
    Map.layers_sha256,
    Map.quality_sha256,
    Calibration.samples_sha256,
)
"""Columns that name a blob which must be there."""

CACHES: tuple[InstrumentedAttribute[Any], ...] = (Map.state_sha256,)
"""Columns that name a blob which saves work: without it the next build is a full one."""

IN_HAND: tuple[InstrumentedAttribute[Any], ...] = (TileChunk.order_sha256, TileChunk.fits_sha256)
"""Columns that name what workers tell each other while a job runs."""

IN_JSON: Mapping[InstrumentedAttribute[Any], Callable[[Any], list[str]]] = {
    Floor.plan: lambda plan: [plan["sha256"]],
    Track.spec: lambda spec: [grid_sha256 for _floor_id, _map_id, grid_sha256 in spec["maps"]],
}
"""JSON columns that name blobs which must be there, and where."""

_HASH = re.compile(r"[0-9a-f]{64}")
_AT_A_TIME = 500


@dataclass(frozen=True, slots=True)
class References:
    """The hashes that are named, by `table.column`."""

    needed: Mapping[str, frozenset[str]]
    caches: Mapping[str, frozenset[str]]

    @property
    def all_needed(self) -> frozenset[str]:
        return frozenset().union(*self.needed.values())

    @property
    def all(self) -> frozenset[str]:
        return self.all_needed.union(*self.caches.values())

    def named_by(self, sha256: str) -> list[str]:
        """The columns that name a blob."""
        return [column for column, named in {**self.needed, **self.caches}.items() if sha256 in named]


def references(session: Session | Connection) -> References:
    """What the database names, as the session's or connection's transaction sees it."""
    needed = {_name(column): _plain(session, column) for column in NAMING}
    needed |= {_name(column): _inside(session, column, find) for column, find in IN_JSON.items()}
    return References(needed, {_name(column): _plain(session, column) for column in CACHES})


def carried_by_jobs(session: Session, queue: JobQueue) -> frozenset[str]:
    """Blobs that unfinished jobs hold: what their plans name, and what workers tell each other."""
    recorded = frozenset(found for said in queue.recorded(session) for found in _hashes(said))
    return recorded.union(*(_plain(session, column) for column in IN_HAND))


def _name(column: InstrumentedAttribute[Any]) -> str:
    return f"{column.class_.__tablename__}.{column.key}"


def _plain(session: Session | Connection, column: InstrumentedAttribute[Any]) -> frozenset[str]:
    return frozenset(_scalars(session, column))


def _inside(
    session: Session | Connection, column: InstrumentedAttribute[Any], find: Callable[[Any], list[str]]
) -> frozenset[str]:
    return frozenset(sha256 for value in _scalars(session, column) if value is not None for sha256 in find(value))


def _scalars(session: Session | Connection, column: InstrumentedAttribute[Any]) -> Iterable[Any]:
    statement = select(column).where(column.is_not(None)).execution_options(yield_per=_AT_A_TIME)
    return session.scalars(statement)


def _hashes(value: object) -> Iterator[str]:
    """Every string of the form of a hash, at any depth."""
    if isinstance(value, str) and _HASH.fullmatch(value):
        yield value
    elif isinstance(value, Mapping):
        for each in value.values():
            yield from _hashes(each)
    elif isinstance(value, (list, tuple)):
        for each in value:
            yield from _hashes(each)
