"""The nine-state filter: rotations, Jacobian, and filterpy step by step."""

import numpy as np
import pytest
from filterpy.kalman import ExtendedKalmanFilter
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.tracking.inertial_ekf import (
    CUENCA_NOISE,
    GRAVITY_M_S2,
    body_to_building,
    correct_position,
    correct_position_and_velocity,
    inertial_step,
    inertial_step_jacobian,
    predict_inertial,
)
from app.tracking.kalman import GaussianBelief

ANGLE = st.floats(-1.2, 1.2)


def some_state(rng):
    return np.concatenate([rng.normal(size=6), rng.uniform(-1.1, 1.1, 2), rng.uniform(-3.0, 3.0, 1)])


@given(ANGLE, ANGLE, st.floats(-4.0, 4.0))
def test_rotation_is_the_product_of_its_factors(roll, pitch, yaw):
    R = body_to_building(roll, pitch, yaw)
    np.testing.assert_allclose(R, Rotation.from_euler("ZYX", [yaw, pitch, roll]).as_matrix(), atol=1e-12)
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


@given(st.integers(0, 10_000))
def test_jacobian_against_finite_differences(seed):
    rng = np.random.default_rng(seed)
    state, force, rate = some_state(rng), rng.normal(0.0, 6.0, 3), rng.normal(0.0, 1.0, 3)
    h = 1e-6
    columns = [
        (inertial_step(state + h * e, force, rate, 0.1) - inertial_step(state - h * e, force, rate, 0.1)) / (2.0 * h)
        for e in np.eye(9)
    ]
    np.testing.assert_allclose(inertial_step_jacobian(state, force, rate, 0.1), np.column_stack(columns), atol=3e-8)


def test_at_rest_nothing_moves():
    """z up: an accelerometer at rest reads gravity upwards, whatever the attitude."""
    state = np.array([1.0, 2.0, 3.0, 0, 0, 0, 0.2, -0.1, 2.0])
    force = body_to_building(*state[6:]).T @ [0.0, 0.0, GRAVITY_M_S2]
    np.testing.assert_allclose(inertial_step(state, force, np.zeros(3), 0.01), state, atol=1e-12)


def test_euler_rates_turn_as_rotations_do():
    """Small steps of the angles follow the rotation by the same body rates."""
    angles, rate, dt = np.array([0.3, -0.4, 1.0]), np.array([0.5, -0.2, 0.7]), 1e-4
    state = np.concatenate([np.zeros(6), angles])
    turned = Rotation.from_euler("ZYX", angles[::-1]) * Rotation.from_rotvec(rate * dt)
    ours = inertial_step(state, np.zeros(3), rate, dt)[6:]
    np.testing.assert_allclose(ours, turned.as_euler("ZYX")[::-1], atol=1e-8)


@pytest.mark.parametrize("measured", [2, 3, 6])
def test_step_by_step_as_filterpy(measured):
    rng = np.random.default_rng(measured)
    H, R = np.eye(measured, 9), np.diag(rng.uniform(0.01, 0.5, measured))
    start = some_state(rng)
    belief = GaussianBelief(start, np.diag(rng.uniform(0.01, 0.1, 9)))
    oracle = ExtendedKalmanFilter(dim_x=9, dim_z=measured)
    oracle.x, oracle.P, oracle.R = belief.mean[:, None].copy(), belief.covariance.copy(), R
    for _ in range(40):
        force, rate = rng.normal([0, 0, 9.8], 0.5), rng.normal(0.0, 0.1, 3)
        F = inertial_step_jacobian(oracle.x[:, 0], force, rate, 0.01)
        oracle.x = inertial_step(oracle.x[:, 0], force, rate, 0.01)[:, None]
        oracle.P = F @ oracle.P @ F.T + CUENCA_NOISE.covariance
        z = oracle.x[:measured, 0] + 0.1 * rng.normal(size=measured)
        oracle.update(z[:, None], lambda _, H=H: H, lambda x, n=measured: x[:n])
        belief = predict_inertial(belief, force, rate, 0.01, CUENCA_NOISE.covariance)
        found = (correct_position(belief, z, R) if measured < 6
                 else correct_position_and_velocity(belief, z[:3], z[3:], R))  # fmt: skip
        belief = found.belief
        np.testing.assert_allclose(belief.mean, oracle.x[:, 0], atol=1e-9)
        np.testing.assert_allclose(belief.covariance, oracle.P, atol=1e-9)
        np.testing.assert_allclose(found.innovation_covariance, oracle.S, atol=1e-9)


def test_printed_noise():
    """(Cuenca, L788)."""
    np.testing.assert_array_equal(np.diag(CUENCA_NOISE.covariance), [1e-5] * 3 + [1e-2] * 3 + [1e-8] * 3)
