"""Calibration on a map: the truth is found with honest sds, and what a walk cannot tell is said."""

import numpy as np
import pytest
from scipy.linalg import cholesky, solve_triangular
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from app.calibration.map_aided import _whiten, map_aided
from app.errors import InvalidInput

STEP_M, LENGTH_M = 0.15, 3.0
IDENTITY = np.concatenate([np.zeros(3), np.eye(3).ravel()])


def lasting(rng, n):
    """(n, 3) of unit sd, correlated over LENGTH_M."""
    out, keep = rng.normal(size=(n, 3)), np.exp(-STEP_M / LENGTH_M)
    for i in range(1, n):
        out[i] = keep * out[i - 1] + np.sqrt(1 - keep**2) * out[i]
    return out


def walked(rng, theta, *, n=400, tilted=0.5, turning=0.15, map_sd_uT=0.8, varying=5.0):
    """What `map_aided` takes, of a sensor with these twelve parameters."""
    path = STEP_M * np.arange(n)
    yaw = np.cumsum(turning * rng.normal(size=n))
    tilt = tilted * np.sin(np.arange(n) / 20)
    R = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt, tilt[::-1]])).as_matrix()
    wave = np.column_stack([np.sin(path), np.cos(0.7 * path), np.sin(0.5 * path + 1)])
    B_map = np.array([18.0, 3.0, -42.0]) + varying * wave
    true = B_map + map_sd_uT * lasting(rng, n)
    body = np.einsum("nji,nj->ni", R, true)
    reading = body @ theta[3:].reshape(3, 3).T + theta[:3] + 0.4 * rng.normal(size=(n, 3))
    return reading, R, B_map, np.full((n, 3), max(map_sd_uT, 0.05) ** 2), path


def drawn(rng):
    return IDENTITY + rng.normal(size=12) * np.repeat([30.0, 0.1], [3, 9])


def test_whitening_is_that_of_the_whole_covariance(rng):
    """Against a dense Cholesky factor."""
    n = 30
    keep, variance = rng.uniform(0.2, 1.0, n), rng.uniform(0.2, 3.0, (n, 3))
    white = rng.uniform(0.1, 0.5, n)
    columns = rng.normal(size=(n, 3, 4))
    log_keep = np.cumsum(np.log(keep))
    correlation = np.exp(-np.abs(log_keep[:, None] - log_keep))
    for axis in range(3):
        sd = np.sqrt(variance[:, axis])
        L = cholesky(np.outer(sd, sd) * correlation + np.diag(white), lower=True)
        expected = solve_triangular(L, columns[:, axis], lower=True)
        np.testing.assert_allclose(_whiten(columns, variance, white, keep)[:, axis], expected, atol=1e-10)


@pytest.mark.parametrize("tilted", [0.0, 0.5])
def test_covariance_is_true(rng, tilted):
    runs, squared = 40, []
    for _ in range(runs):
        theta = drawn(rng)
        *given, path = walked(rng, theta, tilted=tilted)
        found = map_aided(*given, path_m=path)
        error = np.array(list(found.parameters.values())) - theta
        squared.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([5e-4, 1 - 5e-4], runs * 12) / runs
    assert low * 0.9 < np.mean(squared) < high * 1.15  # of the map's error, C has turned what R was told of


def test_taking_lasting_errors_for_white_ones_would_boast(rng):
    """Without the path the same walk claims sds that its errors mock."""
    squared = []
    for _ in range(25):
        theta = drawn(rng)
        *given, _ = walked(rng, theta)
        found = map_aided(*given)
        error = np.array(list(found.parameters.values())) - theta
        squared.append(error @ np.linalg.solve(found.covariance, error))
    assert np.mean(squared) > 2 * 12


def test_rotation_of_the_sensor_in_the_body_is_found(rng):
    """What no fit of strengths can: the sensor is mounted 5 degrees askew."""
    mounted = Rotation.from_rotvec(np.deg2rad([3.0, -4.0, 1.0])).as_matrix()
    theta = np.concatenate([[10.0, -20.0, 5.0], mounted.ravel()])
    *given, path = walked(rng, theta)
    found = map_aided(*given, path_m=path)
    np.testing.assert_allclose(np.linalg.inv(found.model.correction), mounted, atol=0.05)
    assert found.undetermined == ()


def test_a_walk_that_never_turned_nor_tilted_says_so(rng):
    """Straight through a uniform field: hardly more is known than was assumed."""
    *given, path = walked(rng, IDENTITY, tilted=0.0, turning=0.0, varying=0.0)
    found = map_aided(*given, path_m=path)
    assert "hard_iron_z_ut" in found.undetermined or "distortion_zz" in found.undetermined
    assert {"distortion_xy", "distortion_yx"} <= set(found.undetermined)
    assert any("loop" in each for each in found.advice)
    assert any("tilt" in each for each in found.advice)
    for name in found.undetermined:
        assert found.parameter_sd[name] > 0.5 * (30.0 if name.endswith("_ut") else 0.1)


def test_what_is_not_known_does_no_harm_as_held(rng):
    """Level all along: scale and offset of the vertical are one, but what comes out of them is right."""
    theta = drawn(rng)
    *given, path = walked(rng, theta, tilted=0.0)
    found = map_aided(*given, path_m=path)
    reading, R, B_map, _ = given
    off = np.einsum("nij,nj->ni", R, found.model.apply(reading)) - B_map
    assert np.all(np.sqrt(np.mean(off**2, axis=0)) < 1.3)


def test_unmapped_steel_and_spikes_weigh_little(rng):
    theta = drawn(rng)
    reading, R, B_map, variance, path = walked(rng, theta)
    clean = map_aided(reading, R, B_map, variance, path_m=path)
    spoilt = reading.copy()
    spoilt[::30] += 40.0 * rng.normal(size=(len(spoilt[::30]), 3))
    found = map_aided(spoilt, R, B_map, variance, path_m=path)
    moved = np.array(list(found.parameters.values())) - np.array(list(clean.parameters.values()))
    assert np.all(np.abs(moved) < 3.0 * np.array(list(clean.parameter_sd.values())))
    assert found.outliers >= 8


def test_bad_arrays_are_refused(rng):
    reading, R, B_map, variance, path = walked(rng, IDENTITY)
    with pytest.raises(InvalidInput, match="too few"):
        map_aided(reading[:5], R[:5], B_map[:5], variance[:5], path_m=path[:5])
    B_map[3] = np.nan
    with pytest.raises(InvalidInput, match="off the map"):
        map_aided(reading, R, B_map, variance, path_m=path)
