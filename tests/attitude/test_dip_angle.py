"""The dip: geometry, variance against draws, turns of the field that the magnitude does not see, up from the force."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.attitude.dip_angle import Dip, dip_angle, dip_statistic, followed_up
from app.attitude.disturbance import critical_value
from app.errors import InvalidInput

UP = np.array([0.0, 0.0, 1.0])
R = np.diag([0.09, 0.16, 0.25])


@given(st.floats(-1.55, 1.55), st.floats(-3.0, 3.0), st.tuples(*[st.floats(-3.0, 3.0)] * 3))
def test_the_dip_is_the_angle_below_the_horizontal_in_any_attitude(dip, azimuth, turn):
    B = 50.0 * np.array([np.cos(dip) * np.cos(azimuth), np.cos(dip) * np.sin(azimuth), -np.sin(dip)])
    body = Rotation.from_rotvec(turn)
    found = dip_angle(body.inv().apply(B)[None], body.inv().apply(UP)[None], R, 0.0)
    assert found.angle_rad[0] == pytest.approx(dip, abs=1e-9)


def test_the_variance_is_that_of_draws():
    rng = np.random.default_rng(0)
    n, tilt = 100_000, 0.02
    B = np.array([20.0, 5.0, -44.0])
    tilts = Rotation.from_rotvec(tilt * rng.normal(size=(n, 3)) * [1.0, 1.0, 0.0])
    found = dip_angle(B + rng.normal(size=(n, 3)) * np.sqrt(np.diag(R)), tilts.apply(np.tile(UP, (n, 1))), R, tilt**2)
    assert found.angle_rad.var() == pytest.approx(float(dip_angle(B, UP, R, tilt**2).variance_rad2), rel=0.02)


def test_a_vertical_field_has_a_dip_and_a_variance():
    found = dip_angle(np.array([[0.0, 0.0, -50.0], [0.0, 0.0, 50.0]]), np.tile(UP, (2, 1)), 0.25 * np.eye(3), 1e-4)
    np.testing.assert_allclose(found.angle_rad, [np.pi / 2, -np.pi / 2])
    np.testing.assert_allclose(found.variance_rad2, 0.25 / 2500.0 + 1e-4)


def test_a_turned_field_of_the_same_magnitude_is_found():
    rng = np.random.default_rng(1)
    B = np.tile([20.0, 0.0, -44.0], (2000, 1))
    B[1000:] = Rotation.from_rotvec([0.0, 0.2, 0.0]).apply(B[1000:])
    measured = dip_angle(B + 0.5 * rng.normal(size=B.shape), np.tile(UP, (2000, 1)), 0.25 * np.eye(3), 1e-4)
    before = dip_angle(B[:1], UP[None], np.zeros((3, 3)), 0.0)
    expected = Dip(before.angle_rad, before.variance_rad2 + 1e-4)
    outliers = dip_statistic(measured, expected) > critical_value()
    assert outliers[:1000].mean() < 0.01
    assert outliers[1000:].mean() > 0.99


def test_up_is_followed_through_turns_and_shakes():
    rng = np.random.default_rng(2)
    n = 3000
    rate = np.cumsum(rng.normal(size=(n, 3)), axis=0) * 0.02
    rate -= rate.mean(axis=0)
    attitude, up = Rotation.identity(), np.empty((n, 3))
    for k, turn in enumerate(Rotation.from_rotvec(rate * 0.01)):
        attitude = attitude * turn
        up[k] = attitude.inv().apply(UP)
    shaken = 9.81 * up + rng.normal(size=(n, 3))
    found = followed_up(np.arange(n) * 0.01, rate, shaken)
    miss = np.arccos(np.clip(np.sum(found * up, axis=1), -1.0, 1.0))
    raw = np.arccos(np.clip(np.sum(shaken * up, axis=1) / np.linalg.norm(shaken, axis=1), -1.0, 1.0))
    assert np.degrees(miss[500:].mean()) < 0.2 * np.degrees(raw.mean())
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)


def test_what_has_no_dip_is_refused():
    with pytest.raises(InvalidInput, match="zero"):
        dip_angle(np.zeros((1, 3)), UP[None], R, 0.0)
    with pytest.raises(InvalidInput, match="length"):
        dip_angle(np.ones((1, 3)), 9.81 * UP[None], R, 0.0)
    with pytest.raises(InvalidInput, match="first force"):
        followed_up(np.arange(2.0), np.zeros((2, 3)), np.zeros((2, 3)))
