"""Has the field turned? A test of the dip angle, for disturbances that leave the magnitude as it is.

The test of the magnitude is blind to a field that turns. With up known from gravity, the dip (the angle of the field
below the horizontal) needs no heading either, and the two together leave only turns about the vertical unseen.
"""

from typing import NamedTuple

import numpy as np
from numba import njit

from app.attitude.disturbance import check_log
from app.errors import Fault, InvalidInput
from app.geometry import Array

__all__ = ["Dip", "dip_angle", "dip_statistic", "followed_up"]


class Dip(NamedTuple):
    """Angles below the horizontal (n,), rad, in [-pi/2, pi/2], and their variances (n,), rad^2."""

    angle_rad: Array
    variance_rad2: Array


def dip_angle(B_uT: Array, up: Array, R_uT2: Array, up_variance_rad2: Array | float) -> Dip:
    """The dip of fields (n, 3) against up (n, 3), unit vectors in the same frame; R (3, 3) the sensor's noise there.

    up_variance_rad2  of up about any horizontal axis: roll's and pitch's, (n,) or one number

    sin(dip) = -up . B / |B|. The variance is of first order; where the field is vertical, so that the dip has no
    derivative, it is that across the field. Raises InvalidInput for a field of zero, or an up that is no unit vector.
    """
    B, up = np.asarray(B_uT, np.float64), np.asarray(up, np.float64)
    size = np.linalg.norm(B, axis=-1)
    if not np.all(size > 0.0):
        raise InvalidInput("a field of zero has no dip; leave it out", Fault("B_uT", "is zero"))
    if not np.allclose(np.linalg.norm(up, axis=-1), 1.0, atol=1e-6):
        raise InvalidInput("up is not of length one; divide it by its length", Fault("up", "not unit vectors"))
    along = B / size[..., None]
    rising = np.sum(along * up, axis=-1)
    level = up - rising[..., None] * along  # across the field, in the vertical plane that holds it
    cosine = np.linalg.norm(level, axis=-1)
    steep = cosine < 1e-6
    across = np.where(steep[..., None], _any_across(along), level / np.where(steep, 1.0, cosine)[..., None])
    noise = np.einsum("...i,ij,...j->...", across, R_uT2, across) / np.square(size)
    return Dip(np.arctan2(-rising, cosine), np.asarray(noise + up_variance_rad2))


def dip_statistic(measured: Dip, expected: Dip) -> Array:
    """(n,) squared difference over its variance: chi-square with one degree of freedom."""
    difference = measured.angle_rad - expected.angle_rad
    return np.asarray(np.square(difference) / (measured.variance_rad2 + expected.variance_rad2))


def followed_up(t_s: Array, gyro_rad_per_s: Array, force_m_s2: Array, time_constant_s: float = 2.0) -> Array:
    """Up (n, 3) in the body's axes: the specific force (n, 3), low-passed while the gyroscope (n, 3) turns the body.

    Over `time_constant_s` the force is taken to average to gravity. Raises InvalidInput for logs of unequal length,
    times that decrease, or a first force of zero.
    """
    t, gyro, force = (np.ascontiguousarray(x, np.float64) for x in (t_s, gyro_rad_per_s, force_m_s2))
    check_log(t, gyro)
    check_log(t, force)
    if not np.any(force[0]):
        raise InvalidInput("the first force is zero and tells of no up", Fault("force_m_s2[0]", "is zero"))
    return np.asarray(_followed(t, gyro, force, time_constant_s))


def _any_across(unit: Array) -> Array:
    """Unit vectors across unit vectors (..., 3)."""
    axis = np.eye(3)[np.argmin(np.abs(unit), axis=-1)]
    across = np.cross(unit, axis)
    return np.asarray(across / np.linalg.norm(across, axis=-1, keepdims=True))


@njit(cache=True)
def _followed(t, gyro, force, time_constant_s):  # type: ignore[no-untyped-def]
    out = np.empty_like(force)
    g = force[0].copy()
    for k in range(len(t)):
        dt = t[k] - t[max(k - 1, 0)]
        turn = gyro[k] * dt
        angle = np.sqrt(turn @ turn)
        if angle > 0.0:  # what is fixed in the building turns the other way in the body (Rodrigues)
            axis = -turn / angle
            c, s = np.cos(angle), np.sin(angle)
            g = c * g + s * np.cross(axis, g) + (1.0 - c) * (axis @ g) * axis
        g += (1.0 - np.exp(-dt / time_constant_s)) * (force[k] - g)
        out[k] = g / np.sqrt(g @ g)
    return out
