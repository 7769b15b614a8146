"""Calibrations over time, and devices beside each other."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import kstest

from app.calibration.drift import field_difference, fit_drift, sphere_directions
from app.calibration.ellipsoid import ellipsoid
from app.calibration.equivalence import _moved, compare_calibrations, compare_records, pair_by_place
from app.calibration.modified_ellipsoid import modified_ellipsoid
from app.calibration.sensor_model import SensorModel
from app.calibration.two_step import TWO_STEP_PARAMETERS, distortion
from app.errors import InvalidInput
from tests.calibration.conftest import H_UT, Z_UT, circle, directions


@pytest.fixture(scope="module")
def one():
    rng = np.random.default_rng(3)
    return ellipsoid(50.0 * directions(rng, 800) + [5.0, -3.0, 2.0] + 0.3 * rng.normal(size=(800, 3)), 50.0)


def again(fit, rng, moved=0.0):
    """The same calibration with errors of its covariance, its first hard iron moved."""
    off = rng.multivariate_normal(np.zeros(9), fit.covariance)
    values = np.array(list(fit.parameters.values())) + off
    values[0] += moved
    return replace(fit, parameters=dict(zip(fit.parameters, values, strict=True)))


def test_calibrations_that_are_the_same_are_said_to_be(one, rng):
    """p values of the chi-square test are uniform."""
    p = [fit_drift(range(4), [again(one, rng) for _ in range(4)]).p_same for _ in range(150)]
    assert kstest(p, "uniform").pvalue > 1e-3


def test_a_drift_is_found_with_its_uncertainty(one, rng):
    sd = one.parameter_sd["hard_iron_x_ut"]
    z = []
    for _ in range(60):
        days = np.array([0.0, 3.0, 10.0, 14.0, 20.0])
        drift = fit_drift(days, [again(one, rng, 2.0 * sd * day) for day in days])
        assert "hard_iron_x_ut" in drift.drifting
        z.append((drift.rate_per_day["hard_iron_x_ut"] - 2.0 * sd) / drift.rate_sd_per_day["hard_iron_x_ut"])
    assert 0.7 < np.std(z) < 1.3
    assert not drift.same
    assert drift.p_line > 1e-4
    assert "hard_iron_x_ut by +" in drift.words


def test_jumps_are_no_drift(one, rng):
    sd = one.parameter_sd["hard_iron_x_ut"]
    jumping = [again(one, rng, 15 * sd * jump) for jump in (1, -1, -1, 1)]
    drift = fit_drift([0.0, 1.0, 2.0, 3.0], jumping)
    assert not drift.same
    assert drift.drifting == ()
    assert "without a trend" in drift.words


def test_drift_of_what_cannot_be_compared(one):
    with pytest.raises(InvalidInput, match="at least two"):
        fit_drift([0.0], [one])
    with pytest.raises(InvalidInput, match="one method"):
        fit_drift([0.0, 1.0], [one, replace(one, method="two_step")])


def test_worst_error_over_all_directions():
    """An offset errs alike everywhere; a stretch of one axis by 10 % errs by 5 of 50 uT along it, 5/sqrt(3) rms."""
    ideal = SensorModel(np.zeros(3), np.eye(3))
    shifted = field_difference(SensorModel(np.array([3.0, 0.0, 4.0]), np.eye(3)), ideal, 50.0)
    assert shifted.worst_uT == pytest.approx(5.0)
    assert shifted.rms_uT == pytest.approx(5.0)
    stretched = field_difference(SensorModel(np.zeros(3), np.diag([1 / 1.1, 1.0, 1.0])), ideal, 50.0)
    assert stretched.worst_uT == pytest.approx(5.0, rel=1e-2)
    assert stretched.rms_uT == pytest.approx(5.0 / np.sqrt(3.0), rel=1e-2)
    assert abs(stretched.worst_direction[0]) > 0.99
    np.testing.assert_allclose(sphere_directions(500).mean(axis=0), 0.0, atol=1e-3)


def test_first_order_moves_are_those_of_the_models(rng):
    """Of two-step's parameters, about an ideal sensor, against the model itself."""
    ideal = np.array([1.0, 1.0, 1.0, 0, 0, 0, 0, 0, 0])
    step = 1e-5 * rng.normal(size=9)
    h, A = _moved(SensorModel(np.zeros(3), np.eye(3)), dict(zip(TWO_STEP_PARAMETERS, step, strict=True)))
    np.testing.assert_allclose(h, step[3:6])
    np.testing.assert_allclose(A, np.linalg.inv(distortion(ideal + step)) - np.eye(3), atol=1e-8)


@pytest.mark.parametrize(("moved", "verdict"), [(0.0, "equivalent"), (0.98, "not known"), (4.0, "different")])
def test_devices_by_their_calibrations(one, rng, moved, verdict):
    other = replace(
        one,
        parameters=one.parameters | {"hard_iron_x_ut": one.parameters["hard_iron_x_ut"] + moved},
        model=SensorModel(one.model.hard_iron_uT + moved * np.eye(3)[0], one.model.correction),
    )
    compared = compare_calibrations(one, other, 50.0, 1.0, rng)
    assert compared.verdict == verdict, compared.words
    assert compared.worst_uT == pytest.approx(moved, rel=0.05)
    assert (compared.p_same > 0.01) == (moved == 0.0)


def test_devices_by_paired_records(rng):
    """The turn and the shift between them are found, and the verdict follows the tolerance."""
    true = 5.0 * rng.normal(size=(400, 3)) + [15.0, 5.0, -42.0]
    turned = Rotation.from_rotvec(np.deg2rad([2.0, -1.0, 4.0]))
    first = true + 0.3 * rng.normal(size=true.shape)
    second = turned.inv().apply(true - [1.0, 0.5, -2.0]) + 0.3 * rng.normal(size=true.shape)
    compared = compare_records(first, second, 1.0)
    np.testing.assert_allclose(compared.rotation, turned.as_matrix(), atol=0.01)
    np.testing.assert_allclose(compared.shift_uT, [1.0, 0.5, -2.0], atol=0.4)
    assert compared.rms_after_uT == pytest.approx(0.3 * np.sqrt(2.0), rel=0.1)
    assert compared.verdict == "different"
    assert compare_records(first, second, 20.0).verdict == "equivalent"


def test_no_difference_is_uniform_chance(rng):
    """With errors in a row alike too."""
    p = []
    for _ in range(150):
        noise = np.repeat(rng.normal(size=(60, 3)), 3, axis=0) + 0.3 * rng.normal(size=(180, 3))
        p.append(compare_records(np.zeros((180, 3)), noise, 1.0).p_no_difference)
    assert np.mean(np.array(p) < 0.05) < 0.16


def test_records_of_the_same_places_at_other_times(rng):
    def field(p):
        return np.column_stack([15 + 5 * np.sin(p[:, 0]), 5 * np.cos(p[:, 1]), -42 + 3 * np.sin(p[:, 0] + p[:, 1])])

    first, second = rng.uniform(0, 10, (2, 1500, 2))
    pairs = pair_by_place(first, second, 0.3)
    distance = np.linalg.norm(first[pairs.first] - second[pairs.second], axis=1)
    assert distance.max() <= 0.3
    compared = compare_records(field(first)[pairs.first], field(second)[pairs.second] + [0.0, 0.0, 0.7], 1.0)
    np.testing.assert_allclose(compared.mean_difference_uT, [0.0, 0.0, 0.7], atol=0.15)
    assert compared.verdict == "equivalent"
    with pytest.raises(InvalidInput, match="too few"):
        compare_records(first[:4].repeat(2, 1)[:, :3], first[:4].repeat(2, 1)[:, :3], 1.0)


def test_what_is_said_to_be_certain_cannot_be_compared(one):
    certain = replace(one, covariance=np.zeros_like(one.covariance))
    with pytest.raises(InvalidInput, match="without any uncertainty"):
        compare_calibrations(certain, certain, 50.0, 1.0, np.random.default_rng(0))
    with pytest.raises(InvalidInput, match="without any uncertainty"):
        fit_drift(range(2), [certain, certain])


def test_a_sensor_of_coarse_steps_can_be_compared(rng):
    """Turned level, its z reads one and the same value throughout, of which it is not certain."""
    fits = [
        modified_ellipsoid(np.round((circle(np.eye(2), np.array([5.5, -7.0]), n)) / 0.15) * 0.15, H_UT, Z_UT)
        for n in (400, 500)
    ]
    for fit in fits:
        assert 0.0 < fit.parameter_sd["hard_iron_z_ut"] < 0.15
    assert compare_calibrations(*fits, 50.0, 1.0, rng).verdict == "equivalent"
    assert np.isfinite(fit_drift(range(2), fits).chi2)
