"""`isodyn evaluate` and `isodyn evaluate tracks` as a user types them."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from app.cli import main
from app.services.evaluate_tracks import TrackEvaluation
from app.services.followed_walks import Rows, Start, WalkToFollow
from app.services.track_scores import judge_track

runner = CliRunner()


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> list:
    """What the synthetic evaluation was asked; it answers with hand-made tracks."""
    calls = []

    def fake(synthetic, plan, told):
        calls.append((synthetic, plan))
        told("following", 1, 1)
        return TrackEvaluation(tuple(tracks()), {})

    monkeypatch.setenv("COLUMNS", "200")
    monkeypatch.setattr("app.synthetic.tracked_walks.evaluate_synthetic_tracks", fake)
    return calls


def tracks():
    n, floor = 41, np.zeros(41, dtype=np.int64)
    at = 1.0 * np.arange(n)
    truth = np.column_stack([at, 0 * at])
    for name in ("a", "b", "c", "d"):
        walk = WalkToFollow("0", name, True, (), truth, floor, at, Start(0, (0.0, 0.0), 0.0))
        for technique, told, off_m in (("adaptive", "nothing", 0.5), ("dead reckoning", "start, heading", 4.0)):
            rows = Rows(at, floor, truth + np.array([0.0, off_m]), np.tile(np.eye(2), (n, 1, 1)), ("converged",) * n)
            yield judge_track(technique, told, walk, rows, 1.0)


def test_what_is_no_command_is_the_folder_of_todays_evaluation(tmp_path: Path) -> None:
    for folder in (str(tmp_path), "--folds"):
        result = runner.invoke(main, ["evaluate", folder, *([str(tmp_path)] if folder == "--folds" else [])])
        assert result.exit_code == 1, result.output
        assert "no floor to evaluate" in " ".join(result.output.split())
    assert runner.invoke(main, ["evaluate", str(tmp_path / "nowhere")]).exit_code == 2
    bare = runner.invoke(main, ["evaluate"])
    assert bare.exit_code == 2
    assert "Missing argument" in bare.output


def test_a_folder_named_as_the_command_is_reached_by_its_path(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "tracks").mkdir()
    monkeypatch.chdir(tmp_path)
    result = runner.invoke(main, ["evaluate", "./tracks"])
    assert result.exit_code == 1
    assert "no floor to evaluate" in " ".join(result.output.split())
    result = runner.invoke(main, ["evaluate", "tracks"])
    assert result.exit_code == 2
    assert "--synthetic" in result.output


def test_both_explain_themselves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")
    today = runner.invoke(main, ["evaluate", "--help"])
    assert today.exit_code == 0
    assert "--rehearse" in today.output
    assert "isodyn evaluate tracks" in today.output
    tracks = runner.invoke(main, ["evaluate", "tracks", "--help"])
    assert tracks.exit_code == 0
    for option in ("--synthetic", "--fold", "--folds", "--all-floors", "--json", "--plot", "--processes"):
        assert option in tracks.output


def test_tables_json_and_a_plot(asked: list, tmp_path: Path) -> None:
    report, picture = tmp_path / "tracks.json", tmp_path / "tracks.png"
    result = runner.invoke(
        main, ["evaluate", "tracks", "--synthetic", "4", "--json", str(report), "--plot", str(picture)]
    )
    assert result.exit_code == 0, result.output
    ((synthetic, plan),) = asked
    assert (synthetic.walks, synthetic.length_m, synthetic.floors) == (4, 60.0, 4)
    assert plan.spec.resolution_m == 0.25
    assert plan.options.bias_sd_uT < 2.0
    document = json.loads(report.read_text())
    assert len(document["evaluation"]["tracks"]) == 8
    ours = next(each for each in document["summaries"] if each["filter"] == "adaptive")
    assert ours["ends_within"]["1"]["share"] == 1.0
    assert ours["at_30_m"]["share"] == 1.0
    assert ours["false_metres"]["3"]["share"] == 0.0
    assert picture.read_bytes().startswith(b"\x89PNG")
    assert "start, heading" in result.output


def test_a_folder_and_synthetic_walks_are_not_mixed(asked: list, tmp_path: Path) -> None:
    assert runner.invoke(main, ["evaluate", "tracks", str(tmp_path), "--synthetic", "2"]).exit_code == 2
    assert not asked
