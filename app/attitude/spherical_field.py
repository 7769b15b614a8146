"""The field as a magnitude and two angles: conversions, exact Jacobians, and what a magnetometer then reads.

Spherical vectors are `[r, theta, phi]`: magnitude, polar angle from +z in [0, pi], azimuth from +x towards +y in
[0, 2 pi) (Brommer, L45, L103; Table I reports the elevation, pi / 2 - theta). In this form the magnitude has the
measurement row [1 0 0], whatever the attitude (Brommer, L187, Eq. 15).

Azimuths are singular where the field lies along z of the frame they are counted in; of a measurement that frame is the
sensor's. Near its z axis another axis of the sensor is therefore made the pole: see `pole_axis`.
"""

from typing import NamedTuple

import numpy as np

from app.errors import Fault, InvalidInput
from app.geometry import Array, wrap_angle_rad

__all__ = [
    "SphericalPrediction", "cartesian_jacobian", "from_spherical", "pole_axis", "predict_spherical",
    "spherical_covariance", "spherical_jacobian", "spherical_residual", "to_spherical", "with_pole",
]  # fmt: skip

NEAR_POLE = 0.9
"""Cosine of the polar angle beyond which another axis of the sensor becomes the pole (26 degrees)."""


def to_spherical(B_uT: Array) -> Array:
    """C2S: field vectors (..., 3), uT, as [r, theta, phi] (..., 3), uT and rad; along z the azimuth is 0."""
    x, y, z = np.moveaxis(np.asarray(B_uT, dtype=np.float64), -1, 0)
    rho = np.hypot(x, y)
    azimuth = np.mod(np.arctan2(y, x), 2 * np.pi)
    azimuth = np.where((rho == 0.0) | (azimuth >= 2 * np.pi), 0.0, azimuth)
    return np.stack([np.hypot(rho, z), np.arctan2(rho, z), azimuth], axis=-1)


def from_spherical(m_spherical: Array) -> Array:
    """S2C: [r, theta, phi] (..., 3) as field vectors (..., 3), uT. Angles out of range are taken as they come."""
    r, theta, phi = np.moveaxis(np.asarray(m_spherical, dtype=np.float64), -1, 0)
    return np.stack([r * np.sin(theta) * np.cos(phi), r * np.sin(theta) * np.sin(phi), r * np.cos(theta)], axis=-1)


def spherical_jacobian(B_uT: Array) -> Array:
    """d [r, theta, phi] / d [x, y, z] (..., 3, 3) at field vectors (..., 3). The first row is the unit vector.

    Raises InvalidInput where a vector lies along z: there the azimuth has no derivative.
    """
    x, y, z = np.moveaxis(np.asarray(B_uT, dtype=np.float64), -1, 0)
    rho, zero = np.hypot(x, y), np.zeros_like(x)
    if not np.all(rho > 0.0):
        raise InvalidInput(
            "a field along z has no azimuth to differentiate; count angles from another axis (see with_pole)",
            Fault("B_uT", f"{int(np.sum(~(rho > 0.0)))} vectors without a horizontal component"),
        )
    r = np.hypot(rho, z)
    rows = [
        np.stack([x / r, y / r, z / r], axis=-1),
        np.stack([x * z / (r**2 * rho), y * z / (r**2 * rho), -rho / r**2], axis=-1),
        np.stack([-y / rho**2, x / rho**2, zero], axis=-1),
    ]
    return np.stack(rows, axis=-2)


def cartesian_jacobian(m_spherical: Array) -> Array:
    """d [x, y, z] / d [r, theta, phi] (..., 3, 3) at [r, theta, phi] (..., 3)."""
    r, theta, phi = np.moveaxis(np.asarray(m_spherical, dtype=np.float64), -1, 0)
    st, ct, sp, cp = np.sin(theta), np.cos(theta), np.sin(phi), np.cos(phi)
    rows = [
        np.stack([st * cp, r * ct * cp, -r * st * sp], axis=-1),
        np.stack([st * sp, r * ct * sp, r * st * cp], axis=-1),
        np.stack([ct, -r * st, np.zeros_like(r)], axis=-1),
    ]
    return np.stack(rows, axis=-2)


def spherical_residual(measured: Array, predicted: Array) -> Array:
    """Measured less predicted [r, theta, phi] (..., 3), the azimuth's difference in (-pi, pi]."""
    residual = np.asarray(measured, dtype=np.float64) - predicted
    residual[..., 2] = wrap_angle_rad(residual[..., 2])
    return residual


def spherical_covariance(B_uT: Array, R_uT2: Array) -> Array:
    """J R J^T: noise of a sensor, R (3, 3) uT^2 in its own axes, in [r, theta, phi] at the reading (3,) or (n, 3)."""
    J = spherical_jacobian(B_uT)
    return np.asarray(J @ R_uT2 @ np.swapaxes(J, -1, -2))


def pole_axis(B_sensor_uT: Array) -> int:
    """Which axis of the sensor (0, 1, 2) to count polar angles from: z, unless the field (3,) lies near it.

    Then the axis that the field is farthest from. The residuals are other numbers for the same information.
    """
    size = np.abs(np.asarray(B_sensor_uT, dtype=np.float64))
    if size[2] <= NEAR_POLE * np.sqrt(size @ size):
        return 2
    return int(size[1] < size[0])


def with_pole(axis: int) -> Array:
    """The rotation (3, 3) that turns the axes in a circle until `axis` is the third."""
    return np.roll(np.eye(3), 2 - axis, axis=0)


class SphericalPrediction(NamedTuple):
    """What a magnetometer should read: [r, theta, phi] (3,), and its derivatives, each (3, 3).

    With the attitude's error, the magnetometer's extrinsic rotation's, and the field's [r, theta, phi].
    """

    reading: Array
    by_attitude: Array
    by_extrinsic: Array
    by_field: Array


def predict_spherical(
    R_body_to_building: Array, R_sensor_to_body: Array, m_spherical: Array, pole: Array | None = None
) -> SphericalPrediction:
    """The reading of a field [r, theta, phi] (3,) of the building, and H (Brommer, L97-101, L187, Eqs. 5-7, 15).

    Errors of rotations stand on the right, C = C_hat (I + [delta]x). `pole` (3, 3) turns the sensor's axes first.
    The magnitude's row is [0 0 0 | 0 0 0 | 1 0 0] exactly: its other entries cancel, and are not left to rounding.
    Raises InvalidInput where the reading lies along the pole.
    """
    B_body = R_body_to_building.T @ from_spherical(m_spherical)
    B_sensor = R_sensor_to_body.T @ B_body
    to_reading = R_sensor_to_body.T if pole is None else pole @ R_sensor_to_body.T
    J = spherical_jacobian(B_sensor if pole is None else pole @ B_sensor)
    by_attitude = J @ to_reading @ skew(B_body)
    by_extrinsic = J @ (np.eye(3) if pole is None else pole) @ skew(B_sensor)
    by_field = J @ to_reading @ R_body_to_building.T @ cartesian_jacobian(m_spherical)
    by_attitude[0], by_extrinsic[0] = 0.0, 0.0
    by_field[0], by_field[1:, 0] = [1.0, 0.0, 0.0], 0.0
    reading = to_spherical(B_sensor if pole is None else pole @ B_sensor)
    reading[0] = m_spherical[0]
    return SphericalPrediction(reading, by_attitude, by_extrinsic, by_field)


def skew(v: Array) -> Array:
    """[v]x (3, 3): the matrix of the cross product v x."""
    x, y, z = v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
