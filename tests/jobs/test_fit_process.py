"""A fit in its child process, without a worker around it."""

import json
import os
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest

from app.blobs import open_blob_store
from app.errors import Unavailable
from app.telemetry.facts import with_facts
from workers.fit_process import FitFailed, FitProcessDied, FitProcesses


def quiet(fraction: float, message: str) -> None:
    """Progress that nobody follows."""


@pytest.fixture
def blobs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """The address of a blob store; the diary lies beside it."""
    monkeypatch.setenv("ISODYN_TEST_DIARY", str(tmp_path / "diary"))
    address = f"file://{tmp_path / 'blobs'}"
    open_blob_store(address)
    return address


def test_a_child_that_did_well_is_kept_for_the_next_fit_and_another_is_not(tmp_path: Path, blobs: str) -> None:
    fits = FitProcesses()
    plan = {"floor_id": "f", "map_id": "m", "surveys": [], "sleep_s": 0.05}
    large = np.ones(2**27)  # 1 GiB of ours is not the child's
    for orders in ({}, {}, {"fail": True}, {}):
        with nullcontext() if not orders else pytest.raises(FitFailed, match="walk the floor again"):
            fits.run("tests.jobs.fake_builder", {"plan": plan | orders}, blobs, quiet)
    fits.close()
    del large
    diary = (tmp_path / "diary").read_text().splitlines()
    pids = [entry["pid"] for entry in map(json.loads, diary) if entry["event"] == "fit starts"]
    assert pids[0] == pids[1] == pids[2] != pids[3]
    for pid in set(pids):
        with pytest.raises(ProcessLookupError):
            os.kill(pid, 0)


def test_a_fit_says_nothing_of_the_fit_before_it(blobs: str, capfd: pytest.CaptureFixture[str]) -> None:
    fits = FitProcesses()
    plan = {"floor_id": "f", "map_id": "m", "surveys": [], "sleep_s": 0.05}
    with with_facts(request_id="the-first", job_id="1"):
        fits.run("tests.jobs.fake_builder", {"plan": plan}, blobs, quiet)
    with with_facts(job_id="2"), pytest.raises(FitFailed, match="ZeroDivisionError"):
        fits.run("tests.jobs.fake_builder", {"plan": plan | {"break": True}}, blobs, quiet)
    log = capfd.readouterr().err
    assert "job_id=2" in log
    assert "the-first" not in log


def test_a_fit_does_not_make_the_blob_folder_whose_disk_is_away(tmp_path: Path, blobs: str) -> None:
    plan = {"floor_id": "f", "map_id": "m", "surveys": [], "sleep_s": 0.05}
    (tmp_path / "blobs").rename(tmp_path / "away")
    with pytest.raises(Unavailable, match="is its disk mounted"):
        FitProcesses().run("tests.jobs.fake_builder", {"plan": plan}, blobs, quiet)
    assert not (tmp_path / "blobs").exists()


def test_a_fit_that_makes_no_progress_is_stopped(blobs: str) -> None:
    plan = {"floor_id": "f", "map_id": "m", "surveys": [], "sleep_s": 60.0, "silent": True}
    with pytest.raises(FitProcessDied, match="no progress"):
        FitProcesses().run("tests.jobs.fake_builder", {"plan": plan}, blobs, quiet, silence_s=1.0)
