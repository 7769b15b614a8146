"""`isodyn backup`, `isodyn restore` and `isodyn clean`, on the database and the blobs themselves."""

from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from app.cli.environment import read_settings, say_refusals
from app.cli.times import read_duration

__all__ = ["backup", "clean", "restore"]

SHORTEST = timedelta(hours=1)


def backup(
    to: Annotated[Path, typer.Argument(help="file to write, or a folder for a file with the time in its name")],
) -> None:
    """Write everything this installation holds into one file, while the server runs.

    It can be restored into SQLite and PostgreSQL alike: docs/backup.md.
    """
    from app.cli.installation import open_installation, progress_bar
    from app.services.make_backup import make_backup

    path = to / f"isodyn-{datetime.now(UTC):%Y%m%dT%H%M%SZ}.zip" if to.is_dir() else to
    console = Console(stderr=True, highlight=False, soft_wrap=True)
    with say_refusals(), open_installation(read_settings()) as here, progress_bar() as progress:
        made = make_backup(here.engine, here.blobs, path, progress)
    print(f"{path}: {made.rows:,} rows, {made.blobs:,} blobs, {made.size_bytes:,} bytes")
    if made.caches_gone:
        console.print(f"left out: {len(made.caches_gone)} states of fits that are gone; the next builds are full ones")
    for blobs, what in ((made.damaged, "damaged"), (made.gone, "not there")):
        if blobs:
            console.print(f"[red]{len(blobs)} blobs are {what}[/red] and not in the backup: see `isodyn doctor --deep`")
    if made.damaged or made.gone:
        raise typer.Exit(1)


def restore(
    archive: Annotated[Path, typer.Argument(help="a file that `isodyn backup` wrote")],
) -> None:
    """Fill a new installation, where ISODYN_DATA_DIR and ISODYN_DATABASE_URL say, from a backup.

    The database must be empty: nothing is ever overwritten. All of it is restored, or nothing.
    """
    from app.blobs import open_blob_store
    from app.cli.installation import progress_bar
    from app.services.restore_backup import restore_backup

    settings = read_settings()
    with say_refusals(), progress_bar() as progress:
        settings.data_dir.mkdir(parents=True, exist_ok=True)
        blobs = open_blob_store(settings.resolved_blob_url)
        made = restore_backup(settings.resolved_database_url, blobs, archive, progress)
    print(f"{archive}, of {made.manifest.created_at[:19]}Z: {made.rows:,} rows, {made.blobs:,} blobs")
    if made.jobs:
        print(f"{made.jobs} jobs that had not ended begin anew when a worker runs")
    if made.missing:
        print(f"{len(made.missing)} blobs were missing when the backup was made: see `isodyn doctor --deep`")


def clean(
    older_than: Annotated[str, typer.Option(help="only what was last stored longer ago than this: 90m, 24h, 7d")] = (
        "24h"
    ),
    dry_run: Annotated[bool, typer.Option("--dry-run", help="say what would be deleted, and delete nothing")] = False,
    even_most: Annotated[bool, typer.Option("--even-most", help="also where that is most of the store")] = False,
) -> None:
    """Delete the blobs that nothing names any more: of deleted surveys, former plans, uploads that broke off."""
    from app.cli.installation import open_installation, progress_bar
    from app.services.clean_blobs import clean_blobs

    age = _duration(older_than)
    with say_refusals(), open_installation(read_settings()) as here, progress_bar() as progress:
        done = clean_blobs(here.sessions, here.queue, here.blobs, age, dry_run, progress, even_most)
    verb = "would be deleted" if dry_run else "deleted"
    print(f"{done.blobs:,} blobs {verb}, {done.size_bytes:,} bytes; {done.kept:,} that nothing names are younger")


def _duration(told: str) -> timedelta:
    """Raises BadParameter for what is no duration, and for one shorter than an upload may take."""
    age = read_duration(told)
    if age < SHORTEST:
        raise typer.BadParameter(f"{told} is too short: an upload at work has stored blobs that it names soon; use 1h+")
    return age
