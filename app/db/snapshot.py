"""The database as it was at one moment, and the schema as it was at one revision."""

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy import Connection, Engine

from app.db.engine import (
    alembic_config,
    begin_writing,
    migrate_job_engine,
    migration_lock,
    prepare_sqlite_file,
)
from app.errors import Conflict

__all__ = ["known_revisions", "made_at_once", "move_schema", "snapshot"]


@contextmanager
def snapshot(engine: Engine) -> Iterator[Connection]:
    """A connection to read with: it sees one moment, however long it reads, and nobody waits for it."""
    with engine.connect() as connection:
        if engine.dialect.name == "sqlite":
            connection.exec_driver_sql("BEGIN")  # deferred: the moment is that of the first read
        else:
            connection = connection.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)
        yield connection
        connection.rollback()


def known_revisions() -> list[str]:
    """The revisions of our schema that this version can make, oldest first."""
    from alembic.script import ScriptDirectory

    script = ScriptDirectory.from_config(alembic_config())
    return [each.revision for each in script.walk_revisions()][::-1]


@contextmanager
def made_at_once(engine: Engine) -> Iterator[Connection]:
    """A transaction in which the schema is made and filled: committed at the end of the block, or nothing of it.

    The job engine's own tables are made before. No other process migrates meanwhile.
    """
    prepare_sqlite_file(engine)
    with migration_lock(engine):
        migrate_job_engine(engine.url)
        with engine.connect() as connection:
            begin_writing(connection)
            yield connection
            connection.commit()


def move_schema(connection: Connection, revision: str) -> None:
    """Bring our schema from whatever revision to this one, up or down, in the connection's transaction.

    Raises Conflict where it is at a revision that this version does not know.
    """
    from alembic import command
    from alembic.runtime.migration import MigrationContext

    config = alembic_config()
    config.attributes["connection"] = connection
    known = known_revisions()
    at = MigrationContext.configure(connection).get_current_revision()
    if at is not None and at not in known:
        raise Conflict(f"the database is at schema {at}, which this program does not know: it is of a newer version")
    if at is not None and known.index(at) > known.index(revision):
        command.downgrade(config, revision)
    else:
        command.upgrade(config, revision)
