"""Killed at any moment, a backup or a restore leaves no half."""

import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import inspect

from app.db.tables import Base, Organisation
from app.services.backup_archive import ArchiveReader
from app.services.restore_backup import restore_backup

ROOT = Path(__file__).parents[2]
BACKUP = (
    "import sys; from pathlib import Path; from app.blobs import FolderBlobStore\n"
    "from app.db.engine import create_database_engine; from app.services.make_backup import make_backup\n"
    "url, blobs, path = sys.argv[1:]; print('ready', flush=True)\n"
    "make_backup(create_database_engine(url), FolderBlobStore(Path(blobs)), Path(path), lambda *_: None)\n"
)
RESTORE = (
    "import sys; from pathlib import Path; from app.blobs import FolderBlobStore; import dbos\n"
    "from app.services.restore_backup import restore_backup\n"
    "url, blobs, path = sys.argv[1:]; print('ready', flush=True)\n"
    "restore_backup(url, FolderBlobStore(Path(blobs)), Path(path), lambda *_: None)\n"
)


def start(code: str, *arguments: object) -> "subprocess.Popen[bytes]":
    child = subprocess.Popen(
        [sys.executable, "-W", "ignore", "-c", code, *map(str, arguments)], stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert child.stdout is not None
    child.stdout.readline()
    return child


def run_and_kill(code: str, after_s: float | None, *arguments: object) -> int:
    """Kill it that long after it began, if at all; its exit code, 0 when it was quicker."""
    child = start(code, *arguments)
    if after_s is not None:
        time.sleep(after_s)
        child.send_signal(signal.SIGKILL)
    assert child.stdout is not None
    child.stdout.close()
    return child.wait()


def grow(site: Any) -> None:
    """Enough rows and blobs that a kill comes in the middle."""
    with site.sessions.begin() as session:
        session.add_all([Organisation(name=f"organisation {number}") for number in range(4000)])


@pytest.mark.parametrize("rounds", [2, pytest.param(25, marks=pytest.mark.slow)])
def test_kill_9_in_the_middle_of_a_backup(site: Any, tmp_path: Path, rounds: int) -> None:
    grow(site)
    folder = tmp_path / "archives"
    folder.mkdir()
    began = time.monotonic()
    assert run_and_kill(BACKUP, None, site.url, site.blobs._folder, folder / "whole.zip") == 0
    took_s = time.monotonic() - began
    dice = random.Random(0)
    for number in range(rounds):
        path = folder / f"{number}.zip"
        run_and_kill(BACKUP, dice.uniform(0.0, 0.5) * took_s, site.url, site.blobs._folder, path)
        if path.exists():
            with ArchiveReader(path) as archive:
                archive.verify(lambda *_: None)
    assert all(path.suffix == ".zip" or path.name.endswith(".partial") for path in folder.iterdir())


@pytest.mark.parametrize(
    ("kind", "rounds"),
    [
        ("sqlite", 2),
        pytest.param("sqlite", 20, marks=pytest.mark.slow),
        pytest.param("postgres", 20, marks=[pytest.mark.slow, pytest.mark.postgres]),
    ],
)
def test_kill_9_in_the_middle_of_a_restore(
    kind: str, rounds: int, site: Any, new_url: Callable[[str], str], open_site: Callable[..., Any], tmp_path: Path
) -> None:
    grow(site)
    archive, blobs = tmp_path / "whole.zip", tmp_path / "new blobs"
    site.back_up(archive)
    dice, url = random.Random(1), new_url(kind)
    for _ in range(rounds):
        code = run_and_kill(RESTORE, dice.uniform(0.05, 1.2), url, blobs, archive)
        if kind == "sqlite" and not Path(url.removeprefix("sqlite:///")).exists():
            continue
        there = open_site(url, blobs)
        tables = set(inspect(there.engine).get_table_names()) & set(Base.metadata.tables)
        if code == 0 or tables:
            assert len(there.rows()["organisation"]) == 4001, "all or nothing"
            url = new_url(kind)
    if not tables:
        restore_backup(url, there.blobs, archive, lambda *_: None)
        assert len(there.rows()["organisation"]) == 4001
