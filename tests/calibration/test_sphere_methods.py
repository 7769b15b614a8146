"""Calibrations of a device turned through all directions: ellipsoid and two-step, their covariances, and refusals."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.stats import chi2

from app.calibration.conic import fit_without_constant, symmetric_root
from app.calibration.ellipsoid import ellipsoid
from app.calibration.modified_ellipsoid import alpha_of
from app.calibration.norm_fit import symmetric_parameters, symmetric_start
from app.calibration.two_step import _jacobian, _linearise, _shortfall, distortion, two_step
from app.errors import InvalidInput
from tests.calibration.conftest import directions

B_R = 53.1351  # (Kuevor, L508)
TABLE_3_1 = np.array([1.01, 0.955, 0.942, -1.26, -2.46, 3.24, *np.deg2rad([0.182, 2.28, -0.118])])  # (Kuevor, L1143)


def values(fit):
    return np.array(list(fit.parameters.values()))


def test_the_model_is_the_corrected_equations():
    """Eqs. 2.4-2.6 written out, with the true B_y on the right and theta_c before the bracket (items 4.2, 4.3)."""
    a, b, c, x0, y0, z0, rho, lam, phi = TABLE_3_1
    Bx, By, Bz = true = np.array([12.0, -31.0, 40.0])
    measured = [
        a * Bx + x0,
        b * (By * np.cos(rho) + Bx * np.sin(rho)) + y0,
        c * (Bx * np.sin(lam) + By * np.sin(phi) * np.cos(lam) + Bz * np.cos(phi) * np.cos(lam)) + z0,
    ]
    np.testing.assert_allclose(distortion(TABLE_3_1) @ true + TABLE_3_1[3:6], measured, rtol=1e-14)


def test_table_3_1_is_recovered(rng, sphere):
    """2000 orientations, 0.1 uT: scales to 0.001, biases to 0.02 uT; the sds say how often angles are to 0.01 deg."""
    B = sphere(rng, distortion(TABLE_3_1), TABLE_3_1[3:6], B_R, 0.1, 2000)
    raw = np.linalg.norm(B, axis=1) - B_R
    assert np.sqrt(np.mean(raw**2)) == pytest.approx(3.1, abs=0.2)  # the spec's own check of B6
    found = two_step(B, B_R)
    error = np.abs(values(found) - TABLE_3_1)
    assert np.all(error[:3] < 0.001)
    assert np.all(error[3:6] < 0.02)
    assert np.all(error[6:] < np.deg2rad(0.025))
    assert found.residual_rms_uT == pytest.approx(0.1, abs=0.01)


def test_jacobians_agree_with_differences(rng, sphere):
    B = sphere(rng, distortion(TABLE_3_1), TABLE_3_1[3:6], B_R, 0.0, 20)
    theta, h = TABLE_3_1 * 1.02, 1e-6
    steps = h * np.eye(9)
    differences = [(_shortfall(B, theta + s, B_R) - _shortfall(B, theta - s, B_R)) / (2 * h) for s in steps]
    np.testing.assert_allclose(_jacobian(B, theta), np.array(differences).T, rtol=1e-6, atol=1e-3)
    correction = [(_linearise(theta + s).correction - _linearise(theta - s).correction) / (2 * h) for s in steps]
    np.testing.assert_allclose(_linearise(theta).d_correction, correction, atol=1e-8)


def test_hard_iron_far_stronger_than_the_field(rng, sphere):
    """A phone: 300 uT around a field of 50."""
    b = np.array([300.0, -180.0, 240.0])
    B = sphere(rng, distortion(TABLE_3_1), b, B_R, 0.3)
    for fit in (two_step(B, B_R), two_step(B, B_R, refined=False), ellipsoid(B, B_R)):
        np.testing.assert_allclose(fit.model.hard_iron_uT, b, atol=0.1)
        np.testing.assert_allclose(np.linalg.norm(fit.model.apply(B), axis=1), B_R, atol=1.6)


def test_source_without_its_constant_and_the_remedy():
    """Literal norms 543.652 mG where the field has 532.4378; with s the matrix is exact (Shockley, 3.4)."""
    A = np.array([[1.05, 0.03, -0.02], [0.03, 0.97, 0.04], [-0.02, 0.04, 1.1]])
    b, R = np.array([4.0, -6.0, 8.0]), 53.24378
    B = R * directions(np.random.default_rng(0), 400) @ np.linalg.inv(A).T + b
    conic = fit_without_constant(B, R)
    norms = np.linalg.norm((B - conic.hard_iron_uT) @ symmetric_root(conic.Q).T, axis=1)
    np.testing.assert_allclose(norms, 54.3652, atol=2e-4)
    s = alpha_of(conic.Q, conic.hard_iron_uT, R)
    np.testing.assert_allclose(symmetric_root(s * conic.Q), A, atol=1e-10)
    np.testing.assert_allclose(ellipsoid(B, R).model.correction, A, atol=1e-9)


@settings(max_examples=20)
@given(st.integers(0, 10_000), st.floats(0.0, 300.0), st.floats(25.0, 65.0))
def test_both_agree_up_to_a_rotation(seed, hard_iron_uT, field_uT):
    """Whatever sensor: norms come out right, the same hard iron, and corrections that differ by a rotation alone."""
    rng = np.random.default_rng(seed)
    M = np.eye(3) + rng.uniform(-0.12, 0.12, (3, 3))
    b = hard_iron_uT * directions(rng, 1)[0]
    B = field_uT * directions(rng, 300) @ M.T + b
    one, other = ellipsoid(B, field_uT), two_step(B, field_uT)
    np.testing.assert_allclose(one.model.hard_iron_uT, b, atol=1e-5)
    np.testing.assert_allclose(other.model.hard_iron_uT, b, atol=1e-5)
    turned = one.model.correction @ np.linalg.inv(other.model.correction)
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-6)


@pytest.mark.parametrize("noise_uT", [0.1, 2.0])
def test_covariances_are_true_and_estimates_unbiased(rng, sphere, noise_uT):
    """At 4 % noise too, where the plain least squares is off by many sds."""
    runs, off, plain = 70, [], []
    for _ in range(runs):
        B = sphere(rng, distortion(TABLE_3_1), TABLE_3_1[3:6], B_R, noise_uT, 600)
        found = two_step(B, B_R)
        off.append((values(found) - TABLE_3_1) @ np.linalg.inv(np.linalg.cholesky(found.covariance)).T)
        plain.append(values(two_step(B, B_R, refined=False)) - TABLE_3_1)
    squared = np.sum(np.square(off), axis=1)
    low, high = chi2.ppf([5e-4, 1 - 5e-4], runs * 9) / runs
    assert low * 0.95 < squared.mean() < high * 1.1
    assert np.all(np.abs(np.mean(off, axis=0)) < 4.0 / np.sqrt(runs))
    if noise_uT > 1.0:  # what the literal form does: scales come out long
        z = np.mean(plain, axis=0) / (np.std(plain, axis=0) / np.sqrt(runs))
        assert np.all(z[:3] > 6.0)


def test_ellipsoid_covariance_is_true(rng, sphere):
    A = np.array([[1.05, 0.03, -0.02], [0.03, 0.97, 0.04], [-0.02, 0.04, 1.1]])
    truth = symmetric_start(A, np.array([4.0, -6.0, 8.0]))
    assert np.allclose(symmetric_parameters(3)(truth).correction, A)
    squared = []
    for _ in range(100):
        found = ellipsoid(sphere(rng, np.linalg.inv(A), truth[:3], 50.0, 0.5, 600), 50.0)
        error = values(found) - truth
        squared.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([5e-4, 1 - 5e-4], 900) / 100
    assert low * 0.95 < np.mean(squared) < high * 1.1


def test_errors_that_go_on_widen_the_sds(rng, sphere):
    """Readings whose errors last are worth less: sds must not shrink with the rate alone."""
    b = np.zeros(3)
    white = sphere(rng, np.eye(3), b, 50.0, 0.3, 600)
    lasting = np.repeat(white, 8, axis=0) + 0.01 * rng.normal(size=(4800, 3))
    one, many = ellipsoid(white, 50.0), ellipsoid(lasting, 50.0)
    ratio = np.array(list(many.parameter_sd.values())) / np.array(list(one.parameter_sd.values()))
    assert np.all(ratio > 0.85)


def test_spikes_are_left_out(rng, sphere):
    B = sphere(rng, distortion(TABLE_3_1), TABLE_3_1[3:6], B_R, 0.2, 1000)
    B[::40] += 60.0 * directions(rng, 25)
    for fit in (two_step(B, B_R), ellipsoid(B, B_R)):
        np.testing.assert_allclose(np.linalg.norm(fit.model.apply(B[1::40]), axis=1), B_R, atol=1.0)
        assert 20 <= fit.outliers <= 30
    np.testing.assert_allclose(values(two_step(B, B_R))[:6], TABLE_3_1[:6], atol=0.1)


@pytest.mark.parametrize("method", [ellipsoid, two_step])
@pytest.mark.parametrize("noise_uT", [0.0, 0.2])
def test_a_circle_is_no_sphere(rng, method, noise_uT):
    """Rank 5 of 9; the advice names the axis the device never showed to the field (Shockley, 3.6, item 9)."""
    angle = np.linspace(0.0, 6 * np.pi, 2000)
    B = np.column_stack([20 * np.cos(angle), 20 * np.sin(angle), np.full(2000, -45.0)])
    with pytest.raises(InvalidInput, match=r"\+z of the sensor were not seen: tilt"):
        method(B + noise_uT * rng.normal(size=B.shape), 49.2)


@pytest.mark.parametrize("method", [ellipsoid, two_step])
def test_a_cap_is_not_enough(rng, method):
    """Level but for a wobble of a few degrees."""
    tilt, angle = rng.uniform(-0.14, 0.14, 1500), rng.uniform(0, 2 * np.pi, 1500)
    B = 50 * np.column_stack([np.cos(tilt) * np.cos(angle), np.cos(tilt) * np.sin(angle), np.sin(tilt)])
    with pytest.raises(InvalidInput, match="What to do"):
        method(B + 0.3 * rng.normal(size=B.shape), 50.0)


def test_half_a_sphere_is_advised_upon(rng, sphere):
    B = sphere(rng, np.eye(3), np.zeros(3), 50.0, 0.2, 3000)
    fit = ellipsoid(B[B[:, 2] < 5.0], 50.0)
    assert fit.coverage.unseen_axes == ("+z",)
    assert "+z" in fit.advice[0]
    np.testing.assert_allclose(fit.model.hard_iron_uT, 0.0, atol=5 * fit.parameter_sd["hard_iron_z_ut"])


def test_a_field_that_is_not_constant_is_refused(rng):
    B = 50.0 * directions(rng, 1000) * rng.uniform(0.6, 1.4, (1000, 1))
    for method in (ellipsoid, two_step):
        with pytest.raises(InvalidInput, match="move away from steel"):
            method(B, 50.0)
