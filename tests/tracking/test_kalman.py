"""The linear filter against filterpy, the printed matrices, and what must hold for any numbers."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter, rts_smoother
from hypothesis import given
from hypothesis import strategies as st

from app.tracking.kalman import (
    POSITION,
    GaussianBelief,
    condition_on_position,
    constant_velocity,
    predict,
    rotate_velocity,
    smooth,
    update,
    van_loan,
)

F = np.eye(4, k=2)
B = np.eye(4, 2, k=-2)


def some_covariance(rng, n):
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def test_printed_matrices():
    """(Storms, L542-546): dt = 0.1 s, sigma_a = 0.08; our order x, y is his Y, X."""
    model = constant_velocity(0.1, 0.08**2)
    np.testing.assert_array_equal(model.transition, [[1, 0, 0.1, 0], [0, 1, 0, 0.1], [0, 0, 1, 0], [0, 0, 0, 1]])
    np.testing.assert_allclose(model.control, [[0.005, 0], [0, 0.005], [0.1, 0], [0, 0.1]], atol=1e-12)
    printed = np.array([[0.0021, 0, 0.032, 0], [0, 0.0021, 0, 0.032], [0.032, 0, 0.64, 0], [0, 0.032, 0, 0.64]])
    np.testing.assert_allclose(1e3 * model.process_noise, printed, atol=5e-5)
    fine = constant_velocity(0.1, 0.02**2).process_noise
    np.testing.assert_allclose(fine[[0, 0, 2], [0, 2, 2]], [1.333e-7, 2.0e-6, 4.0e-5], rtol=1e-3)


@given(st.floats(0.01, 5.0), st.floats(1e-4, 2.0))
def test_closed_form_is_van_loans(dt_s, psd):
    closed, general = constant_velocity(dt_s, psd), van_loan(F, B, B, psd * np.eye(2), dt_s)
    for name in ("transition", "control", "process_noise"):
        np.testing.assert_allclose(getattr(general, name), getattr(closed, name), rtol=1e-9, atol=1e-12)


def test_van_loan_of_a_model_whose_noise_does_not_act_alone():
    """Against the integral of Phi G Q G^T Phi^T by Simpson's rule."""
    from scipy.integrate import simpson
    from scipy.linalg import expm

    drift = np.array([[-0.3, 1.0], [-0.5, -0.2]])
    G, Q = np.array([[0.2, 0.0], [1.0, 0.4]]), np.diag([0.5, 2.0])
    at = np.linspace(0.0, 0.7, 401)
    inside = np.array([expm(drift * t) @ G @ Q @ G.T @ expm(drift * t).T for t in at])
    held = np.array([expm(drift * t) @ G for t in at])
    model = van_loan(drift, G, G, Q, 0.7)
    np.testing.assert_allclose(model.process_noise, simpson(inside, x=at, axis=0), rtol=1e-8)
    np.testing.assert_allclose(model.control, simpson(held, x=at, axis=0), rtol=1e-8)


def test_many_short_steps_are_one_long_one():
    start = GaussianBelief(np.array([1.0, 2.0, 0.5, -0.2]), np.diag([2.0, 1.0, 0.1, 0.3]))
    many = start
    for _ in range(15):
        many = predict(many, constant_velocity(0.1, 0.0064))
    once = predict(start, constant_velocity(1.5, 0.0064))
    np.testing.assert_allclose(many.mean, once.mean, atol=1e-12)
    np.testing.assert_allclose(many.covariance, once.covariance, atol=1e-12)


@pytest.mark.parametrize("form", ["joseph", "plain"])
def test_step_by_step_as_filterpy(form):
    rng = np.random.default_rng(1)
    oracle = KalmanFilter(dim_x=4, dim_z=2, dim_u=2)
    model = constant_velocity(0.5, 0.3)
    oracle.F, oracle.B, oracle.Q, oracle.H = model.transition, model.control, model.process_noise, POSITION
    oracle.x, oracle.P = np.zeros((4, 1)), np.diag([1.0, 2.0, 0.5, 0.5])
    belief = GaussianBelief(np.zeros(4), np.diag([1.0, 2.0, 0.5, 0.5]))
    for _ in range(30):
        u, z, R = rng.normal(size=2), rng.normal(size=2), some_covariance(rng, 2)
        oracle.predict(u=u[:, None])
        oracle.update(z[:, None], R=R)
        found = update(predict(belief, model, u), z, POSITION, R, form)
        belief = found.belief
        np.testing.assert_allclose(belief.mean, oracle.x[:, 0], atol=1e-10)
        np.testing.assert_allclose(belief.covariance, oracle.P, atol=1e-10)
        np.testing.assert_allclose(found.innovation, oracle.y[:, 0], atol=1e-10)
        np.testing.assert_allclose(found.innovation_covariance, oracle.S, atol=1e-10)
        np.testing.assert_allclose(found.gain, oracle.K, atol=1e-10)


def test_smoother_as_filterpy():
    rng = np.random.default_rng(2)
    model = constant_velocity(1.0, 0.2)
    filtered, predicted = [GaussianBelief(np.zeros(4), np.eye(4))], []
    for _ in range(12):
        predicted.append(predict(filtered[-1], model))
        filtered.append(update(predicted[-1], rng.normal(size=2), POSITION, 0.3 * np.eye(2)).belief)
    ours = smooth(filtered, predicted, [model.transition] * 12)
    x, P, _, _ = rts_smoother(
        np.array([b.mean for b in filtered]),
        np.array([b.covariance for b in filtered]),
        np.array([model.transition] * 13),
        np.array([model.process_noise] * 13),
    )
    np.testing.assert_allclose([b.mean for b in ours], x, atol=1e-9)
    np.testing.assert_allclose([b.covariance for b in ours], P, atol=1e-9)


@given(st.integers(0, 10_000))
def test_measuring_never_widens_and_the_forms_agree(seed):
    rng = np.random.default_rng(seed)
    belief = GaussianBelief(rng.normal(size=4), some_covariance(rng, 4))
    z, R = rng.normal(size=2), some_covariance(rng, 2)
    joseph, plain = update(belief, z, POSITION, R), update(belief, z, POSITION, R, "plain")
    np.testing.assert_allclose(joseph.belief.covariance, plain.belief.covariance, atol=1e-9)
    gained = belief.covariance - joseph.belief.covariance
    assert np.linalg.eigvalsh(0.5 * (gained + gained.T)).min() > -1e-9
    assert joseph.squared_distance >= 0.0


@given(st.integers(0, 10_000))
def test_conditioning_on_the_moments_of_an_update_is_the_update(seed):
    rng = np.random.default_rng(seed)
    belief = GaussianBelief(rng.normal(size=4), some_covariance(rng, 4))
    after = update(belief, rng.normal(size=2), POSITION, some_covariance(rng, 2)).belief
    ours = condition_on_position(belief, after.position_m, after.position_covariance_m2)
    np.testing.assert_allclose(ours.mean, after.mean, atol=1e-8)
    np.testing.assert_allclose(ours.covariance, after.covariance, atol=1e-8)


@given(st.floats(-4.0, 4.0))
def test_turning_keeps_speed_place_and_determinant(turn_rad):
    belief = GaussianBelief(np.array([1.0, 2.0, 0.5, 0.1]), some_covariance(np.random.default_rng(0), 4))
    turned = rotate_velocity(belief, turn_rad)
    np.testing.assert_array_equal(turned.position_m, belief.position_m)
    assert np.hypot(*turned.mean[2:]) == pytest.approx(np.hypot(0.5, 0.1))
    assert np.linalg.det(turned.covariance) == pytest.approx(np.linalg.det(belief.covariance))


def test_a_right_turn():
    belief = rotate_velocity(GaussianBelief(np.array([0.0, 0.0, 0.5, 0.0]), np.eye(4)), -np.pi / 2.0)
    np.testing.assert_allclose(belief.mean[2:], [0.0, -0.5], atol=1e-12)
