"""Brommer's filter, one step at a time: attitude by gyroscope, gravity, and a field believed as magnitude and angles.

A belief goes in, a belief comes out. `app.attitude.field_log` does the same over a whole log, compiled.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from app.attitude.cartesian_field import norm_variance, predict_cartesian
from app.attitude.disturbance import (
    MagnitudeState,
    Watched,
    adapted_variance,
    innovation_statistic,
    watch_outlier,
)
from app.attitude.field_belief import (
    ACCELEROMETER_BIAS,
    ATTITUDE,
    EXTRINSIC,
    FIELD,
    GRAVITY_M_S2,
    GYRO_BIAS,
    STATES,
    FieldBelief,
    FieldFilter,
)
from app.attitude.spherical_field import (
    from_spherical,
    pole_axis,
    predict_spherical,
    skew,
    spherical_covariance,
    spherical_residual,
    to_spherical,
    with_pole,
)
from app.geometry import Array

__all__ = ["FieldUpdate", "canonical", "predict_field", "update_field", "update_gravity"]

ON_POLE = 1e-6


class FieldUpdate(NamedTuple):
    """The belief and the test's memory after a reading, what the test said, and y^T S^-1 y of all three residuals."""

    belief: FieldBelief
    state: MagnitudeState
    watched: Watched
    statistic: float


def predict_field(belief: FieldBelief, filter_: FieldFilter, gyro_rad_per_s: Array, dt_s: float) -> FieldBelief:
    """The belief `dt_s` later, turned by the gyroscope (3,) less its bias; the field stays (Brommer, L83)."""
    turn = Rotation.from_rotvec((gyro_rad_per_s - belief.gyro_bias_rad_per_s) * dt_s)
    attitude = Rotation.from_quat(belief.q_body_to_building, scalar_first=True) * turn
    F = np.eye(STATES)
    F[ATTITUDE, ATTITUDE] = turn.as_matrix().T
    F[ATTITUDE, GYRO_BIAS] = -dt_s * np.eye(3)
    walk = np.repeat(
        [filter_.gyro_noise_rad_per_s, filter_.gyro_bias_walk_rad_per_s2, filter_.force_bias_walk_m_s3, 0.0, 0.0], 3
    )
    walk[FIELD] = filter_.magnitude_walk_uT
    if filter_.spherical:
        walk[FIELD][1:] = filter_.direction_walk_rad / np.array([1.0, max(np.sin(belief.field[1]), 0.1)])
    held = np.diag(belief.covariance) == 0.0
    walk[held & (np.arange(STATES) >= GYRO_BIAS.start) & (np.arange(STATES) < EXTRINSIC.start)] = 0.0
    P = F @ belief.covariance @ F.T + np.diag(np.square(walk) * dt_s)
    return replace(belief, q_body_to_building=attitude.as_quat(scalar_first=True), covariance=P)


def update_gravity(belief: FieldBelief, filter_: FieldFilter, force_m_s2: Array) -> FieldBelief:
    """The belief after a specific force (3,) of the body, taken for gravity.

    Its noise grows by what its size misses gravity's: a device that is moved tells less of where up is.
    """
    up = Rotation.from_quat(belief.q_body_to_building, scalar_first=True).inv().apply([0.0, 0.0, GRAVITY_M_S2])
    H = np.zeros((3, STATES))
    H[:, ATTITUDE], H[:, ACCELEROMETER_BIAS] = skew(up), np.eye(3)
    departure = float(np.linalg.norm(force_m_s2)) - GRAVITY_M_S2
    R = (filter_.force_noise_m_s2**2 + departure**2) * np.eye(3)
    return _updated(belief, force_m_s2 - up - belief.accelerometer_bias_m_s2, H, R, filter_.spherical)


def update_field(
    belief: FieldBelief, filter_: FieldFilter, state: MagnitudeState, t_s: float, B_sensor_uT: Array
) -> FieldUpdate:
    """Test a reading (3,), adapt on a disturbance, and fuse it unless rejected (Brommer, L87-101, L167-197)."""
    residual, H, R, R_norm, P_norm = _innovation(belief, filter_, B_sensor_uT)
    S = H @ belief.covariance @ H.T + R
    statistic = float(innovation_statistic(residual, S))
    measured, predicted = _magnitudes(belief, filter_, B_sensor_uT)
    scalar = (measured - predicted) ** 2 / (P_norm + R_norm)
    failed = (statistic if filter_.vector_test else scalar) > filter_.rule.threshold
    seen = watch_outlier(state, filter_.rule, t_s, failed, measured, R_norm, predicted, P_norm)
    if seen.found and filter_.adapt:
        belief = _adapted(belief, filter_, B_sensor_uT, measured - predicted, R_norm)
    elif seen.outlier and filter_.reject:
        return FieldUpdate(belief, seen.state, seen, statistic)
    return FieldUpdate(_updated(belief, residual, H, R, filter_.spherical), seen.state, seen, statistic)


def canonical(m_spherical: Array) -> tuple[Array, Array]:
    """[r, theta, phi] (3,) brought into range, and the signs (3,) that errors of the three thereby get.

    The same vector; an update may have pushed an angle over the pole.
    """
    r, theta, phi = m_spherical
    signs = np.ones(3)
    if r < 0.0:
        r, theta, phi, signs[0], signs[1] = -r, np.pi - theta, phi + np.pi, -1.0, -1.0
    theta = np.mod(theta, 2 * np.pi)
    if theta > np.pi:
        theta, phi = 2 * np.pi - theta, phi + np.pi
        signs[1] = -signs[1]
    phi = np.mod(phi, 2 * np.pi)
    return np.array([r, theta, phi if phi < 2 * np.pi else 0.0]), signs


def _innovation(belief: FieldBelief, filter_: FieldFilter, B_uT: Array) -> tuple[Array, Array, Array, float, float]:
    """Residual (3,), H (3, 15), R (3, 3), and the magnitude's variances: of the noise, and of the prediction."""
    to_building = Rotation.from_quat(belief.q_body_to_building, scalar_first=True).as_matrix()
    to_body = Rotation.from_quat(belief.q_sensor_to_body, scalar_first=True).as_matrix()
    R_sensor = np.diag(np.square(filter_.sensor_sd_uT))
    H = np.zeros((3, STATES))
    if not filter_.spherical:
        plain = predict_cartesian(to_building, to_body, belief.field)
        H[:, ATTITUDE], H[:, EXTRINSIC], H[:, FIELD] = plain[1:]
        R_norm = float(norm_variance(plain.reading, R_sensor))
        P_norm = float(norm_variance(plain.reading, H @ belief.covariance @ H.T))
        return B_uT - plain.reading, H, R_sensor, R_norm, P_norm
    predicted_uT = to_body.T @ to_building.T @ from_spherical(belief.field)
    pole = with_pole(pole_axis(predicted_uT))
    seen = predict_spherical(to_building, to_body, belief.field, pole)
    H[:, ATTITUDE], H[:, EXTRINSIC], H[:, FIELD] = seen.by_attitude, seen.by_extrinsic, seen.by_field
    z = pole @ B_uT
    R = np.diag(np.square(filter_.fixed_sd))
    if filter_.rotate_noise:
        at = z if np.hypot(z[0], z[1]) > ON_POLE * np.linalg.norm(z) else pole @ predicted_uT
        R = spherical_covariance(at, pole @ R_sensor @ pole.T)
    return spherical_residual(to_spherical(z), seen.reading), H, R, float(R[0, 0]), float(belief.covariance[12, 12])


def _magnitudes(belief: FieldBelief, filter_: FieldFilter, B_uT: Array) -> tuple[float, float]:
    predicted = belief.field[0] if filter_.spherical else np.linalg.norm(belief.field)
    return float(np.linalg.norm(B_uT)), float(predicted)


def _adapted(
    belief: FieldBelief, filter_: FieldFilter, B_uT: Array, innovation_uT: float, R_norm_uT2: float
) -> FieldBelief:
    """Sure of the field no more (Brommer, L189-195). Raising variances keeps the covariance positive semidefinite."""
    P = belief.covariance.copy()
    if not filter_.spherical:
        P[FIELD, :], P[:, FIELD] = 0.0, 0.0
        P[FIELD, FIELD] = filter_.reset_sd_uT**2 * np.eye(3)
        return replace(belief, covariance=P)
    P[12, 12] = adapted_variance(P[12, 12], innovation_uT, R_norm_uT2)
    if filter_.adapt_angles:
        to_building = Rotation.from_quat(belief.q_body_to_building, scalar_first=True)
        B = to_building.apply(Rotation.from_quat(belief.q_sensor_to_body, scalar_first=True).apply(B_uT))
        unit = from_spherical(np.array([1.0, *belief.field[1:]]))
        apart_rad = np.arctan2(np.linalg.norm(np.cross(unit, B)), unit @ B)
        P[13, 13] = max(P[13, 13], apart_rad**2)
        P[14, 14] = max(P[14, 14], (apart_rad / max(np.sin(belief.field[1]), 0.1)) ** 2)
    return replace(belief, covariance=P)


def _updated(belief: FieldBelief, residual: Array, H: Array, R: Array, spherical: bool) -> FieldBelief:
    """Kalman's update, the covariance by Joseph's form; rotations are turned, the rest is added."""
    P = belief.covariance
    gain = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    dx, left = gain @ residual, np.eye(STATES) - gain @ H
    P = left @ P @ left.T + gain @ R @ gain.T
    field = belief.field + dx[FIELD]
    if spherical:
        field, signs = canonical(field)
        turned = np.concatenate([np.ones(FIELD.start), signs])
        P = turned[:, None] * P * turned
    return FieldBelief(
        _turned(belief.q_body_to_building, dx[ATTITUDE]),
        belief.gyro_bias_rad_per_s + dx[GYRO_BIAS],
        belief.accelerometer_bias_m_s2 + dx[ACCELEROMETER_BIAS],
        _turned(belief.q_sensor_to_body, dx[EXTRINSIC]),
        field,
        P,
    )


def _turned(q: Array, by_rad: Array) -> Array:
    turned = Rotation.from_quat(q, scalar_first=True) * Rotation.from_rotvec(by_rad)
    return np.asarray(turned.as_quat(scalar_first=True))
