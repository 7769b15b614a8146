"""The accelerometer and rest: which way is up, compiled.

Either every reading is gravity (Kuevor), or what it makes of the velocity must stay small.
"""

from numba import njit
from numpy import arctan2, empty, exp, pi, sqrt, zeros

from app.attitude.correction import cross_into, forget, measure
from app.attitude.error_dynamics import advance, building_from_body
from app.attitude.joseph import innovation_covariance, squared_distance
from app.attitude.layout import (
    ANGLE,
    BIAS,
    FORCE_REJECTED_S,
    GRAVITY,
    MEAN_FORCE,
    MEAN_GYRO,
    NORTH_SET,
    RELEVELLED_RAD,
    REST_CORRELATION_S,
    REST_MEAN_S,
    REST_SPEED_M_S,
    SIZE,
    STILL_S,
    SUM_END,
    SUM_WEIGHT,
    VELOCITY,
)

__all__ = ["at_rest", "heed_accelerometer", "watch_rest"]


@njit(cache=True, nogil=True)
def _level(q, P, k, force, sd):  # type: ignore[no-untyped-def]
    """Turn the attitude the short way until a specific force (3,), body's axes, points up; tilt known to sd, rad."""
    R, turn = empty((3, 3)), empty(3)
    building_from_body(q, R)
    up = empty(3)
    size = sqrt(force[0] ** 2 + force[1] ** 2 + force[2] ** 2)
    for i in range(3):
        up[i] = (R[i, 0] * force[0] + R[i, 1] * force[1] + R[i, 2] * force[2]) / size
    sine = sqrt(up[0] ** 2 + up[1] ** 2)
    if sine > 1e-12:
        angle = arctan2(sine, up[2])
        a, b = up[1] / sine * angle, -up[0] / sine * angle
    else:
        a, b = (0.0 if up[2] > 0.0 else pi), 0.0
    for i in range(3):  # the axis lies in the building frame; q advances about the body's axes
        turn[i] = R[0, i] * a + R[1, i] * b
    yaw = 0.0
    for i in range(3):
        for j in range(3):
            yaw += R[2, i] * P[i, j] * R[2, j] * k[NORTH_SET]
    advance(q, turn[0], turn[1], turn[2])
    building_from_body(q, R)
    forget(P, ANGLE)
    k[SUM_WEIGHT:SUM_END] = 0.0
    for i in range(3):
        for j in range(3):
            P[i, j] = sd * sd * (R[0, i] * R[0, j] + R[1, i] * R[1, j]) + yaw * R[2, i] * R[2, j]


@njit(cache=True, nogil=True)
def relevel(q, x, P, k, s):  # type: ignore[no-untyped-def]
    """Believe the accelerometer again: what it read lately is gravity, and the velocity starts anew."""
    k[FORCE_REJECTED_S] = 0.0
    _level(q, P, k, k[MEAN_FORCE : MEAN_FORCE + 3], RELEVELLED_RAD)
    forget(P, VELOCITY)
    for i in range(3):
        x[3 + i], P[VELOCITY + i, VELOCITY + i] = 0.0, s.speed**2 if s.bounded else 0.0


@njit(cache=True, nogil=True)
def watch_rest(k, gyro, force, dt, s):  # type: ignore[no-untyped-def]
    """How long gyro and accelerometer have kept to their recent means."""
    fade = exp(-dt / REST_MEAN_S)
    turned = moved = mean = 0.0
    for i in range(3):
        if k[STILL_S] < 0.0:
            k[MEAN_GYRO + i] = gyro[i]
        k[MEAN_GYRO + i] = fade * k[MEAN_GYRO + i] + (1.0 - fade) * gyro[i]
        turned += (gyro[i] - k[MEAN_GYRO + i]) ** 2
        moved += (force[i] - k[MEAN_FORCE + i]) ** 2
        mean = max(mean, abs(k[MEAN_GYRO + i]))
    still = turned < s.rest_gyro**2 and moved < s.rest_force**2 and mean < s.rest_bias
    k[STILL_S] = max(k[STILL_S], 0.0) + dt if still else 0.0


@njit(cache=True, nogil=True)
def at_rest(q, x, P, k, gyro, dt, s):  # type: ignore[no-untyped-def]
    """A body that lies still does not turn and does not move."""
    H, HP, S, noise, r = zeros((3, SIZE)), empty((3, SIZE)), empty((3, 3)), zeros((3, 3)), empty(3)
    variance = s.gyro_noise**2 / dt + s.rest_rate**2 * max(1.0, 2.0 * REST_CORRELATION_S / dt)
    for i in range(3):
        H[i, BIAS + i], noise[i, i], r[i] = 1.0, variance, gyro[i] - x[i]
    innovation_covariance(P, H, HP, S)
    measure(q, x, P, H, r, HP, S, noise, False)


@njit(cache=True, nogil=True)
def heed_accelerometer(q, x, P, k, f, dt, s):  # type: ignore[no-untyped-def]
    """Gravity, or a velocity that stays small; whether it was believed."""
    H, HP, S, noise, r = zeros((3, SIZE)), empty((3, SIZE)), empty((3, 3)), zeros((3, 3)), empty(3)
    if k[FORCE_REJECTED_S] < 0.0:
        relevel(q, x, P, k, s)
        return True
    if s.bounded:
        at_rest = s.rest and k[STILL_S] > s.rest_after
        sd, correlation = (REST_SPEED_M_S, REST_MEAN_S) if at_rest else (s.speed, s.speed_correlation)
        for i in range(3):
            H[i, VELOCITY + i], r[i] = 1.0, -x[3 + i]
    else:
        R = empty((3, 3))
        building_from_body(q, R)
        sd, correlation = s.gravity_sd, s.gravity_correlation
        for i in range(3):
            r[i] = f[i] - k[GRAVITY] * R[2, i]
        cross_into(H, ANGLE, k[GRAVITY] * R[2], 1.0)
    innovation_covariance(P, H, HP, S)
    for i in range(3):
        S[i, i] += sd * sd
    believed = squared_distance(S, r) < s.accelerometer_gate
    if believed:
        k[FORCE_REJECTED_S] = 0.0
        for i in range(3):
            noise[i, i] = sd * sd * (max(1.0, 2.0 * correlation / dt) - 1.0)
        measure(q, x, P, H, r, HP, S, noise, False)
    else:
        k[FORCE_REJECTED_S] += dt
        if k[FORCE_REJECTED_S] > s.recovery:
            relevel(q, x, P, k, s)
    return believed
