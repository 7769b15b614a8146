"""Restore a backup into an empty installation, of whatever database: all of it, or nothing.

Everything in the archive is checked first. Blobs come before the rows that name them; schema, rows, migrations and
the jobs that had not ended are one transaction. Killed before its end, what is left are blobs that nobody names.
"""

from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection, Engine, MetaData, func, inspect, literal, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from app.blobs import BlobStore
from app.db.engine import create_database_engine
from app.db.portable_rows import columns_of, insert_rows
from app.db.snapshot import known_revisions, made_at_once, move_schema
from app.db.tables import Base, Job
from app.errors import Conflict, CorruptArtefact, InvalidInput
from app.jobs.queue import FINAL_STATES, JobQueue
from app.services.backup_archive import ArchiveReader, Manifest, Progress

__all__ = ["Restored", "restore_backup"]


@dataclass(frozen=True, slots=True)
class Restored:
    """What is there now. `jobs`: those that had not ended, and begin anew; `missing`: blobs that the backup lacks."""

    manifest: Manifest
    rows: int
    blobs: int
    jobs: int
    missing: list[str]


def restore_backup(database_url: str, blobs: BlobStore, path: Path, progress: Progress) -> Restored:
    """Fill an empty database and a blob store from an archive.

    Raises NotFound, InvalidInput, CorruptArtefact for the archive; Conflict where the database is not empty. Then
    nothing was written but blobs that nobody names.
    """
    engine = create_database_engine(database_url)
    try:
        with ArchiveReader(path) as archive:
            manifest = archive.manifest
            _check_revision(manifest)
            if engine.dialect.name != "sqlite" or Path(str(engine.url.database)).exists():
                with engine.connect() as connection:
                    _check_empty(connection)
            archive.verify(progress)
            _put_blobs(archive, blobs, progress)
            rows, jobs = _fill(engine, archive, progress)
        return Restored(manifest, rows, len(archive.blobs), jobs, manifest.missing)
    finally:
        engine.dispose()


def _check_revision(manifest: Manifest) -> None:
    if manifest.revision not in known_revisions():
        raise InvalidInput(
            f"the backup was made by Isodyn {manifest.program} with schema {manifest.revision}, which this program "
            "does not know yet; restore it with that version or a newer one"
        )


def _check_empty(connection: Connection) -> None:
    """Raises Conflict where any table of ours has a row."""
    there = set(inspect(connection).get_table_names())
    for table in Base.metadata.sorted_tables:
        if table.name in there and connection.scalar(select(literal(1)).select_from(table).limit(1)) is not None:
            raise Conflict(
                f"the database is not empty (it has rows in `{table.name}`); a backup is restored into a new one only: "
                "set ISODYN_DATA_DIR to a new folder, or ISODYN_DATABASE_URL to a new database, where no server ran yet"
            )


def _put_blobs(archive: ArchiveReader, blobs: BlobStore, progress: Progress) -> None:
    for number, sha256 in enumerate(archive.blobs, 1):
        if blobs.put(archive.blob(sha256)) != sha256:
            raise CorruptArtefact(f"{archive.path}: blob {sha256} changed while it was read")
        progress("blobs", number, len(archive.blobs))


def _fill(engine: Engine, archive: ArchiveReader, progress: Progress) -> tuple[int, int]:
    """Schema, rows, migrations and jobs, in one transaction: how many rows, and jobs that had not ended."""
    queue = JobQueue(engine)
    try:
        with made_at_once(engine) as connection:
            _check_empty(connection)
            if queue.knows_jobs():
                raise Conflict("the database has jobs of another installation in its job engine; give a new database")
            move_schema(connection, archive.manifest.revision)
            rows = _insert(connection, archive, progress)
            progress("migrating", 0, 1)
            move_schema(connection, known_revisions()[-1])
            jobs = _begin_jobs_anew(connection, queue)
            progress("migrating", 1, 1)
        return rows, jobs
    finally:
        queue.close()


def _insert(connection: Connection, archive: ArchiveReader, progress: Progress) -> int:
    """Every table's rows, those that others refer to first. Raises CorruptArtefact, InvalidInput."""
    stored = archive.manifest.tables
    schema = MetaData()
    schema.reflect(connection, only=lambda name, _: name in stored)
    if absent := set(stored) - set(schema.tables):
        raise CorruptArtefact(f"{archive.path}: schema {archive.manifest.revision} has no table {', '.join(absent)}")
    total, done = sum(each.rows for each in stored.values()), 0
    for table in schema.sorted_tables:
        told = stored[table.name]
        if dict(told.columns) != dict(columns_of(table)):
            raise CorruptArtefact(
                f"{archive.path}: the columns of {table.name} are not those of schema {archive.manifest.revision}"
            )
        try:
            count = insert_rows(connection, table.name, told.columns, archive.lines(table.name))
        except (ValueError, SQLAlchemyError) as error:
            reason = str(getattr(error, "orig", None) or error).splitlines()[0][:300]
            raise InvalidInput(f"{archive.path}: the rows of {table.name} cannot be stored here: {reason}") from error
        if count != told.rows or connection.scalar(select(func.count()).select_from(table)) != count:
            raise CorruptArtefact(f"{archive.path}: {table.name} has {count} rows, its manifest says {told.rows}")
        done += count
        progress("rows", done, total)
    return done


def _begin_jobs_anew(connection: Connection, queue: JobQueue) -> int:
    """Jobs that waited or ran when the backup was made wait again, in the same order."""
    with Session(connection, join_transaction_mode="rollback_only") as session:
        open_jobs = session.scalars(select(Job).where(Job.status.not_in(FINAL_STATES)).order_by(Job.id)).all()
        for job in open_jobs:
            queue.enqueue_again(session, job, "the installation was restored from a backup")
        session.flush()
        return len(open_jobs)
