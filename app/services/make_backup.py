"""Make a backup while everything runs: rows of one moment, then every blob they name.

Blobs never change, so copying them after that moment is as good as in it. One that is gone by then was the state of an
earlier fit, or of something removed meanwhile and cleaned away; the manifest names it.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from alembic.runtime.migration import MigrationContext
from sqlalchemy import Connection, Engine, Table, func, select

from app import __version__
from app.blobs import BlobStore
from app.db.engine import migration_state
from app.db.portable_rows import columns_of, row_as_line, rows_of
from app.db.snapshot import snapshot
from app.db.tables import Base, TileChunk, Worker
from app.errors import Conflict, CorruptArtefact, NotFound
from app.services.backup_archive import ArchiveWriter, Manifest, Progress, StoredTable
from app.services.references import References, references

__all__ = ["LEFT_OUT", "Backup", "make_backup"]

LEFT_OUT = frozenset({Worker.__tablename__, TileChunk.__tablename__})
"""Tables that are of the running processes alone: the leases of workers, and the tiles that they share."""


@dataclass(frozen=True, slots=True)
class Backup:
    """What was written. `damaged`: needed blobs that are there and cannot be read; `gone`: those that are not there,
    `caches_gone`: of those that only save work."""

    rows: int
    blobs: int
    size_bytes: int
    damaged: list[str]
    gone: list[str]
    caches_gone: list[str]


def make_backup(engine: Engine, blobs: BlobStore, path: Path, progress: Progress) -> Backup:
    """Write an archive of all that the installation holds. Memory: one blob, and the names of all.

    Raises Conflict where the database is not of this version, or the file is there already; NotFound without a folder.
    """
    at, head = migration_state(engine)
    if at != head:
        raise Conflict(f"the database is at schema {at or 'none'}, this program at {head}: start `isodyn serve` once")
    manifest = Manifest(__version__, str(head), datetime.now(UTC).isoformat())
    with ArchiveWriter(path, manifest) as archive:
        with snapshot(engine) as connection:
            if MigrationContext.configure(connection).get_current_revision() != head:
                raise Conflict("the schema was changed at this moment; try again")
            _add_rows(connection, archive, manifest, progress)
            named = references(connection)
        damaged, gone, caches_gone = _add_blobs(archive, blobs, named, progress)
        manifest.missing = sorted([*damaged, *gone, *caches_gone])
    rows = sum(table.rows for table in manifest.tables.values())
    copied = len(named.all) - len(manifest.missing)
    return Backup(rows, copied, path.stat().st_size, damaged, gone, caches_gone)


def _add_rows(connection: Connection, archive: ArchiveWriter, manifest: Manifest, progress: Progress) -> None:
    tables = [each for each in Base.metadata.sorted_tables if each.name not in LEFT_OUT]
    counts = {each.name: connection.scalar(select(func.count()).select_from(each)) or 0 for each in tables}
    total, done = sum(counts.values()), 0
    for table in tables:
        archive.add(f"rows/{table.name}.ndjson", _lines(connection, table, done, total, progress), packed=True)
        manifest.tables[table.name] = StoredTable(columns_of(table), counts[table.name])
        done += counts[table.name]


def _lines(connection: Connection, table: Table, done: int, total: int, progress: Progress) -> Iterator[bytes]:
    columns = columns_of(table)
    for number, row in enumerate(rows_of(connection, table), 1):
        yield row_as_line(columns, row)
        progress("rows", done + number, total)


def _add_blobs(
    archive: ArchiveWriter, blobs: BlobStore, named: References, progress: Progress
) -> tuple[list[str], list[str], list[str]]:
    """Which were damaged, gone, and gone but only a cache."""
    damaged: list[str] = []
    gone: list[str] = []
    caches_gone: list[str] = []
    needed, every = named.all_needed, sorted(named.all)
    for number, sha256 in enumerate(every, 1):
        try:
            archive.add(f"blobs/{sha256}", [blobs.get(sha256)])
        except CorruptArtefact:
            (damaged if sha256 in needed else caches_gone).append(sha256)
        except NotFound:
            (gone if sha256 in needed else caches_gone).append(sha256)
        progress("blobs", number, len(every))
    return damaged, gone, caches_gone
