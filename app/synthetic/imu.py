"""Gyro, accelerometer and magnetometer of a body whose path and attitude are known (Kuevor, B2, B21)."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from app.attitude.options import InertialSamples
from app.geometry import Array

__all__ = ["GRAVITY_M_PER_S2", "ImuNoise", "path_acceleration_m_per_s2", "simulate_imu"]

GRAVITY_M_PER_S2 = 9.81


@dataclass(frozen=True, slots=True)
class ImuNoise:
    """Standard deviations per axis: white noise of a sample, and constants drawn once (`bias`, `hard_iron`)."""

    gyro_rad_per_sqrt_s: float = 1.5e-4
    gyro_bias_rad_per_s: float = 0.005
    gyro_bias_walk_rad_per_s_sqrt_s: float = 2e-5
    accelerometer_m_per_s2: float = 0.03
    accelerometer_bias_m_per_s2: float = 0.02
    magnetometer_uT: float = 0.3
    hard_iron_uT: float = 0.0


def path_acceleration_m_per_s2(t_s: Array, p_building_m: Array) -> Array:
    """(n, 3) second derivative of a path (n, 3), by central differences."""
    velocity = np.gradient(p_building_m, t_s, axis=0)
    return np.asarray(np.gradient(velocity, t_s, axis=0))


def simulate_imu(
    t_s: Array,
    q_body_to_building: Array,
    acceleration_m_per_s2: Array,
    B_building_uT: Array,
    rng: np.random.Generator,
    noise: ImuNoise | None = None,
) -> InertialSamples:
    """Readings at times (n,) of a body of attitude (n, 4), acceleration (n, 3) without gravity, in a field (n, 3).

    A gyro reading is the mean rate since the reading before, as that of a chip without delay.
    """
    noise, n = noise or ImuNoise(), len(t_s)
    attitude = Rotation.from_quat(q_body_to_building, scalar_first=True)
    dt = np.diff(t_s, prepend=t_s[0] - (t_s[1] - t_s[0]))[:, None]
    turned = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    rate = np.concatenate([turned[:1], turned]) / dt
    walk = np.cumsum(noise.gyro_bias_walk_rad_per_s_sqrt_s * np.sqrt(dt) * rng.normal(size=(n, 3)), axis=0)
    bias = noise.gyro_bias_rad_per_s * rng.normal(size=3) + walk
    gyro = rate + bias + noise.gyro_rad_per_sqrt_s / np.sqrt(dt) * rng.normal(size=(n, 3))
    gravity = np.array([0.0, 0.0, GRAVITY_M_PER_S2])
    force = attitude.inv().apply(acceleration_m_per_s2 + gravity)
    force += noise.accelerometer_bias_m_per_s2 * rng.normal(size=3)
    force += noise.accelerometer_m_per_s2 * rng.normal(size=(n, 3))
    field = attitude.inv().apply(B_building_uT) + noise.hard_iron_uT * rng.normal(size=3)
    return InertialSamples(t_s, gyro, force, field + noise.magnetometer_uT * rng.normal(size=(n, 3)))
