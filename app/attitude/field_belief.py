"""What Brommer's filter believes, and its settings: attitude, biases, the magnetometer's rotation, the local field.

The error state has fifteen entries: attitude, gyro bias, accelerometer bias, extrinsic rotation of the magnetometer,
field (Brommer, L81, Eq. 1, without position and velocity, which nothing here observes). Errors of rotations stand on
the right. A block of variance 0 stays as it is given: a known rotation, or a bias not to be estimated.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from app.attitude.disturbance import OutlierRule
from app.attitude.spherical_field import to_spherical
from app.geometry import Array

__all__ = [
    "ACCELEROMETER_BIAS", "ATTITUDE", "EXTRINSIC", "FIELD", "GRAVITY_M_S2", "GYRO_BIAS", "STATES", "FieldBelief",
    "FieldFilter", "InitialSpread", "initial_belief",
]  # fmt: skip

ATTITUDE, GYRO_BIAS, ACCELEROMETER_BIAS, EXTRINSIC, FIELD = (slice(k, k + 3) for k in (0, 3, 6, 9, 12))
STATES = 15
GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True, eq=False)
class FieldBelief:
    """Quaternions scalar first; `field` is [r, theta, phi] (uT, rad) or [x, y, z] (uT) in the building frame.

    q_body_to_building (4,), gyro_bias_rad_per_s (3,), accelerometer_bias_m_s2 (3,), q_sensor_to_body (4,), field (3,),
    covariance (15, 15) of the error state.
    """

    q_body_to_building: Array
    gyro_bias_rad_per_s: Array
    accelerometer_bias_m_s2: Array
    q_sensor_to_body: Array
    field: Array
    covariance: Array


class FieldFilter(NamedTuple):
    """How to filter: plain numbers. Noise densities are per root hertz.

    spherical             the field as magnitude and angles, or as components
    rotate_noise          R = J R_c J^T at every reading, or the fixed sds below (spherical only)
    vector_test           test three residuals together; else the magnitude (of components: their norm)
    reject                leave outliers out of the update
    adapt                 on a disturbance make the field unsure enough to take the new one in
    adapt_angles          its direction as well, by the angle between reading and prediction
    sensor_sd_uT          noise of the magnetometer in its own axes
    fixed_sd              of [r, theta, phi], uT and rad
    reset_sd_uT           sd of each component after a disturbance in Cartesian form (Brommer, L189)
    magnitude_walk_uT     random walk of the magnitude, or of each component, per root second
    direction_walk_rad    random walk of the direction, per root second: 0 as the source, which freezes the field
    gyro_noise_rad_per_s, gyro_bias_walk_rad_per_s2, force_noise_m_s2, force_bias_walk_m_s3    of the IMU
    """

    spherical: bool = True
    rotate_noise: bool = True
    vector_test: bool = False
    reject: bool = True
    adapt: bool = True
    adapt_angles: bool = False
    sensor_sd_uT: tuple[float, float, float] = (0.5, 0.5, 0.5)
    fixed_sd: tuple[float, float, float] = (0.5, 0.01, 0.02)
    reset_sd_uT: float = 10.0
    magnitude_walk_uT: float = 0.0
    direction_walk_rad: float = 0.0
    gyro_noise_rad_per_s: float = 2e-3
    gyro_bias_walk_rad_per_s2: float = 1e-5
    force_noise_m_s2: float = 0.1
    force_bias_walk_m_s3: float = 1e-4
    rule: OutlierRule = OutlierRule()


class InitialSpread(NamedTuple):
    """Sds of a first belief, per axis; 0 holds a block as given."""

    attitude_rad: float = 0.1
    gyro_bias_rad_per_s: float = 0.01
    accelerometer_bias_m_s2: float = 0.0
    extrinsic_rad: float = 0.0
    field_uT: float = 5.0


def initial_belief(
    filter_: FieldFilter,
    q_body_to_building: Array,
    B_sensor_uT: Array,
    spread: InitialSpread = InitialSpread(),  # noqa: B008  (a NamedTuple of numbers)
    q_sensor_to_body: Array | None = None,
) -> FieldBelief:
    """A first belief from an attitude (4,) and a reading (3,), whose field is as unsure as `spread` says.

    Angles get the sds that components of that sd have. A field along the building's z gets an azimuth of any value.
    """
    q_sensor = np.array([1.0, 0.0, 0.0, 0.0]) if q_sensor_to_body is None else np.asarray(q_sensor_to_body, float)
    turned = Rotation.from_quat(q_sensor, scalar_first=True).apply(B_sensor_uT)
    B = Rotation.from_quat(q_body_to_building, scalar_first=True).apply(turned)
    P = np.diag(np.repeat(np.square(np.asarray(spread)), 3))
    if filter_.spherical:
        m = to_spherical(B)
        angle_rad = np.minimum(spread.field_uT / (m[0] * np.array([1.0, max(np.sin(m[1]), 1e-6)])), np.pi)
        P[FIELD, FIELD] = np.diag([spread.field_uT**2, *np.square(angle_rad)])
    field = to_spherical(B) if filter_.spherical else B
    return FieldBelief(np.asarray(q_body_to_building, float), np.zeros(3), np.zeros(3), q_sensor, field, P)
