"""Cuenca's extended Kalman filter: position, velocity and Euler angles, carried on by an IMU (Cuenca 1.5-1.7).

State `[x, y, z, vx, vy, vz, roll, pitch, yaw]` in the building frame, m, m/s, rad. z points up and the accelerometer
reads specific force, gravity upwards at rest: then the source's a_I = R^T a_B - [0, 0, g] holds as printed, and its
rotations are about our axes (yaw counter-clockwise). The matrices are the product of its factors, not its misprints.
"""

from dataclasses import dataclass
from math import cos, sin, tan

import numpy as np

from app.geometry import Array
from app.tracking.kalman import GaussianBelief, Update, update

__all__ = [
    "CUENCA_NOISE", "GRAVITY_M_S2", "InertialNoise", "body_to_building", "correct_position",
    "correct_position_and_velocity", "inertial_step", "inertial_step_jacobian", "predict_inertial",
]  # fmt: skip

GRAVITY_M_S2 = 9.80665


@dataclass(frozen=True, slots=True)
class InertialNoise:
    """Diagonal of Q per step: position m^2, velocity m^2/s^2, angles rad^2."""

    position_m2: float
    velocity_m2_s2: float
    angle_rad2: float

    @property
    def covariance(self) -> Array:
        """(9, 9)."""
        return np.diag(np.repeat([self.position_m2, self.velocity_m2_s2, self.angle_rad2], 3))


CUENCA_NOISE = InertialNoise(1e-5, 1e-2, 1e-8)
"""Per 0.01 s (Cuenca, L788, eq. 3.19)."""


def body_to_building(roll_rad: float, pitch_rad: float, yaw_rad: float) -> Array:
    """(3, 3) R(z, yaw) R(y, pitch) R(x, roll), the transpose of eq. 2.5 corrected (Cuenca, L389-399)."""
    sF, cF, sT, cT = sin(roll_rad), cos(roll_rad), sin(pitch_rad), cos(pitch_rad)
    sP, cP = sin(yaw_rad), cos(yaw_rad)
    return np.array(
        [
            [cT * cP, sF * sT * cP - cF * sP, cF * sT * cP + sF * sP],
            [cT * sP, sF * sT * sP + cF * cP, cF * sT * sP - sF * cP],
            [-sT, cT * sF, cT * cF],
        ]
    )


def inertial_step(state: Array, force_m_s2: Array, rate_rad_s: Array, dt_s: float) -> Array:
    """One Euler step of the state (9,) with specific force (3,) and turn rate (3,) in the body's axes.

    (Cuenca, L673-693, eqs. 3.7-3.16.) Singular at a pitch of +-90 degrees.
    """
    roll, pitch, yaw = state[6:]
    p, q, r = rate_rad_s
    sF, cF = sin(roll), cos(roll)
    about = q * sF + r * cF
    out = state.copy()
    out[:3] += state[3:6] * dt_s
    out[3:6] += body_to_building(roll, pitch, yaw) @ force_m_s2 * dt_s
    out[5] -= GRAVITY_M_S2 * dt_s
    out[6] += (p + about * tan(pitch)) * dt_s
    out[7] += (q * cF - r * sF) * dt_s
    out[8] += about / cos(pitch) * dt_s
    return out


def inertial_step_jacobian(state: Array, force_m_s2: Array, rate_rad_s: Array, dt_s: float) -> Array:
    """(9, 9) derivative of `inertial_step` with the state (Cuenca, L705, eq. 3.17, entries worked out)."""
    roll, pitch, yaw = state[6:]
    ax, ay, az = force_m_s2
    _, q, r = rate_rad_s
    sF, cF, sT, cT, sP, cP = sin(roll), cos(roll), sin(pitch), cos(pitch), sin(yaw), cos(yaw)
    about, across = q * sF + r * cF, q * cF - r * sF
    down = -ax * sT + ay * sF * cT + az * cF * cT
    F = np.eye(9)
    F[0, 3] = F[1, 4] = F[2, 5] = dt_s
    F[3:6, 6:] = dt_s * np.array(
        [
            [
                ay * (cF * sT * cP + sF * sP) + az * (cF * sP - sF * sT * cP),
                cP * down,
                -ax * cT * sP - ay * (sF * sT * sP + cF * cP) + az * (sF * cP - cF * sT * sP),
            ],
            [
                ay * (cF * sT * sP - sF * cP) - az * (sF * sT * sP + cF * cP),
                sP * down,
                ax * cT * cP + ay * (sF * sT * cP - cF * sP) + az * (cF * sT * cP + sF * sP),
            ],
            [cT * (ay * cF - az * sF), -ax * cT - sT * (ay * sF + az * cF), 0.0],
        ]
    )
    F[6, 6] += dt_s * sT / cT * across
    F[6, 7] = dt_s * about / cT**2
    F[7, 6] = -dt_s * about
    F[8, 6] = dt_s * across / cT
    F[8, 7] = dt_s * about * sT / cT**2
    return F


def predict_inertial(
    belief: GaussianBelief, force_m_s2: Array, rate_rad_s: Array, dt_s: float, Q: Array
) -> GaussianBelief:
    """The belief a step later; Q (9, 9) of that step (Cuenca, L484-486, eqs. 2.21, 2.22)."""
    F = inertial_step_jacobian(belief.mean, force_m_s2, rate_rad_s, dt_s)
    mean = inertial_step(belief.mean, force_m_s2, rate_rad_s, dt_s)
    return GaussianBelief(mean, F @ belief.covariance @ F.T + Q)


def correct_position(belief: GaussianBelief, position_m: Array, R_m2: Array) -> Update:
    """Fuse a position (k,), R (k, k): k = 3 from GPS, 2 from a map, which tells nothing of z (Cuenca, L709)."""
    return update(belief, position_m, np.eye(len(position_m), 9), R_m2)


def correct_position_and_velocity(belief: GaussianBelief, position_m: Array, velocity_m_s: Array, R: Array) -> Update:
    """Fuse a position (3,) and a velocity (3,), R (6, 6); the source prints neither matrix (Cuenca, L1079)."""
    return update(belief, np.concatenate([position_m, velocity_m_s]), np.eye(6, 9), R)
