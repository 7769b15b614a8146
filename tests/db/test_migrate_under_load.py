"""The schema grows while others write: nobody fails, and nobody queues behind a step that waits for a lock."""

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from uuid import uuid4

import pytest
from sqlalchemy import Engine, text

from app.db import engine as engine_module
from app.db.engine import downgrade, migrate, migration_state
from app.db.snapshot import known_revisions
from app.errors import Unavailable

BEFORE = "0005"  # the schema that writers began with
LONGEST_STALL_S = 8.0  # a lock's timeout several times over; without it the stall is the long transaction's


@pytest.fixture
def old(database_url: str, engine: Engine, tmp_path: Path) -> Iterator[Engine]:
    """A database at the schema from before, with some rows."""
    downgrade(database_url, BEFORE)
    with engine.begin() as connection:
        connection.execute(text("INSERT INTO organisation (id, name, created_at) VALUES (:i, :i, :t)"),
                           {"i": uuid4().hex, "t": "2026-01-01 00:00:00"})  # fmt: skip
    yield engine
    migrate(database_url)


class Writers:
    """Threads that insert jobs as the version before does, until told to stop; each notes its slowest write."""

    def __init__(self, engine: Engine) -> None:
        self._engine, self._stop = engine, threading.Event()
        self.written, self.slowest_s = 0, 0.0
        with engine.connect() as connection:
            self._owner = connection.scalar(text("SELECT min(id) FROM organisation"))
        self._pool = ThreadPoolExecutor(3)
        self._runs: list[Future[None]] = [self._pool.submit(self._write) for _ in range(3)]

    def _write(self) -> None:
        insert = text(
            "INSERT INTO job (id, organisation_id, floor_id, kind, workflow_id, status, progress, message,"
            " cancel_requested, created_at) VALUES (:i, :o, :i, 'rebuild', :i, 'accepted', 0, '', :no, :t)"
        )
        while not self._stop.is_set():
            row = {"i": uuid4().hex, "o": self._owner, "no": False, "t": "2026-01-01 00:00:00"}
            began = time.monotonic()
            with self._engine.begin() as connection:
                connection.execute(insert, row)
            self.slowest_s = max(self.slowest_s, time.monotonic() - began)
            self.written += 1
            time.sleep(0.002)

    def stop(self) -> None:
        self._stop.set()
        for run in self._runs:
            run.result(60)  # raises what a writer met
        self._pool.shutdown()


@pytest.fixture
def writers(old: Engine) -> Iterator[Callable[[], Writers]]:
    made: list[Writers] = []

    def start() -> Writers:
        made.append(Writers(old))
        return made[-1]

    yield start
    for each in made:
        each._stop.set()


def test_writers_go_on_while_the_schema_grows(old: Engine, database_url: str, writers: Callable[[], Writers]) -> None:
    busy = writers()
    while busy.written < 50:
        time.sleep(0.01)
    migrate(database_url)
    enough = busy.written + 50
    while busy.written < enough:
        time.sleep(0.01)
    busy.stop()
    assert migration_state(old) == (known_revisions()[-1],) * 2
    assert busy.slowest_s < LONGEST_STALL_S


# SQLite has one writer: there a step waits for its turn like any other.
only_postgres = pytest.mark.parametrize(
    "database_url", [pytest.param("postgres", marks=pytest.mark.postgres)], indirect=True
)


@only_postgres
def test_a_long_transaction_delays_the_schema_and_nobody_else(
    old: Engine, database_url: str, writers: Callable[[], Writers]
) -> None:
    busy = writers()
    with old.connect() as long, ThreadPoolExecutor(1) as pool:
        long.execute(text("SELECT count(*) FROM job"))  # a report that somebody left open
        migration = pool.submit(migrate, database_url)
        time.sleep(6.0)
        assert not migration.done()
        long.rollback()
        migration.result(120)
    busy.stop()
    assert busy.written > 100
    assert busy.slowest_s < LONGEST_STALL_S
    assert migration_state(old) == (known_revisions()[-1],) * 2


@only_postgres
def test_giving_up_says_what_to_do_and_the_next_start_goes_on(
    old: Engine, database_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_module, "MIGRATION_PATIENCE_S", 1.0)
    with old.connect() as long:
        long.execute(text("SELECT count(*) FROM worker"))
        with pytest.raises(Unavailable, match="pg_stat_activity"):
            migrate(database_url)
    migrate(database_url)
    assert migration_state(old) == (known_revisions()[-1],) * 2
