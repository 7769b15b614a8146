"""The demonstration end to end on a small building, and its parts that a good run never shows."""

import fcntl
import gzip
import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import httpx
import numpy as np
import pytest
from typer.testing import CliRunner

from app.cli import main
from app.cli.demo.journey import Answer
from app.cli.demo.pictures import draw_errors
from app.cli.demo.report import absurdities, judge, summary
from app.cli.demo.server import DemoError, clean_folder, running_server
from app.cli.demo.synthetic import synthetic_world
from app.cli.demo.traces import traces_world
from app.cli.demo.world import Question, World
from app.errors import InvalidInput

runner = CliRunner()
SMALL = ("--width-m", "12", "--depth-m", "10", "--windows", "8", "--seed", "3")


def test_the_demo_runs_end_to_end_and_leaves_pictures_and_a_report(tmp_path: Path) -> None:
    output = tmp_path / "out"
    result = runner.invoke(main, ["demo", "--once", "--output", str(output), *SMALL])
    assert result.exit_code == 0, result.output
    for technique in ("ML", "MLR", "ABL", "posterior"):
        assert technique in result.output
    written = {path.name for path in output.iterdir()}
    assert {"errors.png", "floor-0-fixes.png", "floor-1-fixes.png", "floor-1-heatmap-sd.png", "report.json"} <= written
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in output.glob("*.png"))
    report = json.loads((output / "report.json").read_text())
    assert [sum(floor["consistency"].values()) for floor in report["maps"]] == [4, 4]
    assert max(max(floor["true_rmse_ut"]) for floor in report["maps"]) < 1.5
    assert len(report["windows"]) == 8
    long = [row for row in report["techniques"] if row["length_m"] == 20.0 and row["technique"] == "posterior"]
    assert long[0]["right_floor"] == 1.0
    assert long[0]["error_50_m"] < 1.0


def test_an_output_folder_with_foreign_files_is_refused_and_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.json").write_text("{}")
    result = runner.invoke(main, ["demo", "--once", "--output", str(tmp_path)])
    assert result.exit_code == 2
    assert "choose another folder" in result.output
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.json"]


def test_a_second_demo_in_the_same_folder_is_refused(tmp_path: Path) -> None:
    with clean_folder(tmp_path / "out"), pytest.raises(DemoError, match="another demo"), clean_folder(tmp_path / "out"):
        pass


def test_a_folder_is_emptied_of_the_last_demo_only(tmp_path: Path) -> None:
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "kept").write_text("kept")
    with clean_folder(tmp_path / "out") as folder:
        (folder / "var").symlink_to(elsewhere)
        (folder / "old.png").write_bytes(b"")
        (folder / "notes.txt").write_text("mine")
    with clean_folder(tmp_path / "out") as folder:
        assert sorted(path.name for path in folder.iterdir()) == [".isodyn-demo", "notes.txt", "var"]
    assert (elsewhere / "kept").exists()


def test_a_taken_port_is_told(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        with pytest.raises(DemoError, match=f"port {port} is taken"), running_server(tmp_path, port):
            pass


def test_a_server_that_cannot_start_says_why(tmp_path: Path) -> None:
    (tmp_path / "var").write_text("a file where the data folder should be")
    with pytest.raises(DemoError, match="did not start"), running_server(tmp_path, None):
        pass


@pytest.mark.slow
def test_the_server_stays_until_the_demo_is_terminated(tmp_path: Path) -> None:
    command = [sys.executable, "-u", "-m", "app.cli", "demo", "--output", str(tmp_path / "out"), *SMALL]
    with (tmp_path / "told").open("w") as told:
        process = subprocess.Popen(command, stdout=told, stderr=told, env=os.environ | {"COLUMNS": "200"})
    try:
        url = _address(process, tmp_path / "told")
        assert httpx.get(f"{url}/readyz").status_code == 200
        assert "text/html" in httpx.get(f"{url}/view/", follow_redirects=True).headers["content-type"]
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(60)
    with pytest.raises(httpx.TransportError):
        httpx.get(f"{url}/readyz")
    with (tmp_path / "out" / ".isodyn-demo").open() as lock:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)


def _address(process: subprocess.Popen[bytes], told: Path) -> str:
    for _ in range(1200):
        words = told.read_text().split()
        if "Page:" in words and "key" in words:
            return words[words.index("Page:") + 1].removesuffix("/view/")
        assert process.poll() is None, told.read_text()
        time.sleep(0.2)
    raise AssertionError(told.read_text())


def test_the_same_seed_makes_the_same_world() -> None:
    first, second = (_small_world() for _ in range(2))
    assert [s.gzipped[10:] for f in first.floors for s in f.surveys] == [
        s.gzipped[10:] for f in second.floors for s in f.surveys
    ]
    assert first.questions[3].body == second.questions[3].body
    lengths = {(q.floor, q.length_m) for q in first.questions}
    assert lengths == {(floor, length_m) for floor in (0, 1) for length_m in (2.0, 5.0, 10.0, 20.0)}


def _small_world() -> World:
    rng = np.random.default_rng(3)
    return synthetic_world(rng, width_m=12, depth_m=10, floors=2, windows=8, told=lambda done, total: None)


def test_a_folder_without_floors_is_refused(tmp_path: Path) -> None:
    (tmp_path / "F1").mkdir()
    (tmp_path / "F1" / "walk.txt.gz").write_bytes(gzip.compress(b"nothing"))
    result = runner.invoke(main, ["demo", "--once", "--data", str(tmp_path), "--output", str(tmp_path / "out")])
    assert result.exit_code == 2
    assert "holds no floor" in result.output
    with pytest.raises(InvalidInput, match="one folder per floor"):
        traces_world(tmp_path, windows=4, told=lambda done, total: None)


def _answer(error_m: float, radius_m: float, floor_id: str = "ground", mlr: bool = True) -> Answer:
    question = Question("w", 10.0, {}, 0, np.zeros(3), np.zeros((2, 2)))
    place = {"floor_id": floor_id, "position_m": [error_m, 0.0, 1.2]}
    estimates = {"ml": {"available": True, **place}, "mlr": {"available": mlr, **place},
                 "abl": {"available": False, "floor_id": None, "position_m": None}}  # fmt: skip
    posterior = {**place, "radius_95_m": radius_m}
    return Answer(question, {"status": "fix", "estimates": estimates, "posterior": posterior}, 1.0)


def test_techniques_are_judged_against_the_truth() -> None:
    answers = [_answer(0.2, 0.5), _answer(0.6, 0.5, mlr=False), _answer(0.1, 0.5, floor_id="upper")]
    judged = judge(answers, ["ground", "upper"])
    rows = {name: summary([j for j in judged if j.technique == name]) for name in ("ml", "mlr", "abl", "posterior")}
    assert rows["ml"]["answered"] == 1.0
    assert rows["ml"]["right_floor"] == pytest.approx(2 / 3)
    assert rows["ml"]["error_50_m"] == pytest.approx(0.6)
    assert rows["ml"]["error_95_m"] == np.inf
    assert rows["ml"]["held"] == pytest.approx(1 / 3)
    assert rows["mlr"]["answered"] == pytest.approx(2 / 3)
    assert rows["abl"]["answered"] == 0.0
    assert rows["abl"]["error_50_m"] is None
    assert rows["posterior"]["radius_95_m"] == pytest.approx(0.5)


def test_an_absurd_result_is_called_absurd() -> None:
    known = World("w", [], [], field_uT=np.zeros_like)
    good = judge([_answer(0.2, 0.5)] * 10, ["ground"])
    assert absurdities(known, [], good) == []
    over_confident = judge([_answer(0.6, 0.5)] * 10, ["ground"])
    assert "95 % radius holds only 0 of 10" in absurdities(known, [], over_confident)[0]
    unlucky = judge([_answer(0.2, 0.5)] * 6 + [_answer(0.6, 0.5)] * 2, ["ground"])
    assert absurdities(known, [], unlucky) == []
    lost = judge([_answer(4.0, 20.0)] * 10, ["ground"])
    assert "worse than 1 m" in absurdities(known, [], lost)[0]
    real = World("w", [], [])
    assert absurdities(real, [], lost) == []
    assert absurdities(real, [], []) == ["no window was located"]


@pytest.mark.parametrize("answers", [[], [_answer(0.2, 0.5), _answer(3.0, 0.5), _answer(0.1, 0.5, floor_id="upper")]])
def test_errors_are_drawn_whatever_they_are(tmp_path: Path, answers: list[Answer]) -> None:
    draw_errors(tmp_path / "errors.png", judge(answers, ["ground", "upper"]), "errors")
    assert (tmp_path / "errors.png").read_bytes().startswith(b"\x89PNG")
