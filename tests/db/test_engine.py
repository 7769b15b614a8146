"""The schema by migration is the schema of the tables, up and down, on both databases."""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from sqlalchemy import Connection, Engine, event, inspect, select, text
from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from sqlalchemy.orm import Session, sessionmaker

import app.db.engine as engine_module
from app.db.engine import create_database_engine, downgrade, migrate, teach_old_sqlite
from app.db.tables import Base, Map, Organisation, Survey
from app.errors import InvalidInput

ROOT = Path(__file__).parents[2]
OURS = set(Base.metadata.tables) | {"alembic_version"}


def differences(connection: Connection) -> list[object]:
    def ours(_item: object, name: str | None, kind: str, reflected: bool, _other: object) -> bool:
        return not (kind == "table" and reflected and name not in OURS)

    options = {"include_object": ours, "compare_type": True, "compare_server_default": True}
    return compare_metadata(MigrationContext.configure(connection, opts=options), Base.metadata)


def test_migrated_schema_is_that_of_the_tables(engine: Engine) -> None:
    with engine.connect() as connection:
        assert differences(connection) == []


def test_no_table_but_ours_and_the_job_engines(engine: Engine) -> None:
    ours = {name for name in inspect(engine).get_table_names() if "workflow" not in name}
    assert ours >= OURS
    if engine.dialect.name == "postgresql":  # there the job engine has a schema of its own
        assert ours == OURS
        assert "workflow_status" in inspect(engine).get_table_names(schema="dbos")


def test_an_error_does_not_quote_what_was_written(engine: Engine) -> None:
    statement = text("INSERT INTO nowhere (position) VALUES (:position)")
    with engine.connect() as connection, pytest.raises(DBAPIError) as caught:
        connection.execute(statement, {"position": "12.345 m"})
    assert "INSERT INTO nowhere" in str(caught.value)
    assert "12.345" not in str(caught.value)


def test_a_database_that_does_not_answer_is_given_up_soon() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent, ThreadPoolExecutor(1) as pool:
        engine = create_database_engine(f"postgresql://somebody@127.0.0.1:{silent.getsockname()[1]}/somewhere")
        connecting = pool.submit(engine.connect)
        try:
            assert isinstance(connecting.exception(30.0), OperationalError)
        finally:
            silent.close()  # ends the attempt in any case


def test_an_address_may_say_how_long_a_database_is_waited_for() -> None:
    engine = create_database_engine("postgresql://somebody@127.0.0.1:1/somewhere?connect_timeout=2&tcp_user_timeout=9")
    asked: list[dict[str, object]] = []
    event.listen(engine, "do_connect", lambda *args: asked.append(args[3]))
    with pytest.raises(OperationalError):
        engine.connect()
    assert [asked[0][name] for name in ("connect_timeout", "tcp_user_timeout", "keepalives_idle")] == ["2", "9", 10]


def test_whoever_finds_every_connection_taken_is_told_soon(engine: Engine, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(engine_module, "POOL_TIMEOUT_S", 0.05)
    narrow = create_database_engine(engine.url.render_as_string(hide_password=False))
    with ExitStack() as held:
        for _ in range(narrow.pool.size() + narrow.pool._max_overflow):  # type: ignore[attr-defined]
            held.enter_context(narrow.connect())
        with pytest.raises(PoolTimeout):
            narrow.connect()
    narrow.dispose()


def test_down_and_up_again(engine: Engine, database_url: str) -> None:
    downgrade(database_url)
    assert not (set(inspect(engine).get_table_names()) & OURS - {"alembic_version"})
    migrate(database_url)
    migrate(engine)  # once more changes nothing
    with engine.connect() as connection:
        assert differences(connection) == []


def test_a_map_made_before_layers_stays_when_the_schema_grows_and_shrinks(fresh_url: str) -> None:
    def columns_of_map() -> set[str]:
        return {column["name"] for column in inspect(engine).get_columns("map")}

    migrate(fresh_url)
    engine = create_database_engine(fresh_url)
    downgrade(engine, "0001")
    assert not columns_of_map() & {"layers_sha256", "state_sha256"}
    rows = {  # the columns of that time, not those of today's classes
        "organisation": {"id": "o", "name": "o"},
        "building": {"id": "b", "organisation_id": "o", "name": "b"},
        "floor": {"id": "f", "organisation_id": "o", "building_id": "b", "name": "f", "ordinal": 0, "elevation_m": 0.0,
                  "auto_build": True, "claimed_generation": 0, "build_sequence": 1, "active_sequence": 1},
        "map": {"id": "m", "organisation_id": "o", "floor_id": "f", "status": "ready", "sequence": 1, "activate": True,
                "spec": "{}", "survey_ids": "[]", "grid_sha256": "0" * 64},
        "survey": {"id": "s", "organisation_id": "o", "floor_id": "f", "name": "s", "format": "csv",
                   "frame": "building", "raw_sha256": "1" * 64, "samples_sha256": "2" * 64, "sample_count": 7,
                   "report": '{"samples": 7}', "included": True},
    }  # fmt: skip
    with engine.begin() as connection:
        for table, row in rows.items():
            names = [*row, "created_at"]
            statement = f"INSERT INTO {table} ({', '.join(names)}) VALUES ({', '.join(f':{name}' for name in names)})"
            connection.execute(text(statement), row | {"created_at": "2026-01-01 00:00:00"})
    migrate(engine)
    with Session(engine) as session:
        row = session.get_one(Map, "m")
        assert (row.grid_sha256, row.layers_sha256, row.state_sha256) == ("0" * 64, None, None)
        survey = session.get_one(Survey, "s")
        assert (survey.report, survey.included, survey.sample_count) == ({"samples": 7}, True, 7)
        assert (survey.calibration_id, survey.excluded_s) == (None, None)
    downgrade(engine, "0001")
    migrate(engine)
    with engine.connect() as connection:
        assert differences(connection) == []
        assert connection.scalar(text("SELECT grid_sha256 FROM map")) == "0" * 64
    engine.dispose()


@pytest.fixture
def fresh_url(database_url: str, tmp_path: Path) -> Iterator[str]:
    """A database of this test's own: the module's is migrated already."""
    if database_url.startswith("sqlite"):
        yield f"sqlite:///{tmp_path / 'deep' / 'er' / 'isodyn.db'}"
        return
    name = f"{database_url.rsplit('/', 1)[1]}_fresh"
    server = create_database_engine(database_url).execution_options(isolation_level="AUTOCOMMIT")
    with server.connect() as connection:
        connection.execute(text(f"CREATE DATABASE {name}"))
    yield f"{database_url.rsplit('/', 1)[0]}/{name}"
    with server.connect() as connection:
        connection.execute(text(f"DROP DATABASE {name} WITH (FORCE)"))
    server.dispose()


def test_many_processes_may_migrate_at_once(fresh_url: str) -> None:
    code = f"from app.db.engine import migrate; migrate({fresh_url!r})"
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    starts = [subprocess.Popen([sys.executable, "-W", "error", "-c", code], env=environment) for _ in range(4)]
    assert [start.wait(60) for start in starts] == [0, 0, 0, 0]
    engine = create_database_engine(fresh_url)
    with engine.connect() as connection:
        assert differences(connection) == []
    engine.dispose()


def test_sqlite_keeps_what_it_acknowledges(sqlite_url: str) -> None:
    migrate(sqlite_url)
    engine = create_database_engine(sqlite_url)
    with engine.connect() as connection:
        pragma = {
            name: connection.exec_driver_sql(f"PRAGMA {name}").scalar()
            for name in ("journal_mode", "synchronous", "foreign_keys", "busy_timeout")
        }
    assert pragma == {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 30_000}
    engine.dispose()


def test_readers_do_not_wait_for_a_writer(sessions: sessionmaker[Session]) -> None:
    with sessions() as writer, sessions() as reader:
        writer.add(Organisation(name="being written"))
        writer.flush()
        assert reader.scalars(select(Organisation.name).where(Organisation.name == "being written")).all() == []
        writer.rollback()


def test_a_savepoint_set_first_belongs_to_the_transaction(sessions: sessionmaker[Session]) -> None:
    with sessions() as session:
        with session.begin_nested():
            session.add(Organisation(name="inside a savepoint"))
        session.rollback()
    with sessions() as session:
        assert session.scalar(select(Organisation).where(Organisation.name == "inside a savepoint")) is None


@pytest.mark.parametrize("url", ["sqlite://", "sqlite:///:memory:", "mysql://root@localhost/test"])
def test_addresses_that_are_not_offered_say_so(url: str) -> None:
    with pytest.raises(InvalidInput, match="database address"):
        create_database_engine(url)


def test_sqlite_knows_the_time_to_the_millisecond_whatever_its_version(sqlite_url: str) -> None:
    """Python 3.12 and newer may come with an SQLite that does not; the job engine stores such times as integers."""
    teach_old_sqlite()
    engine = create_database_engine(sqlite_url)
    with engine.connect() as connection:
        for _ in range(200):
            now_ms = connection.scalar(text("SELECT unixepoch('subsec') * 1000"))
            assert now_ms == int(now_ms)
            assert abs(now_ms / 1000 - time.time()) < 5.0
    engine.dispose()
