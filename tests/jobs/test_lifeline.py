"""A worker's lock file: seen as cut exactly when its process is gone."""

import os
import subprocess
import sys
from pathlib import Path

from workers.lifeline import Lifeline, new_worker_id

ROOT = Path(__file__).parents[2]
HOLD = (
    "import sys, time; from pathlib import Path; from workers.lifeline import Lifeline, new_worker_id\n"
    "line = Lifeline(Path(sys.argv[1]), new_worker_id()); print('held', flush=True); time.sleep(100)"
)


def test_only_the_killed_are_cut(tmp_path: Path) -> None:
    mine = Lifeline(tmp_path, new_worker_id())
    other = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(tmp_path)],
        stdout=subprocess.PIPE,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )
    assert other.stdout is not None
    with other.stdout:
        other.stdout.readline()
        assert mine.cut() == []
        other.kill()
        other.wait()
    (dead_id,) = mine.cut()
    assert str(other.pid) in dead_id
    mine.bury(dead_id)
    assert mine.cut() == []
    mine.release()
    assert list(tmp_path.iterdir()) == []


def test_workers_of_other_machines_are_not_judged(tmp_path: Path) -> None:
    mine = Lifeline(tmp_path, new_worker_id())
    (tmp_path / "another-machine-17-0123456789ab.lock").touch()
    assert mine.cut() == []
    mine.release()
