"""The database: SQLite in a file by default, PostgreSQL by URL, the same code on both.

SQLite: every write transaction begins IMMEDIATE, so it never fails half-way because somebody else wrote in between;
a plain SELECT takes no transaction and waits for nobody (WAL). Reads therefore behave as PostgreSQL's READ COMMITTED.
"""

import logging
import sqlite3
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import Connection, Engine, create_engine, event, func, make_url, select, text
from sqlalchemy.engine import URL
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session, sessionmaker

from app.db.traced import trace_statements
from app.errors import InvalidInput, Unavailable

if TYPE_CHECKING:
    from alembic.config import Config

__all__ = [
    "alembic_config",
    "begin_writing",
    "create_database_engine",
    "downgrade",
    "let_go_of_the_dead",
    "lock_for_transaction",
    "migrate",
    "migrate_job_engine",
    "migration_lock",
    "migration_state",
    "prepare_sqlite_file",
    "session_factory",
    "teach_old_sqlite",
]

BUSY_TIMEOUT_S = 30.0
LOCK_TIMEOUT, STATEMENT_TIMEOUT = "2s", "30s"
MIGRATION_PATIENCE_S = 300.0
LOCKED_OUT = (
    f"for {MIGRATION_PATIENCE_S:.0f} s other transactions held a table it changes. Nothing is lost: end the long ones "
    "(PostgreSQL's view pg_stat_activity has each with its xact_start and query), and start again"
)
DEAD_CLIENT = {  # the last is for an answer on its way, where nothing is probed
    "tcp_keepalives_idle": "10s", "tcp_keepalives_interval": "5s", "tcp_keepalives_count": 3, "tcp_user_timeout": "25s",
}  # fmt: skip
DEAD_SERVER = {
    "connect_timeout": 5, "keepalives_idle": 10, "keepalives_interval": 5, "keepalives_count": 3,
    "tcp_user_timeout": 15_000,
}  # fmt: skip
"""A server that was cut off is given up within seconds, unless its address says otherwise. The last is in ms."""
POOL_TIMEOUT_S = 5.0
HELD_UP = ("55P03", "57014", "40P01")  # PostgreSQL: lock not available, statement timeout, deadlock
MIGRATION_LOCK = 0x150D_11  # any constant of our own: PostgreSQL's advisory locks are numbers


log = logging.getLogger(__name__)


def create_database_engine(url: str) -> Engine:
    """An engine for `sqlite:///file` or `postgresql+psycopg://`. Raises InvalidInput for any other address.

    Its errors end up in the log, and quote statements without their values: these may say where somebody was.
    """
    parsed = _checked(url)
    if parsed.get_backend_name() == "postgresql":
        engine = create_engine(
            parsed, pool_pre_ping=True, pool_size=5, max_overflow=15, pool_recycle=1800, pool_timeout=POOL_TIMEOUT_S,
            hide_parameters=True,
            connect_args={name: value for name, value in DEAD_SERVER.items() if name not in parsed.query},
        )  # fmt: skip
        trace_statements(engine)
        event.listen(engine, "connect", let_go_of_the_dead)
        return engine
    engine = create_engine(
        parsed,
        pool_size=10,
        max_overflow=30,
        pool_timeout=POOL_TIMEOUT_S,
        hide_parameters=True,
        connect_args={"timeout": BUSY_TIMEOUT_S, "isolation_level": "IMMEDIATE", "check_same_thread": False},
    )
    event.listen(engine, "connect", _prepare_sqlite_connection)
    event.listen(engine, "savepoint", _begin_before_savepoint)
    trace_statements(engine)
    return engine


def let_go_of_the_dead(connection: Any, _record: object) -> None:
    """Listener: PostgreSQL ends a transaction, and its locks, 25 s after its client was cut off, not hours."""
    if not isinstance(connection, sqlite3.Connection):
        for name, value in DEAD_CLIENT.items():
            connection.execute(f"SET {name} = '{value}'")
        connection.commit()


def session_factory(engine: Engine) -> sessionmaker[Session]:
    """Sessions whose objects stay readable after commit."""
    return sessionmaker(engine, expire_on_commit=False)


def migrate(database: Engine | str) -> None:
    """Bring the schema, ours and the job engine's, to this version.

    Several processes may call this at once: one migrates, the others wait and find it done. Others may read and write
    meanwhile: on PostgreSQL no step waits for a lock longer than `LOCK_TIMEOUT`, because everybody else would wait
    behind it; it is tried again. Raises Unavailable where a table stayed locked for `MIGRATION_PATIENCE_S`.
    """
    with _engine_of(database) as engine:
        prepare_sqlite_file(engine)
        with migration_lock(engine):
            for revision in _revisions_to_come(engine):
                _upgrade_patiently(engine, revision)
            migrate_job_engine(engine.url)


def downgrade(database: Engine | str, revision: str = "base") -> None:
    """Take our schema back to `revision`; the job engine's own tables stay."""
    with _engine_of(database) as engine, migration_lock(engine):
        _downgrade(engine, revision)


def migration_state(engine: Engine) -> tuple[str | None, str | None]:
    """The revision our schema is at, and the newest one this version knows."""
    from alembic.runtime.migration import MigrationContext
    from alembic.script import ScriptDirectory

    with engine.connect() as connection:
        at = MigrationContext.configure(connection).get_current_revision()
    return at, ScriptDirectory.from_config(alembic_config()).get_current_head()


def alembic_config() -> "Config":
    """Where Alembic finds the migrations, wherever this is installed."""
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(resources.files("migrations")).replace("%", "%%"))
    return config


def begin_writing(connection: Connection) -> None:
    """Begin a transaction that may change the schema, too."""
    if connection.dialect.name == "sqlite":
        connection.exec_driver_sql("BEGIN IMMEDIATE")
    else:
        connection.begin()


def _checked(url: str) -> URL:
    parsed = make_url(url)
    if parsed.get_backend_name() == "postgresql":
        return parsed.set(drivername="postgresql+psycopg")
    if parsed.get_backend_name() != "sqlite":
        raise InvalidInput(
            f"database address {parsed.render_as_string()!r}: {parsed.get_backend_name()} is not offered; "
            "use sqlite:///FILE or postgresql+psycopg://USER@HOST/NAME"
        )
    if parsed.database in (None, "", ":memory:"):
        raise InvalidInput("database address 'sqlite://': the worker is another process and needs a file; name one")
    return parsed


@contextmanager
def _engine_of(database: Engine | str) -> Iterator[Engine]:
    if isinstance(database, Engine):
        yield database
        return
    engine = create_database_engine(database)
    try:
        yield engine
    finally:
        engine.dispose()


def _unixepoch(modifier: str) -> float | None:
    """`unixepoch('subsec')` of SQLite 3.42: the seconds since 1970, such that a thousand times it is whole."""
    if modifier != "subsec":
        return None
    milliseconds = int(time.time() * 1000)
    while (milliseconds / 1000) * 1000 != milliseconds:
        milliseconds -= 1
    return milliseconds / 1000


def teach_old_sqlite() -> None:
    """Give SQLite before 3.42 the clock that the job engine asks it for, in every engine of this process.

    The job engine goes by Python's version, not SQLite's: on Python 3.12 with an older SQLite (Debian 12) its
    timestamps would be NULL. It makes engines of its own, hence all of them.
    """
    if sqlite3.sqlite_version_info < (3, 42) and not event.contains(Engine, "connect", _add_unixepoch):
        event.listen(Engine, "connect", _add_unixepoch)


def _add_unixepoch(connection: object, _record: object) -> None:
    if isinstance(connection, sqlite3.Connection):
        connection.create_function("unixepoch", 1, _unixepoch)


def _prepare_sqlite_connection(connection: sqlite3.Connection, _record: object) -> None:
    # FULL: an acknowledged commit survives a power cut, also in WAL.
    for pragma in ("foreign_keys = ON", f"busy_timeout = {int(BUSY_TIMEOUT_S * 1000)}", "synchronous = FULL"):
        connection.execute(f"PRAGMA {pragma}")


def lock_for_transaction(session: Session, number: int) -> None:
    """Until the transaction ends no other one gets past here with the same number. SQLite has one writer anyway."""
    connection = session.connection()
    if connection.dialect.name == "sqlite":
        _begin_immediate(connection)
    else:
        connection.execute(select(func.pg_advisory_xact_lock(number)))


def _begin_before_savepoint(connection: Connection, _name: str) -> None:
    # sqlite3 begins before INSERT, UPDATE and DELETE only: a savepoint set first would be a transaction of its own,
    # and releasing it would commit.
    _begin_immediate(connection)


def _begin_immediate(connection: Connection) -> None:
    """Become SQLite's writer, where this transaction is not yet."""
    driver = connection.connection.driver_connection
    if isinstance(driver, sqlite3.Connection) and not driver.in_transaction:
        connection.exec_driver_sql("BEGIN IMMEDIATE")


def prepare_sqlite_file(engine: Engine) -> None:
    """Make the folder, and set write-ahead logging once: it persists in the file."""
    if engine.dialect.name != "sqlite":
        return
    Path(str(engine.url.database)).parent.mkdir(parents=True, exist_ok=True)
    deadline = time.monotonic() + BUSY_TIMEOUT_S
    while True:
        try:
            with engine.connect() as connection:
                connection.exec_driver_sql("PRAGMA journal_mode = WAL")
            return
        except OperationalError:  # the switch itself does not wait for other processes
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


@contextmanager
def migration_lock(engine: Engine) -> Iterator[None]:
    """PostgreSQL: one migration at a time. SQLite: the write transaction of each step is lock enough."""
    if engine.dialect.name == "sqlite":
        yield
        return
    with engine.connect().execution_options(isolation_level="AUTOCOMMIT") as connection:
        # Polled, and in no transaction: the job engine builds indexes CONCURRENTLY, which waits for every open
        # snapshot, also that of a process blocked inside pg_advisory_lock.
        while not connection.scalar(text("SELECT pg_try_advisory_lock(:n)"), {"n": MIGRATION_LOCK}):
            time.sleep(0.1)
        try:
            yield
        finally:
            connection.execute(text("SELECT pg_advisory_unlock(:n)"), {"n": MIGRATION_LOCK})


def _revisions_to_come(engine: Engine) -> list[str]:
    """The revisions this version knows and the schema has not, oldest first; of a newer schema, none."""
    from alembic.script import ScriptDirectory

    at, _ = migration_state(engine)
    known = [each.revision for each in ScriptDirectory.from_config(alembic_config()).walk_revisions()][::-1]
    if at is not None and at not in known:
        return []
    return known[known.index(at) + 1 :] if at is not None else known


def _upgrade_patiently(engine: Engine, revision: str) -> None:
    """One step, tried again for a while where a table is locked: a long transaction of somebody else."""
    deadline, wait_s = time.monotonic() + MIGRATION_PATIENCE_S, 0.5
    while True:
        try:
            return _upgrade(engine, revision)
        except OperationalError as error:
            if getattr(error.orig, "sqlstate", None) not in HELD_UP:
                raise
            if time.monotonic() + wait_s > deadline:
                raise Unavailable(f"the database could not be brought to schema {revision}: {LOCKED_OUT}") from error
            log.warning("schema %s waits %.1f s for a lock that somebody holds", revision, wait_s)
            time.sleep(wait_s)
            wait_s = min(2.0 * wait_s, 10.0)


def _upgrade(engine: Engine, revision: str) -> None:
    """SQLite: in a transaction begun here. PostgreSQL: in Alembic's, which a step may leave (`migrations.steps`)."""
    from alembic import command

    from migrations.steps import WHILE_OTHERS_WRITE

    config = alembic_config()
    config.attributes[WHILE_OTHERS_WRITE] = True
    with engine.connect() as connection:
        if engine.dialect.name == "postgresql":
            connection.exec_driver_sql(f"SET lock_timeout = '{LOCK_TIMEOUT}'")
            connection.exec_driver_sql(f"SET statement_timeout = '{STATEMENT_TIMEOUT}'")
            connection.commit()
        else:
            begin_writing(connection)
        config.attributes["connection"] = connection
        try:
            command.upgrade(config, revision)
            connection.commit()
        finally:
            connection.invalidate()  # not back into the pool: the timeouts go with it


def _downgrade(engine: Engine, revision: str) -> None:
    from alembic import command

    config = alembic_config()
    with engine.connect() as connection:
        begin_writing(connection)
        config.attributes["connection"] = connection
        command.downgrade(config, revision)
        connection.commit()


def migrate_job_engine(url: URL) -> None:
    """Make the job engine's tables, or bring them to its version; under the `migration_lock`."""
    from dbos import DBOS

    teach_old_sqlite()
    DBOS.migrate(url.render_as_string(hide_password=False))
