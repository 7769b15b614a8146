"""Storms' tracker: in his corridor, against a linear filter where the field is linear, and with turns untold."""

import numpy as np
import pytest

from app.synthetic.corridor import make_corridor, surveyed_cells, walk_corridor
from app.tracking.kalman import constant_velocity, predict
from app.tracking.map_cells import MapCells
from app.tracking.ml_kalman import MlKalman, start_belief
from app.tracking.position_fix import FixSettings

LITERAL = FixSettings(noise_sd_uT=0.1, map_variance=False)
TURN_RAD = -np.pi / 2.0


@pytest.fixture(scope="module")
def world():
    rng = np.random.default_rng(20)
    cells = surveyed_cells(make_corridor(rng), rng)
    return cells, walk_corridor(rng, 6, 0.08)


def errors(world, turns, **how):
    cells, walks = world
    rng = np.random.default_rng(5)
    tracker = MlKalman(cells, LITERAL, 0.08**2, **how)
    out = []
    for state, step in zip(walks.state, walks.turn_step, strict=True):
        true = state[15::15, :2]
        start = start_belief(np.zeros(2), np.array([0.5, 0.0]), 1.5, 0.05)
        reading = cells.at(true) + 0.1 * rng.normal(size=(77, 3))
        track = tracker.track(start, reading, 1.5, [(step * 0.1, TURN_RAD)] if turns else [])
        out.append((np.linalg.norm(track.mean[:, :2] - true, axis=1)[10:], track, true))
    return out


def test_moments_stay_within_a_few_decimetres_when_turns_are_told(world):
    off = np.array([each for each, _, _ in errors(world, True, correct_by="moments")])
    assert np.sqrt(np.mean(off**2)) < 0.25
    assert off.max() < 2.0


def test_fixes_mostly_stay_too(world):
    off = np.array([each for each, _, _ in errors(world, True)])
    kept = off.max(axis=1) < 2.0
    assert kept.sum() >= 4
    assert np.sqrt(np.mean(off[kept] ** 2)) < 0.35


def test_a_turn_nobody_told_of_is_recovered_from(world):
    off = np.array([each for each, _, _ in errors(world, False, correct_by="moments", recover=True)])
    assert np.sqrt(np.mean(off[:, -15:] ** 2)) < 0.4  # after the turn


def test_stated_variance_holds(world):
    squared = [np.mean(np.square(t.mean[10:, :2] - true[10:]) / np.diagonal(t.covariance, axis1=1, axis2=2)[10:, :2])
               for _, t, true in errors(world, True, correct_by="moments")]  # fmt: skip
    assert 0.4 < np.median(squared) < 2.0


def test_smoothing_helps(world):
    runs = errors(world, True, correct_by="moments")
    filtered, later = (np.concatenate([np.linalg.norm(each(t) - true, axis=1)[10:] for _, t, true in runs])
                       for each in (lambda t: t.mean[:, :2], lambda t: t.smoothed[:, :2]))  # fmt: skip
    assert np.mean(later**2) < np.mean(filtered**2)


def test_between_readings_it_only_predicts(world):
    tracker = MlKalman(world[0], LITERAL, 0.01)
    start = start_belief(np.array([5.0, -1.0]), np.array([0.5, 0.0]), 0.3, 0.1)
    ours = tracker.advance(start, 0.7, np.array([0.2, -0.1]))
    np.testing.assert_array_equal(ours.mean, predict(start, constant_velocity(0.7, 0.01), np.array([0.2, -0.1])).mean)
    turned = tracker.advance(start, 1.0, turn_rad=TURN_RAD)
    np.testing.assert_allclose(turned.mean, [5.0, -1.5, 0.0, -0.5], atol=1e-12)
    np.testing.assert_allclose(tracker.transition(1.0, TURN_RAD) @ start.mean, turned.mean, atol=1e-12)


def test_linear_field_gives_the_linear_filter():
    """Two components that are x and y: moments are a Kalman update with H = position, R = noise over slope squared."""
    from app.tracking.kalman import POSITION, update

    y, x = np.mgrid[:201, :201] * 0.05
    cells = MapCells((0.0, 0.0), 0.05, np.stack([2.0 * x, 2.0 * y], axis=-1), np.zeros((201, 201, 2)),
                     np.ones((201, 201), dtype=bool))  # fmt: skip
    tracker = MlKalman(cells, FixSettings(noise_sd_uT=0.4, reach_sigmas=6.0), 0.01, "moments")
    belief = start_belief(np.array([5.0, 5.0]), np.array([0.1, 0.0]), 0.3, 0.1)
    oracle = belief
    rng = np.random.default_rng(3)
    for k in range(10):
        place = np.array([5.1 + 0.1 * k, 5.0]) + 0.2 * rng.normal(size=2)
        belief = tracker.correct(tracker.advance(belief, 1.0), 2.0 * place).belief
        oracle = update(predict(oracle, constant_velocity(1.0, 0.01)), place, POSITION, 0.04 * np.eye(2)).belief
        np.testing.assert_allclose(belief.mean, oracle.mean, atol=5e-3)
        np.testing.assert_allclose(belief.covariance, oracle.covariance, atol=1e-3)


def test_off_the_map_and_refused_fixes_change_nothing(world):
    cells, _ = world
    away = start_belief(np.array([10.0, -15.0]), np.zeros(2), 0.1, 0.1)
    corrected = MlKalman(cells, LITERAL, 0.01).correct(away, np.zeros(3))
    assert corrected.fix is None
    assert corrected.belief is away
    gated = MlKalman(cells, FixSettings(fit_gate=True), 0.01)
    here = start_belief(np.array([10.0, -1.0]), np.zeros(2), 0.1, 0.1)
    refused = gated.correct(here, np.full(3, 900.0))
    assert refused.fix.refused == "fit"
    assert refused.belief is here


def test_residual_is_of_the_updated_position(world):
    _, track, _ = errors(world, True)[0]
    first = track.fixes[0]
    np.testing.assert_allclose(track.residual_m[0], first.position_m - track.mean[0, :2])
