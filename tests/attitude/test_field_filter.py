"""The filter of attitude and field: the compiled log against plain steps, consistency, steps, the poles."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.attitude.disturbance import MagnitudeState, critical_value
from app.attitude.field_belief import FIELD, GRAVITY_M_S2, FieldFilter, InitialSpread, initial_belief
from app.attitude.field_filter import canonical, predict_field, update_field, update_gravity
from app.attitude.field_log import filter_log
from app.attitude.magnitude_log import follow_magnitude
from app.attitude.spherical_field import from_spherical, to_spherical
from app.errors import InvalidInput

SENSOR_SD = (0.3, 0.4, 0.5)
FILTER = FieldFilter(sensor_sd_uT=SENSOR_SD, fixed_sd=(0.42, 0.008, 0.015), gyro_noise_rad_per_s=2e-3)
SPREAD = InitialSpread(0.05, 0.005, 0.05, 0.05, 3.0)
THREE = FILTER.rule._replace(threshold=critical_value(3))
FORMS = {
    "magnitude": FILTER,
    "fixed noise": FILTER._replace(rotate_noise=False, adapt_angles=True),
    "spherical vector": FILTER._replace(vector_test=True, rule=THREE, direction_walk_rad=1e-3, magnitude_walk_uT=0.05),
    "Cartesian vector": FILTER._replace(spherical=False, vector_test=True, rule=THREE),
    "Cartesian norm": FILTER._replace(spherical=False, reject=False, magnitude_walk_uT=0.05),
}


def simulate(seed, n=500, field=(-2.0, 20.0, -44.0), step=None, tumble=0.7):
    """A tumbling body at 50 Hz: times, gyro, field, force, and a first attitude and extrinsic rotation slightly off."""
    rng = np.random.default_rng(seed)
    rate = np.zeros((n, 3))
    for k in range(1, n):
        rate[k] = 0.99 * rate[k - 1] + 0.14 * tumble * rng.normal(size=3)
    attitude, q = Rotation.random(rng=rng), []
    for turn in Rotation.from_rotvec(rate * 0.02):
        attitude = attitude * turn
        q.append(attitude.as_quat(scalar_first=True))
    body = Rotation.from_quat(np.array(q), scalar_first=True)
    B = np.tile(field, (n, 1)).astype(float)
    if step is not None:
        B[n // 2 :] += step
    sensor = Rotation.from_rotvec([0.1, -0.2, 0.3])
    reading = sensor.inv().apply(body.inv().apply(B)) + rng.normal(size=(n, 3)) * SENSOR_SD
    force = body.inv().apply(np.tile([0.0, 0.0, GRAVITY_M_S2], (n, 1))) + 0.1 * rng.normal(size=(n, 3))
    gyro = rate + 2e-3 * np.sqrt(50.0) * rng.normal(size=(n, 3))
    first = body[0] * Rotation.from_rotvec(0.05 * rng.normal(size=3))
    return np.arange(n) * 0.02, gyro, reading, force, first, sensor, body


def started(filter_, reading, first, sensor, spread=SPREAD):
    return initial_belief(
        filter_, first.as_quat(scalar_first=True), reading[0], spread, sensor.as_quat(scalar_first=True)
    )


def by_steps(belief, filter_, t, gyro, B, force=None):
    state, seen = MagnitudeState(), []
    for k in range(len(t)):
        belief = predict_field(belief, filter_, gyro[k], t[k] - t[max(k - 1, 0)])
        if force is not None and np.isfinite(force[k]).all():
            belief = update_gravity(belief, filter_, force[k])
        if np.isfinite(B[k]).all():
            updated = update_field(belief, filter_, state, t[k], B[k])
            belief, state = updated.belief, updated.state
            seen.append(
                (updated.watched.outlier, updated.watched.found, updated.watched.innovation_uT, updated.statistic)
            )
    return belief, np.array(seen)


@pytest.mark.parametrize("form", FORMS)
def test_the_compiled_log_is_the_plain_steps(form):
    filter_ = FORMS[form]
    t, gyro, B, force, first, sensor, _ = simulate(0, n=240, step=np.array([0.0, 6.0, -9.0]))
    B[5:40:3] = np.nan  # the magnetometer is the slower sensor
    force[::2] = np.nan
    start = started(filter_, B, first, sensor)
    log = filter_log(start, filter_, t, gyro, B, force)
    belief, seen = by_steps(start, filter_, t, gyro, B, force)
    heard = np.isfinite(log.statistic)
    np.testing.assert_array_equal(heard, np.isfinite(B).all(axis=1))
    np.testing.assert_array_equal(log.outlier[heard], seen[:, 0])
    np.testing.assert_array_equal(log.found[heard], seen[:, 1])
    assert log.found.any()
    np.testing.assert_allclose(log.innovation_uT[heard], seen[:, 2], atol=1e-8)
    np.testing.assert_allclose(log.statistic[heard], seen[:, 3], rtol=1e-6, atol=1e-8)
    np.testing.assert_allclose(log.last.covariance, belief.covariance, atol=1e-9)
    np.testing.assert_allclose(log.last.field, belief.field, atol=1e-8)
    for a, b in (
        (log.last.q_body_to_building, belief.q_body_to_building),
        (log.last.q_sensor_to_body, belief.q_sensor_to_body),
    ):
        assert abs(a @ b) == pytest.approx(1.0, abs=1e-12)


def test_the_magnitude_is_a_filter_of_its_own():
    """Decoupled from attitude: the whole filter's magnitude is that of the scalar filter on |B| (Brommer, L187).

    With isotropic noise, so that R has no cross terms, and no prior cross terms either.
    """
    filter_ = FILTER._replace(sensor_sd_uT=(0.4, 0.4, 0.4))
    t, gyro, B, _, first, sensor, _ = simulate(1, step=np.array([0.0, 3.0, -6.0]))
    log = filter_log(started(filter_, B, first, sensor), filter_, t, gyro, B)
    size = np.linalg.norm(B, axis=1)
    alone = follow_magnitude(t, size, 0.16, start=(float(size[0]), SPREAD.field_uT**2))
    np.testing.assert_allclose(log.predicted_uT, alone.predicted_uT, atol=1e-8)
    np.testing.assert_array_equal(log.outlier, alone.outlier)
    assert log.events == alone.events
    assert len(log.events) == 1


@pytest.mark.slow
def test_rates_of_outliers_are_nominal_with_rotated_noise_and_below_it_with_fixed():
    """0.27 +- 0.1 % with R = J R J^T; the sensor's noise is not the same along all axes (Brommer, Table IV)."""
    shares = {}
    for name in ("magnitude", "fixed noise"):
        filter_ = FORMS[name]._replace(sensor_sd_uT=(0.2, 0.3, 0.6), fixed_sd=(0.6, 0.01, 0.02), reject=False)
        shares[name] = []
        for seed in range(3):
            t, gyro, _, _, first, sensor, body = simulate(seed, n=8_000)
            rng = np.random.default_rng(seed + 100)
            B = sensor.inv().apply(body.inv().apply([-2.0, 20.0, -44.0])) + rng.normal(size=(len(t), 3)) * [
                0.2,
                0.3,
                0.6,
            ]
            shares[name].append(filter_log(started(filter_, B, first, sensor), filter_, t, gyro, B).outlier.mean())
    assert 100 * np.mean(shares["magnitude"]) == pytest.approx(0.27, abs=0.1)
    assert np.mean(shares["fixed noise"]) < 0.5 * np.mean(shares["magnitude"])


def test_a_step_along_the_field_is_found_by_the_eleventh_reading_and_taken_in():
    field = np.array([-2.0, 20.0, -44.0])
    t, gyro, B, _, first, sensor, _ = simulate(4, n=2000, step=3.5 * field / np.linalg.norm(field))
    log = filter_log(started(FILTER, B, first, sensor), FILTER, t, gyro, B)
    (event,) = log.events
    assert event.start_s == pytest.approx(20.0)
    assert event.found_s == pytest.approx(20.2)
    assert abs(log.field[1015, 0] - np.linalg.norm(field) - 3.5) < 0.5
    held = FILTER._replace(adapt=False, reject=False)
    assert (
        abs(filter_log(started(held, B, first, sensor), held, t, gyro, B).field[1015, 0] - np.linalg.norm(field)) < 1.0
    )


def test_a_turn_of_the_field_is_no_event_of_the_magnitude():
    field = np.array([-2.0, 20.0, -44.0])
    turned = Rotation.from_rotvec([0.0, 0.0, 0.5]).apply(field)
    t, gyro, B, _, first, sensor, _ = simulate(5, step=turned - field)
    assert filter_log(started(FILTER, B, first, sensor), FILTER, t, gyro, B).events == ()


def test_adapted_angles_let_the_direction_follow():
    step = np.array([12.0, -4.0, -6.0])
    far = []
    for adapt_angles in (False, True):
        filter_ = FILTER._replace(adapt_angles=adapt_angles, gyro_noise_rad_per_s=1e-4)
        t, gyro, B, force, _, sensor, body = simulate(6, n=1500, step=step)
        known = InitialSpread(0.02, 0.0, 0.0, 0.0, 1.0)
        log = filter_log(started(filter_, B, body[0], sensor, known), filter_, t, gyro, B, force)
        apart = Rotation.from_quat(log.q_body_to_building, scalar_first=True).inv() * body
        far.append(float(np.degrees(apart[760:900].magnitude()).mean()))
    assert far[1] < 0.5 * far[0]  # attitude is not dragged along


@pytest.mark.parametrize("form", FORMS)
def test_covariances_stay_positive_through_events(form):
    filter_ = FORMS[form]
    t, gyro, B, _, first, sensor, _ = simulate(7, n=600, step=np.array([15.0, 0.0, -20.0]))
    belief, state, smallest = started(filter_, B, first, sensor), MagnitudeState(), np.inf
    adapted = 0
    for k in range(len(t)):
        belief = predict_field(belief, filter_, gyro[k], 0.02)
        updated = update_field(belief, filter_, state, t[k], B[k])
        belief, state = updated.belief, updated.state
        adapted += updated.watched.found
        if k % 10 == 0 or updated.watched.found:
            P = belief.covariance
            np.testing.assert_allclose(P, P.T, atol=1e-9 * np.abs(P).max())
            scale = np.sqrt(np.diag(P))
            smallest = min(smallest, np.linalg.eigvalsh(P / scale[:, None] / scale).min())
    assert adapted >= 1
    assert smallest > -1e-9


@pytest.mark.parametrize("field", [(0.0, 0.0, -48.0), (1e-9, 0.0, 48.0)])
def test_a_vertical_field_and_a_sensor_held_along_it(field):
    """Both poles at once: the field along the building's z, the sensor's z along the field."""
    t, gyro, B, *_ = simulate(8, n=400, field=field, tumble=0.05)
    upright = Rotation.identity()
    B = upright.inv().apply(np.tile(field, (len(t), 1))) + np.random.default_rng(0).normal(size=(len(t), 3)) * SENSOR_SD
    B[7] = field  # exactly on the pole
    still = np.zeros_like(gyro)
    start = started(FILTER, np.tile(field, (1, 1)), upright, Rotation.identity())
    log = filter_log(start, FILTER, t, still, B)
    assert np.isfinite(log.field).all()
    assert abs(log.field[-1, 0] - 48.0) < 0.2
    apart = np.arccos(from_spherical(log.field[-1]) @ np.array(field) / 48.0 / log.field[-1, 0])
    assert apart < 0.1
    assert log.outlier.mean() < 0.02
    belief, _ = by_steps(start, FILTER, t, still, B)
    np.testing.assert_allclose(from_spherical(belief.field), from_spherical(log.field[-1]), atol=1e-6)


def test_gravity_levels_the_attitude_and_learns_the_accelerometers_bias():
    t, gyro, B, force, first, sensor, body = simulate(9, n=3000)
    bias = np.array([0.15, -0.1, 0.2])
    spread = SPREAD._replace(accelerometer_bias_m_s2=0.2)
    log = filter_log(started(FILTER, B, first, sensor, spread), FILTER, t, gyro, B, force + bias)
    np.testing.assert_allclose(log.last.accelerometer_bias_m_s2, bias, atol=0.05)
    up = Rotation.from_quat(log.q_body_to_building[-1], scalar_first=True).inv().apply([0, 0, 1.0])
    assert np.degrees(np.arccos(up @ body[-1].inv().apply([0, 0, 1.0]))) < 1.0
    held = filter_log(
        started(FILTER, B, first, sensor, SPREAD._replace(accelerometer_bias_m_s2=0.0)), FILTER, t, gyro, B, force
    )
    np.testing.assert_array_equal(held.last.accelerometer_bias_m_s2, 0.0)


@given(st.floats(-80.0, 80.0), st.floats(-7.0, 7.0), st.floats(-10.0, 10.0))
def test_canonical_is_the_same_vector_in_range_with_the_signs_of_its_derivative(r, theta, phi):
    m = np.array([r, theta, phi])
    found, signs = canonical(m)
    np.testing.assert_allclose(from_spherical(found), from_spherical(m), atol=1e-9)
    assert found[0] >= 0.0
    assert 0.0 <= found[1] <= np.pi
    assert 0.0 <= found[2] < 2 * np.pi
    moved = np.array([1e-6, 1e-6, 1e-6])
    np.testing.assert_allclose(from_spherical(found + signs * moved), from_spherical(m + moved), atol=1e-9)


def test_the_first_beliefs_angles_are_as_unsure_as_its_components():
    belief = initial_belief(FILTER, np.array([1.0, 0, 0, 0]), np.array([30.0, 0.0, -40.0]), SPREAD)
    np.testing.assert_allclose(belief.field, to_spherical(np.array([30.0, 0.0, -40.0])))
    np.testing.assert_allclose(np.sqrt(np.diag(belief.covariance)[FIELD]), [3.0, 3.0 / 50.0, 3.0 / 30.0])


def test_a_field_of_zero_is_refused():
    t, gyro, B, _, first, sensor, _ = simulate(10, n=10)
    start = started(FILTER, B, first, sensor)
    B[3] = 0.0
    with pytest.raises(InvalidInput, match="reading 3 is zero"):
        filter_log(start, FILTER, t, gyro, B)
