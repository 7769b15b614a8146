"""The installation that a command works on, without a server: its database, blobs and jobs; and a bar of progress."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeElapsedColumn
from sqlalchemy import Engine, make_url
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import BlobStore, open_blob_store
from app.db.engine import create_database_engine, migration_state, session_factory
from app.errors import Conflict, NotFound
from app.jobs.queue import JobQueue
from app.services.backup_archive import Progress as Report
from app.settings import Settings

__all__ = ["Installation", "open_installation", "progress_bar"]

EVERY_S = 0.1


@dataclass(frozen=True, slots=True)
class Installation:
    engine: Engine
    sessions: sessionmaker[Session]
    blobs: BlobStore
    queue: JobQueue


@contextmanager
def open_installation(settings: Settings) -> Iterator[Installation]:
    """What the settings name; a blob folder that is not there is not made. Raises NotFound where there is no database,
    Conflict where its schema is of another version."""
    url = make_url(settings.resolved_database_url)
    if url.get_backend_name() == "sqlite" and not Path(str(url.database)).exists():
        raise NotFound(f"there is no database {url.database}: is ISODYN_DATA_DIR the folder of the installation?")
    engine = create_database_engine(settings.resolved_database_url)
    try:
        at, head = migration_state(engine)
        if at != head:
            raise Conflict(
                f"the database is at schema {at or 'none'}, this program at {head}: start `isodyn serve` once"
            )
        queue = JobQueue(engine)
        try:
            blobs = open_blob_store(settings.resolved_blob_url, make=False)
            yield Installation(engine, session_factory(engine), blobs, queue)
        finally:
            queue.close()
    finally:
        engine.dispose()


@contextmanager
def progress_bar() -> Iterator[Report]:
    """A bar for each thing that is done, in the terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as shown:
        tasks: dict[str, TaskID] = {}
        shown_s = 0.0

        def report(what: str, done: int, total: int) -> None:
            nonlocal shown_s
            if what not in tasks:
                tasks[what] = shown.add_task(what, total=total)
            elif done < total and monotonic() - shown_s < EVERY_S:  # told of every row
                return
            shown_s = monotonic()
            shown.update(tasks[what], completed=done, total=total)

        yield report
