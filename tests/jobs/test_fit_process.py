"""A fit in its child process, without a worker around it."""

from pathlib import Path

import pytest

from workers.fit_process import FitProcessDied, run_fit


def test_a_fit_that_makes_no_progress_is_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ISODYN_TEST_DIARY", str(tmp_path / "diary"))
    plan = {"floor_id": "f", "map_id": "m", "surveys": [], "sleep_s": 60.0, "silent": True}
    with pytest.raises(FitProcessDied, match="no progress"):
        run_fit("tests.jobs.fake_builder", plan, f"file://{tmp_path}", lambda fraction, message: None, silence_s=1.0)
