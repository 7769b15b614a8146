"""Evaluation on walks: a small building whose answer is known, and the pieces one by one."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from app.cli import evaluate as command
from app.errors import InvalidInput
from app.field.samples import Samples
from app.field.session_bias import estimate_session_biases
from app.services.acceptance import reachable_acceptance
from app.services.cross_validate_maps import cross_validate_maps
from app.services.evaluate_walks import Evaluation, EvaluationPlan, evaluate_walks
from app.services.evaluation_summary import summarise
from app.services.held_out_walks import calibrate_sessions, hold_out
from app.services.judge_windows import Answer, JudgedWindow, Place, cut_windows, disc_centre_m
from app.services.rates import rate
from app.survey.walk import DeadReckoning, Walk


def test_a_known_building_is_evaluated_end_to_end(building, tmp_path):
    report = tmp_path / "report.json"
    result = CliRunner().invoke(
        _application(), [str(building), "--length", "10", "--length", "20", "--resolution", "1",
                         "--processes", "1", "--json", str(report)],
    )  # fmt: skip
    assert result.exit_code == 0, result.output
    for words in (
        "each survey left out",
        "held-out walks",
        "robust sd",
        "gain",
        "right floor",
        "Truth within the radii",
        "prior disc",
        "reachable",
        "broken.txt",
        "cut.txt.gz",
    ):
        assert words in result.output
    document = json.loads(report.read_text())
    windows = document["evaluation"]["windows"]
    assert {w["floor_id"] for w in windows} == {"F0", "F1"}
    assert all(w["covered"] for w in windows)
    assert {w["walk"] for w in windows} == {"walk-4"}
    long = [w for w in windows if w["length_m"] == 20.0]
    assert np.mean([w["ml"]["right_floor"] and w["ml"]["error_m"] < 2.0 for w in long]) > 0.7
    for floor in document["evaluation"]["floors"]:
        assert max(floor["held_out"]["rmse_ut"]) < 4.0
        assert floor["held_out"]["robust_sd_ut"][0]["value"] < 4.0
        assert np.isfinite(floor["nlpd_gain_over_white"]["value"])
        assert not set(floor["mapping_walks"]) & set(floor["held_out_walks"])
    assert len(document["summaries"]) == 4


def _application():
    import typer

    application = typer.Typer()
    application.command()(command.evaluate)
    return application


def test_a_folder_without_floors_is_refused(tmp_path):
    (tmp_path / "F1").mkdir()
    (tmp_path / "F1" / "walk.txt").write_bytes(b"nothing")
    with pytest.raises(InvalidInput, match="no floor to evaluate") as caught:
        evaluate_walks(tmp_path, EvaluationPlan(), lambda *_: None)
    assert caught.value.faults[0].location == "F1/walk.txt"
    result = CliRunner().invoke(_application(), [str(tmp_path)])
    assert result.exit_code == 1
    result = CliRunner().invoke(_application(), [str(tmp_path), "--composition", "boiled"])
    assert result.exit_code == 2


def test_every_fifth_walk_by_name_is_held_out():
    mapping, held_out = hold_out(dict.fromkeys("kjihgfedcba"))
    assert held_out == ["e", "j"]
    assert mapping == list("abcdfghik")


def test_folds_hold_every_walk_out_once():
    names = dict.fromkeys("kjihgfedcba")
    held_out = [name for fold in range(5) for name in hold_out(names, fold)[1]]
    assert sorted(held_out) == sorted(names)


@pytest.mark.slow
def test_every_walk_judges_the_maps_once(building):
    found = cross_validate_maps(building, EvaluationPlan(processes=1), lambda *_: None)
    assert [floor.floor_id for floor in found.floors] == ["F0", "F1", "all"]
    first, second, everything = found.floors
    assert first.held_out.walks == second.held_out.walks == 6
    assert everything.held_out.samples == first.held_out.samples + second.held_out.samples
    assert max(everything.held_out.rmse_ut) < 4.0
    assert np.isfinite(everything.nlpd_gain_over_white.value)


@pytest.mark.slow
def test_the_command_judges_maps_alone_when_asked(building):
    result = CliRunner().invoke(_application(), [str(building), "--maps", "--processes", "1"])
    assert result.exit_code == 0, result.output
    assert "held-out walks" in result.output
    assert "Floors and status" not in result.output


def reckoned(n=400, heading_0=0.4):
    """A circle of 10 m radius, 0.1 m per sample, seen from its first level frame."""
    yaw = np.arange(n) * 0.01
    place = 10.0 * np.stack([np.sin(yaw), 1.0 - np.cos(yaw), 0 * yaw], axis=1)
    q = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    north = np.stack([np.sin(yaw + heading_0), np.cos(yaw + heading_0), 0 * yaw - 2.0], axis=1) * 20.0
    empty = np.empty(0)
    return DeadReckoning(place, yaw, north, q, empty, empty, heading_0 + yaw, np.full(n, 0.1), 4.0)


def test_windows_are_cut_by_distance_and_turned_to_their_first_level_frame():
    walk = reckoned()
    windows = list(cut_windows(walk, 10.0))
    assert len(windows) == 6
    for part, window in windows:
        assert np.linalg.norm(np.diff(window.displacement_m, axis=0), axis=1).sum() == pytest.approx(10.0, abs=0.2)
        np.testing.assert_allclose(window.displacement_m[0], 0.0)
        # A walk straight ahead at first, and a field that points north from start to end.
        assert abs(np.arctan2(*window.displacement_m[1, 1::-1])) < 0.01
        heading = window.heading_rad
        assert heading == pytest.approx(0.4 + walk.yaw_rad[part][0])
        c, s = np.cos(heading), np.sin(heading)
        north = window.B_uT @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
        np.testing.assert_allclose(north, np.tile([0.0, 20.0, -40.0], (len(north), 1)), atol=1e-9)
        assert window.yaw_rad[0] == 0.0


def test_windows_without_a_compass_have_no_heading():
    walk = reckoned()
    blind = DeadReckoning(*[getattr(walk, k) for k in ("displacement_m", "yaw_rad", "B_level_uT", "q_body_to_level",
                                                       "step_t_s", "step_length_m")], None, None, 4.0)  # fmt: skip
    assert all(window.heading_rad is None for _, window in cut_windows(blind, 10.0))


def test_session_offsets_are_taken_out_of_samples_and_dead_reckoning_alike():
    rng = np.random.default_rng(0)
    offset = np.array([9.0, -6.0, 0.0])
    walks = {}
    for k in range(15):
        heading = rng.uniform(-np.pi, np.pi)
        along = np.arange(-8.0, 8.0, 0.2)
        p = np.stack([along * np.cos(heading), along * np.sin(heading), 0 * along], axis=1)
        q = Rotation.from_euler("z", heading - np.pi / 2).as_quat(scalar_first=True)
        level_q = Rotation.from_euler("z", -np.pi / 2).as_quat(scalar_first=True)
        truth = np.tile([1.0, 27.0, -40.0], (len(p), 1))
        session, left = ("good", 0 * offset) if k % 3 else ("bad", offset)
        B = truth + Rotation.from_quat(q, scalar_first=True).apply(left)
        samples = Samples(along + 8, p, B, "building", np.tile(q, (len(p), 1)), session)
        level = Rotation.from_euler("z", -heading).apply(B)
        n = len(p)
        dead = DeadReckoning(p, np.zeros(n), level, np.tile(level_q, (n, 1)), along, along, None, None, 4.0)
        walks[f"{k:02d}"] = Walk(samples, {"heading": heading}, dead)
    biases = estimate_session_biases({name: walk.samples for name, walk in walks.items()})
    for walk in calibrate_sessions(walks, biases).values():
        np.testing.assert_allclose(walk.samples.B_uT, np.tile([1.0, 27.0, -40.0], (80, 1)), atol=0.5)
        turned = Rotation.from_euler("z", walk.report["heading"]).apply(walk.dead_reckoning.B_level_uT)
        np.testing.assert_allclose(turned, walk.samples.B_uT, atol=1e-9)


def test_standard_errors_count_walks_not_windows():
    rng = np.random.default_rng(1)
    values, walks = [], []
    for walk in range(40):
        p = rng.uniform()
        count = int(rng.integers(1, 9))
        values += list(rng.uniform(size=count) < p)
        walks += [str(walk)] * count
    found = rate(values, walks)
    by_walk = [np.array([v for v, w in zip(values, walks, strict=True) if w == str(k)]) for k in range(40)]
    drawn = [np.concatenate([by_walk[k] for k in rng.integers(0, 40, 40)]).mean() for _ in range(4000)]
    assert found.share == np.mean(values)
    assert found.standard_error == pytest.approx(np.std(drawn), rel=0.15)
    assert found.standard_error > 1.3 * np.sqrt(found.share * (1 - found.share) / len(values))
    assert rate([], []).share is None
    assert rate([True], ["a"]).standard_error is None
    assert [str(rate(*each)) for each in (([], []), ([True], ["a"]), ([True, False], ["a", "b"]))] == [
        "-", "1.00", ".50 ±.50"
    ]  # fmt: skip


def judged(walk, right, error_m, covered=True, status="fix", answers=True, confidence=0.5):
    place = Place(right, error_m)
    answer = Answer(status, place, place, confidence, 0.8, 0.1, (1.0, 2.0, 6.0, 9.0))
    return JudgedWindow("F", walk, 20.0, covered, place, place, place if answers else None, None, answer, answer)


WINDOWS = (
    judged("a", True, 1.0, confidence=0.9),
    judged("a", True, 4.0, answers=False),
    judged("b", False, 0.5, status="ambiguous"),
    judged("c", True, 30.0, covered=False, status="unmapped"),
)


def test_summaries_count_a_wrong_floor_as_infinitely_wrong():
    everything, covered = summarise(Evaluation((), WINDOWS, {}))
    assert (everything.windows, everything.walks, covered.windows) == (4, 3, 3)
    assert everything.techniques["ml"].within_2_m.share == 0.25
    assert everything.techniques["ml"].within_5_m.share == 0.5
    assert everything.techniques["ml"].error_percentiles_m == {"p50": 30.0, "p75": np.inf, "p90": np.inf}
    assert everything.techniques["mlr"].available.share == 0.75
    assert everything.techniques["abl"].available.share == 0.0
    assert everything.techniques["abl"].right_floor.share is None
    assert everything.techniques["prior_disc"].within_5_m.share == 0.5
    assert everything.right_floor.share == 0.75
    assert covered.fix_within_5_m.share == 1.0
    assert covered.status["ambiguous"].share == pytest.approx(1 / 3)


def test_reliability_is_of_windows_that_are_not_called_unmapped():
    everything, _ = summarise(Evaluation((), WINDOWS, {}))
    found = everything.reliability
    assert found.windows == 3
    assert {share: held.share for share, held in found.held.items()} == {
        "50": pytest.approx(1 / 3), "68": pytest.approx(1 / 3), "90": pytest.approx(2 / 3), "95": pytest.approx(2 / 3)
    }  # fmt: skip
    assert found.stated["95"] == pytest.approx(0.95 * 0.8)


def test_acceptance_is_the_most_that_can_be_taken_with_nine_in_ten_right():
    confidence = [0.9] * 9 + [0.8] + [0.7, 0.6]
    right = [True] * 9 + [False] + [False, True]
    walks = [str(k) for k in range(12)]
    found = reachable_acceptance(confidence, right, walks)
    assert found.accepted.share == pytest.approx(10 / 12)
    assert found.right.share == pytest.approx(0.9)
    assert found.least_confidence == 0.8
    # Equally sure windows come together: one of two that are right does not do.
    none = reachable_acceptance([0.5, 0.5], [True, False], ["a", "b"])
    assert none.accepted.share == 0.0
    assert none.right.share is None
    assert none.least_confidence is None
    assert reachable_acceptance([], [], []).accepted.share is None


def test_prior_positions_are_spread_evenly_over_their_disc():
    truth_m = np.array([3.0, -2.0])
    drawn = np.array([disc_centre_m(truth_m, 20.0, str(k)) for k in range(2000)]) - truth_m
    assert np.linalg.norm(drawn, axis=1).max() < 20.0
    assert drawn.std(axis=0) == pytest.approx([10.0, 10.0], rel=0.05)
    np.testing.assert_array_equal(disc_centre_m(truth_m, 20.0, "7"), truth_m + drawn[7])


@pytest.mark.slow
def test_every_walk_is_asked_once_where_all_folds_are_held_out(building, tmp_path):
    report = tmp_path / "report.json"
    asked = [str(building), "--folds", "--length", "10", "--processes", "1", "--json", str(report)]
    result = CliRunner().invoke(_application(), asked)
    assert result.exit_code == 0, result.output
    assert "each survey left out" not in result.output
    document = json.loads(report.read_text())
    windows = document["evaluation"]["windows"]
    assert {w["walk"] for w in windows} == {f"walk-{k}" for k in range(6)}
    assert document["evaluation"]["floors"] == []
    assert np.mean([w["disc"]["position"]["error_m"] < 3.0 for w in windows]) > 0.8
