"""The lease: a dead worker has one heir, a living one is left alone, a lost lease is known to its holder."""

import sqlite3
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any
from uuid import uuid4

import pytest
from sqlalchemy import Engine, event, select, text, update

from app.db.tables import Worker
from app.jobs.lease import LONG_AGO, Lease

MakeLease = Callable[..., Lease]


@pytest.fixture
def lease(engine: Engine) -> Iterator[MakeLease]:
    made: list[Lease] = []

    def make(ttl_s: float = 600.0) -> Lease:
        made.append(Lease(engine, f"worker-{uuid4().hex}", ttl_s))
        made[-1].start()
        return made[-1]

    yield make
    for each in made:
        each.release(unfinished=False)


def row(engine: Engine, lease: Lease) -> tuple[str, str | None] | None:
    with engine.connect() as connection:
        found = connection.execute(select(Worker.state, Worker.reaper).where(Worker.id == lease.worker_id)).first()
    return None if found is None else (found.state, found.reaper)


def silence(engine: Engine, lease: Lease) -> None:
    with engine.begin() as connection:
        connection.execute(update(Worker).where(Worker.id == lease.worker_id).values(beat=LONG_AGO))


def test_the_living_are_left_alone(engine: Engine, lease: MakeLease) -> None:
    worker, other = lease(), lease()
    assert other.take_over_from_dead() == []
    assert worker.beat()
    assert not worker.is_lost
    assert row(engine, worker) == ("live", None)


def test_the_clock_is_the_databases_and_beating_renews(engine: Engine, lease: MakeLease) -> None:
    """Beats come every 0.2 s; looked at after longer than the time to live, the worker is still alive."""
    worker, other = lease(ttl_s=0.8), lease(ttl_s=0.8)
    time.sleep(1.2)
    assert worker.worker_id not in other.take_over_from_dead()
    worker.release(unfinished=False)
    assert row(engine, worker) is None


def test_a_dead_worker_has_one_heir(engine: Engine, lease: MakeLease) -> None:
    dead, heirs = lease(), [lease() for _ in range(6)]
    silence(engine, dead)
    with ThreadPoolExecutor(6) as pool:
        taken = list(pool.map(lambda heir: dead.worker_id in heir.take_over_from_dead(), heirs))
    assert sum(taken) == 1
    heir = heirs[taken.index(True)]
    assert row(engine, dead) == ("dead", heir.worker_id)
    assert not dead.beat()
    assert dead.is_lost
    heir.bury(dead.worker_id)
    assert row(engine, dead) is None


def test_an_heir_that_dies_too_is_succeeded(engine: Engine, lease: MakeLease) -> None:
    dead, first, second = lease(), lease(), lease()
    silence(engine, dead)
    assert first.take_over_from_dead() == [dead.worker_id]
    assert second.take_over_from_dead() == []
    silence(engine, dead)
    assert second.take_over_from_dead() == [dead.worker_id]
    first.bury(dead.worker_id)  # too late: it is not the heir any more
    assert row(engine, dead) == ("dead", second.worker_id)
    second.bury(dead.worker_id)


def test_leaving_jobs_behind_they_are_taken_over_at_once(engine: Engine, lease: MakeLease) -> None:
    leaver, heir = lease(), lease()
    leaver.release(unfinished=True)
    assert not leaver.is_lost
    assert heir.take_over_from_dead() == [leaver.worker_id]


@pytest.fixture
def clock(engine: Engine) -> Iterator[Callable[[float], None]]:
    """Sets the database's clock by so many seconds, as connections made from now on see it."""
    shift_s = 0.0

    def strftime(form: str, *modifiers: str) -> str:
        return str(plain.execute(f"SELECT strftime(?, {', '.join('?' * len(modifiers))}, ?)",
                                 (form, *modifiers, f"{shift_s:+.3f} seconds")).fetchone()[0])  # fmt: skip

    def on_connect(connection: Any, _record: object) -> None:
        if engine.dialect.name == "sqlite":
            connection.create_function("strftime", -1, strftime)
        else:
            connection.execute("SET search_path = shifted, pg_catalog, public")
            connection.commit()

    def shift(by_s: float) -> None:
        nonlocal shift_s
        shift_s = by_s
        if engine.dialect.name == "postgresql":
            body = f"SELECT pg_catalog.clock_timestamp() + interval '{by_s} seconds'"
            with engine.begin() as connection:
                connection.execute(text(f"CREATE OR REPLACE FUNCTION shifted.clock_timestamp() RETURNS timestamptz "
                                        f"LANGUAGE sql AS $$ {body} $$"))  # fmt: skip

    plain = sqlite3.connect(":memory:", check_same_thread=False)
    if engine.dialect.name == "postgresql":
        with engine.begin() as connection:
            connection.execute(text("CREATE SCHEMA IF NOT EXISTS shifted"))
    shift(0.0)
    event.listen(engine, "connect", on_connect)
    engine.dispose()
    yield shift
    event.remove(engine, "connect", on_connect)
    engine.dispose()
    plain.close()


@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_a_clock_that_is_set_costs_at_most_a_restart_and_hides_no_death(
    engine: Engine, lease: MakeLease, clock: Callable[[float], None], step_s: float
) -> None:
    dead, heir = lease(ttl_s=1.0), lease(ttl_s=1.0)
    dead._stopping.set()
    clock(step_s)
    worker = lease(ttl_s=1.0)  # restarted, where the step cost it its life
    taken: list[str] = []
    deadline = time.monotonic() + 20.0
    while dead.worker_id not in taken:
        assert time.monotonic() < deadline
        taken += heir.take_over_from_dead()
        time.sleep(0.1)
    for _ in range(20):  # twice the time to live
        taken += heir.take_over_from_dead()
        time.sleep(0.1)
    assert worker.worker_id not in taken
    assert worker.beat()


def test_without_a_beat_for_the_time_to_live_it_is_lost(engine: Engine) -> None:
    lease = Lease(engine, "never started", 0.05)
    assert not lease.is_lost
    time.sleep(0.1)
    assert lease.is_lost
