"""The level frame of a device: which way is up, which way is forward, and how far it turned.

Up comes from the rotation vector (the operating system's fusion of gyroscope and accelerometer; its tilt is good, its
yaw is not, because it follows the local field), else from the accelerometer carried along by the gyroscope.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from app.geometry import Array

__all__ = ["attitude_quaternions", "gyroscope_yaw", "level_axes", "level_axes_yaw", "rotation_vector_matrices",
           "up_from_accelerometer"]  # fmt: skip

GRAVITY_TIME_CONSTANT_S = 2.0
UPRIGHT = 0.8


def rotation_vector_matrices(rotation_vector: Array) -> Array:
    """(n, 3, 3) body to East-North-Up from Android rotation vectors (n, 3), which are axis sin(angle / 2)."""
    w = np.sqrt(np.clip(1.0 - np.sum(np.square(rotation_vector), axis=1), 1e-12, 1.0))
    q = np.concatenate([w[:, None], rotation_vector], axis=1)
    return np.asarray(Rotation.from_quat(q, scalar_first=True).as_matrix())


def up_from_accelerometer(t_s: Array, force_m_per_s2: Array, rate_rad_per_s: Array | None) -> Array:
    """(n, 3) unit up in the body frame: specific force, low-passed in a frame carried along by the gyroscope.

    Without a gyroscope the force is low-passed in the body frame itself.
    """
    n = len(t_s)
    up = np.empty((n, 3))
    start = force_m_per_s2[: max(1, int(np.searchsorted(t_s, t_s[0] + 1.0)))].mean(axis=0)
    carried = _turns(t_s, rate_rad_per_s) if rate_rad_per_s is not None else np.broadcast_to(np.eye(3), (n - 1, 3, 3))
    gains = 1.0 - np.exp(-np.diff(t_s) / GRAVITY_TIME_CONSTANT_S)
    current = start
    up[0] = current
    for k in range(n - 1):
        current = carried[k].T @ current
        current = current + gains[k] * (force_m_per_s2[k + 1] - current)
        up[k + 1] = current
    length = np.linalg.norm(up, axis=1, keepdims=True)
    return np.asarray(up / np.maximum(length, 1e-9))


def level_axes(up_body: Array) -> Array:
    """(n, 3, 3) body to level: rows forward, left, up in body axes.

    Forward is the horizontal part of the device's top edge (+y), or of its back (-z) when it is held upright.
    """
    upright = np.median(np.abs(up_body[:, 1])) > UPRIGHT
    axis = np.array([0.0, 0.0, -1.0]) if upright else np.array([0.0, 1.0, 0.0])
    forward = axis - up_body * (up_body @ axis)[:, None]
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
    return np.stack([forward, np.cross(up_body, forward), up_body], axis=1)


def level_axes_yaw(body_to_enu: Array, level: Array) -> Array:
    """(n,) yaw of the level frames counter-clockwise from East, unwrapped."""
    forward_enu = np.einsum("nij,nj->ni", body_to_enu, level[:, 0])
    return np.unwrap(np.arctan2(forward_enu[:, 1], forward_enu[:, 0]))


def gyroscope_yaw(t_s: Array, rate_rad_per_s: Array, level: Array) -> Array:
    """(n,) yaw of the level frames since the first, from angular rates (n, 3) in the body frame.

    The turn between two samples, seen in their level frames, is a rotation about the vertical up to noise; its angle
    is exact for any tilt and for any definition of forward.
    """
    turn = np.einsum("nij,njk,nlk->nil", level[:-1], _turns(t_s, rate_rad_per_s), level[1:])
    step = np.arctan2(turn[:, 1, 0] - turn[:, 0, 1], turn[:, 0, 0] + turn[:, 1, 1])
    return np.concatenate([[0.0], np.cumsum(step)])


def attitude_quaternions(level: Array, yaw_rad: Array) -> Array:
    """(n, 4) scalar-first body to building, given the yaw (n,) of each level frame in the building."""
    about_z = Rotation.from_rotvec(np.multiply.outer(yaw_rad, [0.0, 0.0, 1.0]))
    return np.asarray((about_z * Rotation.from_matrix(level)).as_quat(scalar_first=True))


def _turns(t_s: Array, rate_rad_per_s: Array) -> Array:
    """(n - 1, 3, 3) rotations taking body axes of sample k + 1 to those of sample k."""
    mean = 0.5 * (rate_rad_per_s[1:] + rate_rad_per_s[:-1])
    return np.asarray(Rotation.from_rotvec(mean * np.diff(t_s)[:, None]).as_matrix())
