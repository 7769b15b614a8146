"""A body that tumbles in a uniform field: what its sensors read, and how it truly lay."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from app.attitude.options import InertialSamples
from app.synthetic.imu import ImuNoise, path_acceleration_m_per_s2, simulate_imu

FIELD_UT = np.array([14.0, 8.0, -42.0])


@dataclass(frozen=True)
class Tumbled:
    """What was read, how the body truly lay (n, 4), and the field (3,)."""

    samples: InertialSamples
    truth: np.ndarray
    field_uT: np.ndarray

    def error_rad(self, q: np.ndarray) -> np.ndarray:
        """(n, 3) error vectors about the body's axes: truth = estimate exp(error)."""
        estimate, truth = (Rotation.from_quat(each, scalar_first=True) for each in (q, self.truth))
        return (estimate.inv() * truth).as_rotvec()


@pytest.fixture(scope="session")
def tumble() -> Callable[..., Tumbled]:
    """Rest for some seconds, then turn and move about smoothly; white and constant errors as told."""

    def make(
        seed: int = 1,
        seconds: float = 40.0,
        rate_hz: float = 100.0,
        rest_s: float = 5.0,
        turn_rad_per_s: float = 1.0,
        sway_m: float = 0.1,
        noise: ImuNoise | None = None,
        iron_uT: np.ndarray | None = None,
    ) -> Tumbled:
        rng = np.random.default_rng(seed)
        n = int(seconds * rate_hz)
        t = np.arange(n) / rate_hz
        moving = gaussian_filter1d((t >= rest_s + 1.0).astype(float), 0.3 * rate_hz)[:, None]
        rate = moving * turn_rad_per_s * _smooth_noise(rng, n, 0.6 * rate_hz)
        attitude = [Rotation.from_rotvec(rng.normal(size=3) * [0.3, 0.3, 2.0])]
        for each in rate[1:] / rate_hz:
            attitude.append(attitude[-1] * Rotation.from_rotvec(each))
        q = Rotation.concatenate(attitude).as_quat(scalar_first=True)
        path = moving * sway_m * _smooth_noise(rng, n, 0.5 * rate_hz)
        acceleration = path_acceleration_m_per_s2(t, path)
        samples = simulate_imu(t, q, acceleration, np.tile(FIELD_UT, (n, 1)), rng, noise)
        if iron_uT is not None:
            samples.magnetometer_uT[:] += iron_uT
        return Tumbled(samples, q, FIELD_UT)

    return make


def _smooth_noise(rng: np.random.Generator, n: int, width: float) -> np.ndarray:
    smooth = gaussian_filter1d(rng.normal(size=(n, 3)), width, axis=0)
    return smooth / smooth.std(axis=0)
