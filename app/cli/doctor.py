"""`isodyn doctor`: what is wrong with this installation, and what to do about it."""

import os
import shutil
import socket
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.table import Table

from app.cli.environment import read_settings
from app.cli.finding import Finding
from app.errors import InvalidInput, IsodynError, Unavailable
from app.settings import Settings

__all__ = ["doctor", "examine"]

LOW_DISK_BYTES = 2**30


def doctor(
    deep: Annotated[bool, typer.Option("--deep", help="also read every blob, which may take long")] = False,
) -> None:
    """Look at Python, disk, database, blobs, worker and port; say what is wrong and what to do."""
    settings = read_settings()
    findings = examine(settings)
    if deep:
        from app.cli.deep_look import examine_blobs

        findings += examine_blobs(settings)
    table = Table("", "what", "seen", "what to do", show_lines=False)
    marks = {True: "[green]ok[/green]", None: "[yellow]note[/yellow]", False: "[red]wrong[/red]"}
    for finding in findings:
        table.add_row(marks[finding.ok], finding.what, finding.seen, finding.advice)
    Console().print(table)
    if any(finding.ok is False for finding in findings):
        raise typer.Exit(1)


def examine(settings: Settings) -> list[Finding]:
    """Every finding; a check that itself fails is a finding, never a traceback."""
    checks: list[tuple[str, Callable[[Settings], Iterator[Finding]]]] = [
        ("python", _python),
        ("data folder", _data_folder),
        ("database", _database),
        ("blob store", _blobs),
        ("port", _port),
    ]
    findings: list[Finding] = []
    for what, check in checks:
        try:
            findings += check(settings)
        except Exception as error:
            findings.append(Finding(what, False, f"{type(error).__name__}: {str(error).splitlines()[0][:200]}"))
    return findings


def _python(_: Settings) -> Iterator[Finding]:
    version = sys.version.split()[0]
    yield Finding("python", sys.version_info >= (3, 11), version, "" if sys.version_info >= (3, 11) else "use 3.11+")
    cores = os.cpu_count() or 1
    yield Finding("cores", True if cores > 1 else None, str(cores), "" if cores > 1 else "fits and answers share one")


def _data_folder(settings: Settings) -> Iterator[Finding]:
    folder = settings.data_dir.resolve()
    if not folder.exists():
        yield Finding("data folder", None, f"{folder} does not exist yet", "`isodyn serve` makes it")
        return
    writable = os.access(folder, os.W_OK)
    yield Finding("data folder", writable, str(folder), "" if writable else "give this user the right to write there")
    free = shutil.disk_usage(folder).free
    roomy = free > LOW_DISK_BYTES
    yield Finding("disk", roomy, f"{free / 2**30:.1f} GiB free", "" if roomy else "make room: uploads will fail")


def _database(settings: Settings) -> Iterator[Finding]:
    from sqlalchemy import select

    from app.db.engine import create_database_engine, migration_state, session_factory
    from app.db.tables import Job, Key, Worker, utc_now
    from app.jobs.lease import FRESH_BEAT_S

    url = settings.resolved_database_url
    if url.startswith("sqlite:///") and not Path(url.removeprefix("sqlite:///")).exists():
        yield Finding("database", None, "not made yet", "`isodyn serve` makes it")
        return
    engine = create_database_engine(url)
    try:
        at, head = migration_state(engine)
        advice = "" if at == head else "`isodyn serve` brings it up to date"
        yield Finding("database", at == head, f"{engine.dialect.name}, schema {at or 'none'} of {head}", advice)
        if at != head:
            return
        with session_factory(engine).begin() as session:
            keys = len(session.scalars(select(Key.id).where(Key.revoked_at.is_(None))).all())
            yield Finding("keys", True if keys else None, f"{keys} live", "" if keys else "`isodyn keys create`")
            beats = session.scalars(select(Worker.beat).where(Worker.state == "live")).all()
            waiting = len(session.scalars(select(Job.id).where(Job.status == "accepted")).all())
            fresh = [beat for beat in beats if (utc_now() - beat).total_seconds() < FRESH_BEAT_S]
            seen = f"{len(fresh)} alive, {waiting} jobs waiting"
            stuck = waiting > 0 and not fresh
            yield Finding("workers", False if stuck else (True if fresh else None), seen,
                          "" if fresh else "start `isodyn serve` or `isodyn worker`")  # fmt: skip
    finally:
        engine.dispose()


def _blobs(settings: Settings) -> Iterator[Finding]:
    from app.blobs import open_blob_store

    if settings.blob_url is None and not settings.data_dir.exists():
        return
    url = settings.resolved_blob_url
    try:
        store = open_blob_store(url, make=False)
        sha256 = store.put(b"isodyn doctor " + os.urandom(8))  # nobody else's, and can go again
        store.get(sha256)
        store.discard(sha256)
    except Unavailable as error:
        no_folder = url.startswith("file:") and isinstance(error.__cause__, FileNotFoundError)
        if no_folder and not _names_blobs(settings):
            advice = (
                "`isodyn serve` makes that of a new installation; of another, mount its disk or correct the settings"
            )
            yield Finding("blob store", None, f"{url}: there is no such folder", advice)
            return
        cause = str(error.__cause__).splitlines()[0][:400]
        yield Finding("blob store", False, f"{url}: {cause}", str(error))
        return
    except InvalidInput as error:
        yield Finding("blob store", False, "no address of a blob store", str(error))
        return
    yield Finding("blob store", True, f"{url}: written, read and cleaned")


def _names_blobs(settings: Settings) -> bool:
    """Whether there is a database that can be read, and a row in it names a blob."""
    from sqlalchemy.exc import SQLAlchemyError

    from app.cli.installation import open_installation
    from app.services.references import references

    try:
        with open_installation(settings) as here, here.sessions() as session:
            return bool(references(session).all)
    except (IsodynError, SQLAlchemyError):  # a finding of its own
        return False


def _port(settings: Settings) -> Iterator[Finding]:
    with socket.socket() as probe:
        taken = probe.connect_ex((settings.host, settings.port)) == 0
    seen = f"{settings.host}:{settings.port} " + ("answers" if taken else "free")
    yield Finding("port", None if taken else True, seen, "a server runs there already" if taken else "")
