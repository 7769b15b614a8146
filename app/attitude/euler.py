"""Yaw, pitch and roll of a quaternion, in the order 3-2-1 (Kuevor, L1313), and their variances.

z is up: yaw is counter-clockwise from the building's x, pitch is positive with the nose down, roll with the left side
up. The source's z points down, so its yaw and pitch have the other sign.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from app.geometry import Array

__all__ = ["EulerAngles", "EulerVariances", "euler_zyx_rad", "euler_zyx_variance_rad2"]

LARGEST_RAD2 = np.pi**2 / 3.0
"""The variance of an angle of which nothing is known."""


class EulerAngles(NamedTuple):
    """Each (n,), rad: R = Rz(yaw) Ry(pitch) Rx(roll)."""

    yaw_rad: Array
    pitch_rad: Array
    roll_rad: Array


class EulerVariances(NamedTuple):
    """Each (n,), rad^2."""

    yaw_rad2: Array
    pitch_rad2: Array
    roll_rad2: Array


def euler_zyx_rad(q_body_to_building: Array) -> EulerAngles:
    """Angles of quaternions (n, 4). At a pitch of +-90 degrees yaw and roll are one angle, and roll is told as zero."""
    w, x, y, z = np.moveaxis(q_body_to_building, -1, 0)
    sine = np.clip(2.0 * (w * y - x * z), -1.0, 1.0)
    flat = np.abs(sine) > 1.0 - 1e-12
    yaw = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    roll = np.arctan2(2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
    locked = np.arctan2(-2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z))
    return EulerAngles(np.where(flat, locked, yaw), np.arcsin(sine), np.where(flat, 0.0, roll))


def euler_zyx_variance_rad2(q_body_to_building: Array, covariance_rad2: Array) -> EulerVariances:
    """Variances from the covariance (n, 3, 3) of the attitude error about the body's axes, to first order.

    None is larger than that of an angle of which nothing is known, which is what yaw and roll have where pitch is near
    +-90 degrees.
    """
    R = Rotation.from_quat(q_body_to_building, scalar_first=True).as_matrix()
    up = R[:, 2]  # (-sin pitch, sin roll cos pitch, cos roll cos pitch)
    level = np.hypot(up[:, 1], up[:, 2])
    locked, level = level < 1e-6, np.maximum(level, 1e-6)
    zero = np.zeros(len(R))
    yaw = np.stack([zero, up[:, 1], up[:, 2]], axis=1) / level[:, None] ** 2
    pitch = np.stack([zero, up[:, 2], -up[:, 1]], axis=1) / level[:, None]
    roll = np.stack([np.ones(len(R)), zero, zero], axis=1) - up[:, :1] * yaw
    of_yaw, of_pitch, of_roll = (
        np.minimum(np.einsum("ni,nij,nj->n", g, covariance_rad2, g), LARGEST_RAD2) for g in (yaw, pitch, roll)
    )
    return EulerVariances(np.where(locked, LARGEST_RAD2, of_yaw), of_pitch, np.where(locked, LARGEST_RAD2, of_roll))
