"""The closed forms of the error's growth against matrix exponentials and Van Loan's discretisation."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from app.attitude.error_dynamics import advance, bias_response, building_from_body, process_noise, turn_back
from app.attitude.plain_kernel import cross_matrix
from app.tracking.kalman import van_loan

rates = arrays(np.float64, 3, elements=st.floats(-20.0, 20.0))
steps = st.sampled_from([1e-4, 1e-3, 5e-3, 0.02, 0.1, 1.0])


def _phi(rate: np.ndarray, dt: float) -> np.ndarray:
    blocks = np.eye(6)
    turn_back(rate, dt, blocks[:3, :3])
    bias_response(rate, dt, blocks[:3, 3:])
    return blocks


def _dynamics(rate: np.ndarray) -> np.ndarray:
    F = np.zeros((6, 6))
    F[:3, :3], F[:3, 3:] = -cross_matrix(rate), -np.eye(3)
    return F


@given(rates, steps)
def test_transition_is_the_matrix_exponential(rate: np.ndarray, dt: float) -> None:
    assert np.allclose(_phi(rate, dt), expm(_dynamics(rate) * dt), rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("size", [0.0, 1e-300, 1e-12, 1e-8, 1e-6, 1e-3, 1.99e-2, 2.01e-2, 0.1])
def test_the_series_for_slow_rotation_meets_the_closed_form(size: float) -> None:
    rate = size * np.array([0.6, -0.64, 0.48])
    assert np.allclose(_phi(rate, 1.0), expm(_dynamics(rate)), rtol=0.0, atol=1e-12)


def test_process_noise_is_van_loans() -> None:
    dt, v, u = 0.02, 1e-3, 2e-4
    G = np.diag([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])
    Q = np.diag(np.repeat([v * v, u * u], 3))
    still = van_loan(_dynamics(np.zeros(3)), np.zeros((6, 1)), G, Q, dt).process_noise
    angle, cross, bias = process_noise(v, u, dt)
    assert np.allclose(still[:3, :3], angle * np.eye(3), rtol=1e-12, atol=0.0)
    assert np.allclose(still[:3, 3:], cross * np.eye(3), rtol=1e-12, atol=1e-25)
    assert np.allclose(still[3:, 3:], bias * np.eye(3), rtol=1e-12, atol=0.0)
    turning = van_loan(_dynamics(np.array([2.0, -1.0, 3.0])), np.zeros((6, 1)), G, Q, dt).process_noise
    assert np.abs(turning - still).max() < 0.05 * np.abs(cross)  # what is neglected is of third order in dt


@given(arrays(np.float64, 4, elements=st.floats(-1.0, 1.0)).filter(lambda q: np.linalg.norm(q) > 0.1), rates, steps)
def test_advance_composes_rotations(q: np.ndarray, rate: np.ndarray, dt: float) -> None:
    q = q / np.linalg.norm(q)
    expected = Rotation.from_quat(q, scalar_first=True) * Rotation.from_rotvec(rate * dt)
    turned, R = q.copy(), np.empty((3, 3))
    advance(turned, *(rate * dt))
    building_from_body(turned, R)
    assert np.allclose(R, expected.as_matrix(), atol=1e-12)
    assert np.linalg.norm(turned) == pytest.approx(1.0, abs=1e-15)
