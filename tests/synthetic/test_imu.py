"""What a simulated IMU reads, against what physics says of simple motions."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from app.synthetic.flights import PROFILES, fly_profile
from app.synthetic.imu import GRAVITY_M_PER_S2, ImuNoise, path_acceleration_m_per_s2, simulate_imu
from app.synthetic.room import TRAINING_BOX_M

QUIET = ImuNoise(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


def test_a_body_at_rest_reads_gravity_upwards_and_the_field() -> None:
    n, attitude = 10, Rotation.from_euler("ZYX", [0.4, -0.3, 1.0])
    q = np.tile(attitude.as_quat(scalar_first=True), (n, 1))
    B = np.tile([20.0, 0.0, -45.0], (n, 1))
    s = simulate_imu(0.01 * np.arange(n), q, np.zeros((n, 3)), B, np.random.default_rng(1), QUIET)
    assert np.allclose(s.gyro_rad_per_s, 0.0, atol=1e-12)
    assert np.allclose(attitude.apply(s.accelerometer_m_per_s2), [0.0, 0.0, GRAVITY_M_PER_S2])
    assert np.allclose(attitude.apply(s.magnetometer_uT), B)


def test_gyro_readings_chain_to_the_attitude() -> None:
    rng = np.random.default_rng(2)
    steps = Rotation.from_rotvec(0.05 * rng.normal(size=(50, 3)))
    attitude = [Rotation.identity()]
    for each in steps:
        attitude.append(attitude[-1] * each)
    q = Rotation.concatenate(attitude).as_quat(scalar_first=True)
    s = simulate_imu(0.02 * np.arange(51), q, np.zeros((51, 3)), np.zeros((51, 3)), rng, QUIET)
    assert np.allclose(0.02 * s.gyro_rad_per_s[1:], steps.as_rotvec(), atol=1e-12)


def test_a_circle_pulls_inwards() -> None:
    t = 0.005 * np.arange(2000)
    p = np.column_stack([np.cos(1.5 * t), np.sin(1.5 * t), np.zeros_like(t)])
    a = path_acceleration_m_per_s2(t, p)[10:-10]
    assert np.allclose(a, -2.25 * p[10:-10], atol=1e-3)


@pytest.mark.parametrize("profile", PROFILES)
def test_flights_stay_in_the_mapped_room_and_lean_as_thrust_demands(profile: str) -> None:
    flight = fly_profile(profile, seconds=60.0)  # type: ignore[arg-type]
    low, high = TRAINING_BOX_M
    assert np.all(flight.p_building_m >= low)
    assert np.all(flight.p_building_m <= high)
    force = (
        Rotation.from_quat(flight.q_body_to_building, scalar_first=True)
        .inv()
        .apply(flight.acceleration_m_per_s2 + np.array([0.0, 0.0, GRAVITY_M_PER_S2]))
    )
    assert np.abs(force[:, :2]).max() < 1e-9
    assert np.linalg.norm(flight.acceleration_m_per_s2, axis=1).max() < 4.0
