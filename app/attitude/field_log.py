"""Brommer's filter over a whole log, compiled: the steps of `app.attitude.field_filter`, which is its plain twin."""

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from app.attitude.disturbance import (
    MagnitudeEvent,
    MagnitudeState,
    adapted_variance,
    check_log,
    event_row,
    gathered_events,
    watch_outlier,
)
from app.attitude.field_belief import GRAVITY_M_S2, STATES, FieldBelief, FieldFilter
from app.attitude.spherical_field import NEAR_POLE
from app.errors import Fault, InvalidInput
from app.geometry import Array

__all__ = ["FieldLog", "filter_log"]

ON_POLE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class FieldLog:
    """What the filter made of a log of n samples.

    q_body_to_building (n, 4), field (n, 3), field_sd (n, 3) after each sample; predicted_uT, innovation_uT,
    innovation_variance_uT2, statistic (n,) of the magnitude and of all three residuals, not a number where no reading
    came; outlier, found, disturbed (n,); the events, and the last belief.
    """

    q_body_to_building: Array
    field: Array
    field_sd: Array
    predicted_uT: Array
    innovation_uT: Array
    innovation_variance_uT2: Array
    statistic: Array
    outlier: NDArray[np.bool_]
    found: NDArray[np.bool_]
    disturbed: NDArray[np.bool_]
    events: tuple[MagnitudeEvent, ...]
    last: FieldBelief


def filter_log(
    belief: FieldBelief,
    filter_: FieldFilter,
    t_s: Array,
    gyro_rad_per_s: Array,
    B_sensor_uT: Array,
    force_m_s2: Array | None = None,
) -> FieldLog:
    """Filter a log: times (n,), gyroscope (n, 3), magnetometer (n, 3) and, if gravity is to be used, force (n, 3).

    A turn rate is that over the interval which ends at its time. Rows of the magnetometer or the force that are not
    numbers are samples without one. Raises InvalidInput for times that decrease, turn rates that are not numbers, or a
    field of zero.
    """
    t, gyro = np.ascontiguousarray(t_s, np.float64), np.ascontiguousarray(gyro_rad_per_s, np.float64)
    B = np.ascontiguousarray(B_sensor_uT, np.float64)
    force = np.full_like(gyro, np.nan) if force_m_s2 is None else np.ascontiguousarray(force_m_s2, np.float64)
    check_log(t, gyro)
    if not np.all(np.any(B != 0.0, axis=1)):
        at = int(np.argmin(np.any(B != 0.0, axis=1)))
        raise InvalidInput(f"magnetometer reading {at} is zero; leave it out", Fault(f"B_sensor_uT[{at}]", "is zero"))
    x = np.concatenate(
        [belief.q_body_to_building, belief.gyro_bias_rad_per_s, belief.accelerometer_bias_m_s2,
         belief.q_sensor_to_body, belief.field]
    )  # fmt: skip
    filter_.rule.check()
    states, columns, flags, rows, x, P = _run(x, belief.covariance.copy(), filter_, t, gyro, B, force)
    return FieldLog(
        states[:, :4], states[:, 4:7], np.sqrt(states[:, 7:]), columns[:, 0], columns[:, 1], columns[:, 2],
        columns[:, 3], flags[:, 0] == 1, flags[:, 1] == 1,
        flags[:, 2] == 1, gathered_events(rows), FieldBelief(x[:4], x[4:7], x[7:10], x[10:14], x[14:], P),
    )  # fmt: skip


@njit(cache=True)
def _run(x, P, f, t, gyro, B, force):  # type: ignore[no-untyped-def]
    n = len(t)
    states, columns, flags = np.empty((n, 10)), np.full((n, 4), np.nan), np.zeros((n, 3), np.int8)
    events = []
    R_sensor = np.diag(np.array([f.sensor_sd_uT[0] ** 2, f.sensor_sd_uT[1] ** 2, f.sensor_sd_uT[2] ** 2]))
    R_fixed = np.diag(np.array([f.fixed_sd[0] ** 2, f.fixed_sd[1] ** 2, f.fixed_sd[2] ** 2]))
    state = MagnitudeState(0, 0, 0.0, 0.0, 0.0, -1e300, 0, 0.0, 0.0, 0.0, 0.0, 0.0, 0, 0.0)
    for k in range(n):
        P = _predict(x, P, f, gyro[k], t[k] - t[max(k - 1, 0)])
        if np.all(np.isfinite(force[k])):
            P = _gravity(x, P, f, force[k])
        if np.all(np.isfinite(B[k])):
            residual, H, R, R_norm, P_norm = _innovation(x, P, f, B[k], R_sensor, R_fixed)
            S = H @ P @ H.T + R
            statistic = residual @ np.linalg.solve(S, residual)
            measured = np.sqrt(B[k] @ B[k])
            predicted = x[14] if f.spherical else np.sqrt(x[14:] @ x[14:])
            y = measured - predicted
            scalar = y * y / (P_norm + R_norm)
            failed = (statistic if f.vector_test else scalar) > f.rule.threshold
            seen = watch_outlier(state, f.rule, t[k], failed, measured, R_norm, predicted, P_norm)
            columns[k] = np.array([predicted, y, P_norm + R_norm, statistic])
            if seen.ended == 1:
                events.append(event_row(state, seen.ended_s, seen.returned))
            state = seen.state
            flags[k, 0], flags[k, 1] = seen.outlier, seen.found
            if seen.found == 1 and f.adapt:
                _adapt(x, P, f, B[k], y, R_norm)
            if not (seen.outlier == 1 and f.reject and not (seen.found == 1 and f.adapt)):
                P = _update(x, P, residual, H, R, f.spherical)
        flags[k, 2] = state.in_event
        states[k, :4], states[k, 4:7] = x[:4], x[14:]
        for i in range(3):
            states[k, 7 + i] = P[12 + i, 12 + i]
    if state.in_event == 1:
        events.append(event_row(state, np.nan, 0))
    rows = np.empty((len(events), 6))
    for k in range(len(events)):
        rows[k] = events[k]
    return states, columns, flags, rows, x, P


@njit(cache=True)
def _predict(x, P, f, gyro, dt):  # type: ignore[no-untyped-def]
    turn = (gyro - x[4:7]) * dt
    F = np.eye(STATES)
    F[:3, :3] = _matrix(_quaternion(turn)).T
    for i in range(3):
        F[i, 3 + i] = -dt
    x[:4] = _times(x[:4], _quaternion(turn))
    walk = np.zeros(STATES)
    for i in range(3):
        walk[i] = f.gyro_noise_rad_per_s
        walk[3 + i] = f.gyro_bias_walk_rad_per_s2 if P[3 + i, 3 + i] > 0.0 else 0.0
        walk[6 + i] = f.force_bias_walk_m_s3 if P[6 + i, 6 + i] > 0.0 else 0.0
        walk[12 + i] = f.magnitude_walk_uT
    if f.spherical:
        walk[13] = f.direction_walk_rad
        walk[14] = f.direction_walk_rad / max(np.sin(x[15]), 0.1)
    P = F @ P @ F.T
    for i in range(STATES):
        P[i, i] += walk[i] ** 2 * dt
    return P


@njit(cache=True)
def _gravity(x, P, f, force):  # type: ignore[no-untyped-def]
    up = _matrix(x[:4])[2] * GRAVITY_M_S2
    H = np.zeros((3, STATES))
    H[:, :3], H[:, 6:9] = _skew(up), np.eye(3)
    departure = np.sqrt(force @ force) - GRAVITY_M_S2
    R = (f.force_noise_m_s2**2 + departure**2) * np.eye(3)
    return _update(x, P, force - up - x[7:10], H, R, f.spherical)


@njit(cache=True)
def _innovation(x, P, f, B, R_sensor, R_fixed):  # type: ignore[no-untyped-def]
    to_building, to_sensor = _matrix(x[:4]), np.ascontiguousarray(_matrix(x[10:14]).T)
    H = np.zeros((3, STATES))
    world = _cartesian(x[14:]) if f.spherical else x[14:].copy()
    body = np.ascontiguousarray(to_building.T) @ world
    sensor = to_sensor @ body
    by_building = to_sensor @ np.ascontiguousarray(to_building.T)
    if not f.spherical:
        H[:, :3], H[:, 9:12], H[:, 12:] = to_sensor @ _skew(body), _skew(sensor), by_building
        unit = sensor / np.sqrt(sensor @ sensor)
        P_norm = unit @ (H @ P @ H.T) @ unit
        return B - sensor, H, R_sensor, unit @ R_sensor @ unit, P_norm
    size = np.abs(sensor)
    axis = 2
    if size[2] > NEAR_POLE * np.sqrt(size @ size):
        axis = 1 if size[1] < size[0] else 0
    pole = np.zeros((3, 3))
    for i in range(3):
        pole[i, (i + axis + 1) % 3] = 1.0
    turned, z = pole @ sensor, pole @ B
    J = _by_components(turned)
    H[:, :3], H[:, 9:12] = J @ pole @ to_sensor @ _skew(body), J @ pole @ _skew(sensor)
    H[:, 12:] = J @ pole @ by_building @ _by_angles(x[14:])
    H[0, :] = 0.0
    H[1:, 12] = 0.0
    H[0, 12] = 1.0
    R = R_fixed
    if f.rotate_noise:
        at = z if np.hypot(z[0], z[1]) > ON_POLE * np.sqrt(z @ z) else turned
        J = _by_components(at)
        R = J @ (pole @ R_sensor @ pole.T) @ J.T
    residual = np.array(
        [
            np.sqrt(z @ z) - x[14],
            np.arctan2(np.hypot(z[0], z[1]), z[2]) - np.arctan2(np.hypot(turned[0], turned[1]), turned[2]),
            np.pi - (np.pi - np.arctan2(z[1], z[0]) + np.arctan2(turned[1], turned[0])) % (2 * np.pi),
        ]
    )
    return residual, H, R, R[0, 0], P[12, 12]


@njit(cache=True)
def _adapt(x, P, f, B, y, R_norm):  # type: ignore[no-untyped-def]
    if not f.spherical:
        P[12:, :] = 0.0
        P[:, 12:] = 0.0
        for i in range(12, 15):
            P[i, i] = f.reset_sd_uT**2
        return
    P[12, 12] = adapted_variance(P[12, 12], y, R_norm)
    if f.adapt_angles:
        seen = _matrix(x[:4]) @ (_matrix(x[10:14]) @ B)
        unit = _cartesian(np.array([1.0, x[15], x[16]]))
        across = np.cross(unit, seen)
        apart = np.arctan2(np.sqrt(across @ across), unit @ seen)
        P[13, 13] = max(P[13, 13], apart**2)
        P[14, 14] = max(P[14, 14], (apart / max(np.sin(x[15]), 0.1)) ** 2)


@njit(cache=True)
def _update(x, P, residual, H, R, spherical):  # type: ignore[no-untyped-def]
    gain = np.ascontiguousarray(np.linalg.solve(H @ P @ H.T + R, H @ P).T)
    dx = gain @ residual
    left = np.eye(STATES) - gain @ H
    P = left @ P @ left.T + gain @ R @ gain.T
    x[:4] = _times(x[:4], _quaternion(dx[:3]))
    x[4:10] += dx[3:9]
    x[10:14] = _times(x[10:14], _quaternion(dx[9:12]))
    x[14:] += dx[12:]
    if spherical:
        _into_range(x, P)
    return P


@njit(cache=True)
def _into_range(x, P):  # type: ignore[no-untyped-def]
    if x[14] < 0.0:
        x[14], x[15], x[16] = -x[14], np.pi - x[15], x[16] + np.pi
        _flip(P, 12)
        _flip(P, 13)
    x[15] %= 2 * np.pi
    if x[15] > np.pi:
        x[15], x[16] = 2 * np.pi - x[15], x[16] + np.pi
        _flip(P, 13)
    x[16] %= 2 * np.pi


@njit(cache=True)
def _flip(P, i):  # type: ignore[no-untyped-def]
    P[i, :] *= -1.0
    P[:, i] *= -1.0


@njit(cache=True)
def _cartesian(m):  # type: ignore[no-untyped-def]
    r, st = m[0], np.sin(m[1])
    return np.array([r * st * np.cos(m[2]), r * st * np.sin(m[2]), r * np.cos(m[1])])


@njit(cache=True)
def _by_angles(m):  # type: ignore[no-untyped-def]
    r, st, ct, sp, cp = m[0], np.sin(m[1]), np.cos(m[1]), np.sin(m[2]), np.cos(m[2])
    return np.array([[st * cp, r * ct * cp, -r * st * sp], [st * sp, r * ct * sp, r * st * cp], [ct, -r * st, 0.0]])


@njit(cache=True)
def _by_components(v):  # type: ignore[no-untyped-def]
    x, y, z = v
    rho, r = np.hypot(x, y), np.sqrt(x * x + y * y + z * z)
    return np.array(
        [
            [x / r, y / r, z / r],
            [x * z / (r * r * rho), y * z / (r * r * rho), -rho / (r * r)],
            [-y / (rho * rho), x / (rho * rho), 0.0],
        ]
    )


@njit(cache=True)
def _skew(v):  # type: ignore[no-untyped-def]
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@njit(cache=True)
def _quaternion(turn):  # type: ignore[no-untyped-def]
    angle = np.sqrt(turn @ turn)
    s = 0.5 - angle * angle / 48.0 if angle < 1e-4 else np.sin(0.5 * angle) / angle
    return np.array([np.cos(0.5 * angle), s * turn[0], s * turn[1], s * turn[2]])


@njit(cache=True)
def _times(a, b):  # type: ignore[no-untyped-def]
    q = np.array(
        [
            a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
            a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
            a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
            a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
        ]
    )
    return q / np.sqrt(q @ q)


@njit(cache=True)
def _matrix(q):  # type: ignore[no-untyped-def]
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
