"""Cuenca's polynomial by its spot values, and flights whose sensors agree with their truth."""

import numpy as np
import pytest

from app.synthetic.softball_field import (
    SensorNoise,
    fly_track,
    indoor_cells,
    polynomial_cells,
    polynomial_norm_uT,
    sense,
)
from app.tracking.inertial_ekf import inertial_step

SILENT = SensorNoise(0.0, 0.0, 0.0, 0.0, 0.0)


def test_spot_values():
    """(Cuenca, L944-950), evaluated."""
    points = np.array([[0, 0], [4.5, 0], [4.5, 18.5], [4.5, 37], [9, 18.5], [9, 37.0]])
    np.testing.assert_allclose(polynomial_norm_uT(points), [46.200, 45.867, 46.123, 45.864, 45.552, 45.121], atol=2e-3)


def test_statistics_of_the_map():
    cells = polynomial_cells()
    values = cells.mean_uT[..., 0]
    assert values.shape == (371, 91)
    assert values.min() == pytest.approx(44.908, abs=1e-3)
    assert values.max() == pytest.approx(46.377, abs=1e-3)
    assert values.std() == pytest.approx(0.261, abs=1e-3)
    j, i = np.unravel_index(values.argmax(), values.shape)
    np.testing.assert_allclose([cells.x_m[i], cells.y_m[j]], [1.3, 24.5], atol=1e-9)
    slope = np.hypot(*np.gradient(values, 0.1))
    assert np.median(slope) == pytest.approx(0.10, abs=5e-3)


def test_indoor_map_is_as_steep_as_asked():
    values = indoor_cells(np.random.default_rng(0), 7.0).mean_uT[..., 0]
    assert np.median(np.hypot(*np.gradient(values, 0.1))) == pytest.approx(7.0)


@pytest.mark.parametrize("shape", ["S", "O"])
def test_tracks_stay_on_the_field_and_their_imu_retraces_them(shape):
    flight = fly_track(shape)
    assert np.all(flight.position_m[:, :2] > 0.0)
    assert np.all(flight.position_m[:, :2] < [9.0, 37.0])
    log = sense(flight, polynomial_cells(), np.random.default_rng(0), SILENT)
    state = np.concatenate([flight.position_m[0], flight.velocity_m_s[0], flight.angles_rad[0]])
    for force, rate in zip(log.force_m_s2[:-1], log.rate_rad_s[:-1], strict=True):
        state = inertial_step(state, force, rate, flight.dt_s)
    assert np.linalg.norm(state[:2] - flight.position_m[-1, :2]) < 0.5  # Euler's steps, 40 s without correction
    np.testing.assert_allclose(log.norm_uT, polynomial_norm_uT(flight.position_m), atol=5e-3)
    np.testing.assert_array_equal(log.gps_m, flight.position_m)


def test_noises_are_as_stated():
    flight = fly_track("O")
    noise = SensorNoise(0.3, 0.1, 0.07, 0.2, 0.05)
    quiet, noisy = (sense(flight, polynomial_cells(), np.random.default_rng(1), n) for n in (SILENT, noise))
    for name, sd in (("force_m_s2", 0.3), ("rate_rad_s", 0.1), ("norm_uT", 0.07), ("gps_m", 0.2)):
        assert np.std(getattr(noisy, name) - getattr(quiet, name)) == pytest.approx(sd, rel=0.05)
