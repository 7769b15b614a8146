"""The offset of one survey that turns: known offsets on a known field, a dense process as second opinion."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.field import body_bias
from app.field.body_bias import estimate_body_bias, remove_body_bias, without_body_biases
from app.field.samples import Samples


def turning_walk(room, rng, bias_body_uT, tilt_rad=0.0, noise_uT=0.3):
    """Three laps of a rounded square, each elsewhere; the sensor looks ahead and is tilted about its own x axis."""
    angle = np.linspace(0.0, 6.0 * np.pi, 900)
    radius_m = 2.6 + 0.08 * angle
    p = np.column_stack([6.0 + radius_m * np.cos(angle), 4.5 + radius_m * np.sin(angle), np.zeros(len(angle))])
    attitude = Rotation.from_euler("z", angle[:, None] + np.pi / 2) * Rotation.from_euler("x", tilt_rad)
    B = room.field_uT(p) + attitude.apply(bias_body_uT) + noise_uT * rng.normal(size=p.shape)
    return Samples(np.arange(len(p)) * 0.1, p, B, "building", attitude.as_quat(scalar_first=True))


@pytest.mark.parametrize("bias", [(0.0, 0.0, 0.0), (6.0, -13.0, 0.0), (35.0, 20.0, 0.0)])
def test_the_offset_across_the_vertical_is_found(make_room, bias):
    for seed in range(3):
        walk = turning_walk(make_room(seed), np.random.default_rng(seed), bias)
        found = estimate_body_bias(walk)
        error_uT = found.bias_body_uT - bias
        assert np.linalg.norm(error_uT) < 0.8
        assert np.all(np.abs(error_uT[:2]) < 4.0 * np.sqrt(np.diag(found.covariance_uT2))[:2])
        np.testing.assert_allclose(found.bias_body_uT[2], 0.0, atol=1e-9)


@given(tilt_rad=st.floats(-1.4, 1.4), seed=st.integers(0, 50))
@settings(max_examples=8, deadline=None)
def test_nothing_is_said_along_the_vertical_however_the_sensor_is_held(make_room, tilt_rad, seed):
    rng = np.random.default_rng(seed)
    walk = turning_walk(make_room(3), rng, rng.normal(size=3) * 8.0, tilt_rad)
    found = estimate_body_bias(walk)
    up_body = np.array([0.0, np.sin(tilt_rad), np.cos(tilt_rad)])
    assert abs(found.bias_body_uT @ up_body) < 1e-9
    assert up_body @ found.covariance_uT2 @ up_body == pytest.approx(body_bias.PRIOR_VERTICAL_SD_UT**2)


def test_turning_building_and_sensor_together_turns_nothing_in_the_body_frame(room):
    walk = turning_walk(room, np.random.default_rng(1), (3.0, 4.0, 0.0))
    turn = Rotation.from_euler("z", 0.7)
    assert walk.q_body_to_building is not None
    turned = Samples(
        walk.t_s,
        turn.apply(walk.p_building_m),
        turn.apply(walk.B_uT),
        "building",
        (turn * Rotation.from_quat(walk.q_body_to_building, scalar_first=True)).as_quat(scalar_first=True),
    )
    np.testing.assert_allclose(
        estimate_body_bias(turned).bias_body_uT, estimate_body_bias(walk).bias_body_uT, atol=1e-6
    )


def test_the_estimate_equals_a_dense_process_with_the_offset_as_one_more_function(room):
    """The posterior of the offset when ambient field and offset are part of one dense covariance."""
    walk = turning_walk(room, np.random.default_rng(2), (5.0, -4.0, 0.0))
    assert walk.q_body_to_building is not None
    stretches = body_bias.mean_over_stretches(walk, walk.q_body_to_building, body_bias.STRETCH_M)
    found = body_bias._fit(stretches, np.eye(3)[:, :2], 2.0)
    n = len(stretches.path_m)
    distance = np.linalg.norm(stretches.position_m[:, None] - stretches.position_m, axis=2)
    along = np.abs(stretches.path_m[:, None] - stretches.path_m)
    scaled = np.sqrt(3.0) * distance / 2.0
    own = (1.0 + scaled) * np.exp(-scaled) + 6.0 * (0.3 / 2.0) ** 2 * np.exp(-along / 5.0) + 1e-3 * np.eye(n)
    design = np.vstack([stretches.rotation[:, c, :2] for c in range(3)])
    target = (stretches.field_uT - stretches.field_uT.mean(axis=0)).T.ravel()
    ambient = np.kron(np.eye(3), np.full((n, n), 1e5))
    covariance = found.signal_variance_uT2 * np.kron(np.eye(3), own) + ambient + 10.0**2 * design @ design.T
    right = 10.0**2 * design.T @ np.linalg.inv(covariance)
    np.testing.assert_allclose(found.mean_uT, right @ target, atol=2e-3)
    np.testing.assert_allclose(found.covariance_uT2, 10.0**2 * (np.eye(2) - right @ design), atol=2e-3)


def test_a_straight_walk_that_never_turns_says_nothing(room):
    p = np.column_stack([np.linspace(1.0, 11.0, 200), np.full(200, 4.0), np.zeros(200)])
    B = room.field_uT(p) + np.array([20.0, 0.0, 0.0])
    found = estimate_body_bias(Samples(np.arange(200.0), p, B, "building", np.tile([1.0, 0.0, 0.0, 0.0], (200, 1))))
    np.testing.assert_allclose(found.bias_body_uT, 0.0, atol=1e-6)
    np.testing.assert_allclose(np.sqrt(np.diag(found.covariance_uT2))[:2], body_bias.PRIOR_SD_UT, rtol=1e-3)


def test_removing_an_offset_gives_the_walk_without_it(room):
    biased = turning_walk(room, np.random.default_rng(4), (6.0, -2.0, 0.0), tilt_rad=0.3)
    plain = turning_walk(room, np.random.default_rng(4), (0.0, 0.0, 0.0), tilt_rad=0.3)
    known = body_bias.BodyBias(np.array([6.0, -2.0, 0.0]), np.zeros((3, 3)))
    np.testing.assert_allclose(remove_body_bias(biased, known).B_uT, plain.B_uT, atol=1e-9)


def test_a_walk_without_attitude_or_too_short_has_no_estimate(room):
    walk = turning_walk(room, np.random.default_rng(5), (1.0, 1.0, 0.0))
    assert estimate_body_bias(Samples(walk.t_s, walk.p_building_m, walk.B_uT, "building")) is None
    few = slice(0, 40)
    assert walk.q_body_to_building is not None
    short = Samples(walk.t_s[few], walk.p_building_m[few], walk.B_uT[few], "building", walk.q_body_to_building[few])
    assert estimate_body_bias(short) is None


def test_only_walks_of_no_session_are_corrected_each_by_its_own_offset(room):
    offsets = {"a": (6.0, -2.0, 0.0), "b": (-9.0, 3.0, 0.0), "labelled": (5.0, 5.0, 0.0), "plain": (5.0, 5.0, 0.0)}
    walks = {name: turning_walk(room, np.random.default_rng(6), bias) for name, bias in offsets.items()}
    walks["labelled"] = replace(walks["labelled"], session="one")
    walks["plain"] = replace(walks["plain"], q_body_to_building=None)
    corrected, biases = without_body_biases(walks)
    assert list(corrected) == list(walks)
    assert sorted(biases) == ["a", "b"]
    assert corrected["labelled"] is walks["labelled"]
    assert corrected["plain"] is walks["plain"]
    assert np.abs(corrected["a"].B_uT - corrected["b"].B_uT).max() < 1.0  # they were up to 16 uT apart
