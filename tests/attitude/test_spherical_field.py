"""Magnitude and angles: round trips, derivatives against differences, the poles, and the sensor's statistics."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.attitude.cartesian_field import norm_variance, predict_cartesian
from app.attitude.spherical_field import (
    cartesian_jacobian,
    from_spherical,
    pole_axis,
    predict_spherical,
    spherical_covariance,
    spherical_jacobian,
    spherical_residual,
    to_spherical,
    with_pole,
)
from app.errors import InvalidInput

TABLE_MEAN = np.array([-103.622, 1157.296, 2175.026])
TABLE_SD = np.array([14.668, 16.293, 21.162])

component = st.floats(-80.0, 80.0)
vectors = st.tuples(component, component, component).map(np.array).filter(lambda v: np.hypot(v[0], v[1]) > 1.0)
turns = st.tuples(*[st.floats(-3.0, 3.0)] * 3).map(lambda v: Rotation.from_rotvec(v))
spherical = st.tuples(st.floats(5.0, 80.0), st.floats(0.1, 3.04), st.floats(0.0, 6.28)).map(np.array)


def differences(function, at, step=1e-6):
    columns = [(function(at + e) - function(at - e)) / (2 * step) for e in step * np.eye(3)]
    return np.stack(columns, axis=-1)


@given(vectors)
def test_there_and_back_is_the_same_vector(B):
    m = to_spherical(B)
    assert m[0] >= 0.0
    assert 0.0 <= m[1] <= np.pi
    assert 0.0 <= m[2] < 2 * np.pi
    np.testing.assert_allclose(from_spherical(m), B, atol=1e-11)


@given(spherical)
def test_back_and_there_are_the_same_angles(m):
    np.testing.assert_allclose(to_spherical(from_spherical(m)), m, atol=1e-11)


@given(vectors)
def test_derivatives_of_the_angles_are_those_of_differences(B):
    found = differences(lambda v: spherical_residual(to_spherical(v), to_spherical(B)), B)
    np.testing.assert_allclose(spherical_jacobian(B), found, atol=1e-6)


@given(spherical)
def test_derivatives_of_the_components_are_those_of_differences(m):
    np.testing.assert_allclose(cartesian_jacobian(m), differences(from_spherical, m), atol=1e-6)
    np.testing.assert_allclose(spherical_jacobian(from_spherical(m)) @ cartesian_jacobian(m), np.eye(3), atol=1e-9)


def test_batches_are_their_members():
    B = np.random.default_rng(0).normal(size=(4, 5, 3))
    assert to_spherical(B).shape == (4, 5, 3)
    np.testing.assert_array_equal(to_spherical(B)[2, 3], to_spherical(B[2, 3]))
    np.testing.assert_array_equal(spherical_jacobian(B)[1, 4], spherical_jacobian(B[1, 4]))
    np.testing.assert_array_equal(cartesian_jacobian(to_spherical(B))[1, 4], cartesian_jacobian(to_spherical(B[1, 4])))


def test_along_z_there_is_an_angle_but_no_derivative():
    np.testing.assert_array_equal(to_spherical(np.array([0.0, 0.0, 50.0])), [50.0, 0.0, 0.0])
    np.testing.assert_allclose(to_spherical(np.array([0.0, -0.0, -50.0])), [50.0, np.pi, 0.0])
    with pytest.raises(InvalidInput, match="another axis"):
        spherical_jacobian(np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 50.0]]))


def test_an_azimuth_a_hair_below_zero_is_in_range():
    assert to_spherical(np.array([1.0, -1e-20, 0.0]))[2] < 2 * np.pi


def test_residuals_of_azimuths_go_the_short_way():
    np.testing.assert_allclose(
        spherical_residual(np.array([1.0, 1.0, 0.1]), np.array([1.0, 1.0, 6.2]))[2], 0.1 - 6.2 + 2 * np.pi
    )


def test_the_sensors_statistics_agree_with_each_other():
    """Table I (Brommer, L57-68): the spherical means and sds follow from the Cartesian ones."""
    m = to_spherical(TABLE_MEAN)
    sd = np.sqrt(np.diag(spherical_covariance(TABLE_MEAN, np.diag(TABLE_SD**2))))
    assert m[0] == pytest.approx(2466.039, abs=0.2)
    assert 90.0 - np.degrees(m[1]) == pytest.approx(61.885, abs=0.01)
    assert np.degrees(m[2]) == pytest.approx(95.116, abs=0.01)
    np.testing.assert_allclose([sd[0], *np.degrees(sd[1:])], [19.823, 0.415, 0.725], rtol=0.03)


@given(turns, turns, spherical)
def test_the_rows_of_the_reading(body, sensor, m):
    to_building, to_body = body.as_matrix(), sensor.as_matrix()
    pole = with_pole(pole_axis(to_body.T @ to_building.T @ from_spherical(m)))

    def reading(d_attitude, d_extrinsic, d_field):
        attitude = (body * Rotation.from_rotvec(d_attitude)).inv()
        return to_spherical(
            pole @ (sensor * Rotation.from_rotvec(d_extrinsic)).inv().apply(attitude.apply(from_spherical(m + d_field)))
        )

    seen = predict_spherical(to_building, to_body, m, pole)
    zero = np.zeros(3)
    np.testing.assert_allclose(spherical_residual(reading(zero, zero, zero), seen.reading), 0.0, atol=1e-9)
    for given_rows, moved in (
        (seen.by_attitude, lambda d: reading(d, zero, zero)),
        (seen.by_extrinsic, lambda d: reading(zero, d, zero)),
        (seen.by_field, lambda d: reading(zero, zero, d)),
    ):
        found = differences(lambda d, moved=moved: spherical_residual(moved(d), seen.reading), zero)
        np.testing.assert_allclose(given_rows, found, atol=2e-6)
    np.testing.assert_array_equal(seen.by_field[0], [1.0, 0.0, 0.0])
    np.testing.assert_array_equal(seen.by_field[:, 0], [1.0, 0.0, 0.0])
    assert not seen.by_attitude[0].any()
    assert not seen.by_extrinsic[0].any()


@given(turns, turns, vectors)
def test_the_rows_of_the_cartesian_reading(body, sensor, B):
    def reading(d_attitude, d_extrinsic, d_field):
        attitude = (body * Rotation.from_rotvec(d_attitude)).inv()
        return (sensor * Rotation.from_rotvec(d_extrinsic)).inv().apply(attitude.apply(B + d_field))

    seen, zero = predict_cartesian(body.as_matrix(), sensor.as_matrix(), B), np.zeros(3)
    np.testing.assert_allclose(seen.reading, reading(zero, zero, zero), atol=1e-10)
    np.testing.assert_allclose(seen.by_attitude, differences(lambda d: reading(d, zero, zero), zero), atol=1e-6)
    np.testing.assert_allclose(seen.by_extrinsic, differences(lambda d: reading(zero, d, zero), zero), atol=1e-6)
    np.testing.assert_allclose(seen.by_field, differences(lambda d: reading(zero, zero, d), zero), atol=1e-6)


@given(st.floats(0.0, np.pi), st.floats(0.0, 2 * np.pi))
def test_the_pole_is_never_near_the_field(theta, phi):
    B = from_spherical(np.array([50.0, theta, phi]))
    turned = with_pole(pole_axis(B)) @ B
    assert np.hypot(turned[0], turned[1]) > 0.4 * 50.0


def test_poles_are_rotations():
    for axis in range(3):
        pole = with_pole(axis)
        assert np.linalg.det(pole) == 1.0
        np.testing.assert_array_equal(pole @ np.eye(3)[axis], [0.0, 0.0, 1.0])


def test_the_norms_variance_is_that_of_draws():
    rng = np.random.default_rng(1)
    draws = np.linalg.norm(TABLE_MEAN + rng.normal(size=(200_000, 3)) * TABLE_SD, axis=1)
    variance = float(norm_variance(TABLE_MEAN, np.diag(TABLE_SD**2)))
    assert variance == pytest.approx(draws.var(), rel=0.02)
    assert variance == pytest.approx(spherical_covariance(TABLE_MEAN, np.diag(TABLE_SD**2))[0, 0])
