"""The multiplicative extended Kalman filter, sample by sample, compiled (Kuevor, B20; Brommer, 1.3-1.9).

Errors, in blocks of three: attitude (body's axes), gyro bias, velocity, the field learned where no reference is given
(building frame, as Brommer's W_m), hard iron. Until a reading sets north, yaw is a matter of convention: it is fixed,
and told as unknown. Where the field is learned it stays so: it is learned in the frame chosen, and north read from it.
Given the attitude from gyro and gravity, field and hard iron are linear in the readings, so the filter needs no good
first guess of either.

`plain_kernel` is its twin, in plain matrices.
"""

from numba import njit
from numpy import empty, exp, isfinite, nan, zeros

from app.attitude.correction import cross_into, forget, measure
from app.attitude.error_dynamics import advance, bias_response, building_from_body, process_noise, turn_back
from app.attitude.field_watch import blame_device, watch_disturbance
from app.attitude.gravity import at_rest, heed_accelerometer, watch_rest
from app.attitude.joseph import innovation_covariance, squared_distance
from app.attitude.layout import (
    ANGLE,
    BIAS,
    DECLINATION,
    DECLINATION_RAD2,
    DISTURBANCE,
    FIELD,
    FORCE_REJECTED_S,
    GRAVITY,
    IRON,
    LAST_FORCE,
    LAST_GYRO,
    LOST_RAD2,
    MAG_REJECTED_S,
    MEAN_FORCE,
    NORTH,
    NORTH_SET,
    REST_MEAN_S,
    SIZE,
    STILL_S,
    T_FORCE,
    T_GYRO,
    T_MAG,
    VELOCITY,
    T,
)
from app.attitude.north import keep_north, set_north, tell

__all__ = ["run"]


@njit(cache=True, nogil=True)
def _finite(row):  # type: ignore[no-untyped-def]
    return isfinite(row[0]) and isfinite(row[1]) and isfinite(row[2])


@njit(cache=True, nogil=True)
def _predict(q, x, P, k, dt, rate, force, has_force, s):  # type: ignore[no-untyped-def]
    """Carry estimate and covariance over dt at a rate (3,), bias removed, and a specific force (3,)."""
    R, turn, respond, lever = empty((3, 3)), empty((3, 3)), empty((3, 3)), zeros((3, 3))
    turn_back(rate, dt, turn)
    bias_response(rate, dt, respond)
    half = 0.5 * dt
    advance(q, half * rate[0], half * rate[1], half * rate[2])
    building_from_body(q, R)  # where the force is taken to the building frame: half way
    advance(q, half * rate[0], half * rate[1], half * rate[2])
    if s.bounded and has_force:
        for i in range(3):
            lever[i, 0] = -dt * (R[i, 1] * force[2] - R[i, 2] * force[1])
            lever[i, 1] = -dt * (R[i, 2] * force[0] - R[i, 0] * force[2])
            lever[i, 2] = -dt * (R[i, 0] * force[1] - R[i, 1] * force[0])
            x[3 + i] += dt * (R[i, 0] * force[0] + R[i, 1] * force[1] + R[i, 2] * force[2])
        x[5] -= dt * k[GRAVITY]
    old = empty((6, SIZE))
    for side in range(2):  # F P, then (F P) F^T, P being symmetric in between only as a pair
        for j in range(SIZE):
            for i in range(6):
                old[i, j] = P[i, j] if side == 0 else P[j, i]
            for i in range(3):
                angle = velocity = 0.0
                for a in range(3):
                    angle += turn[i, a] * old[a, j] + respond[i, a] * old[3 + a, j]
                    velocity += lever[i, a] * old[a, j]
                if side == 0:
                    P[i, j] = angle
                    P[VELOCITY + i, j] += velocity
                else:
                    P[j, i] = angle
                    P[j, VELOCITY + i] += velocity
    noise = process_noise(s.gyro_noise, s.bias_walk, dt)
    size2 = rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2
    wrong = s.gyro_scale**2 * size2 * dt
    if dt > s.gyro_gap:
        turned = (s.unknown_rate * (dt - s.gyro_gap)) ** 2
        wrong += turned
        if turned > LOST_RAD2:  # too wrong for small angles: the next readings set the attitude anew
            k[FORCE_REJECTED_S], k[NORTH_SET], k[NORTH], k[DECLINATION], k[DECLINATION_RAD2] = -1.0, 0.0, nan, 0.0, 0.0
    for i in range(3):
        P[i, i] += noise[0] + wrong
        P[i, BIAS + i] += noise[1]
        P[BIAS + i, i] += noise[1]
        P[BIAS + i, BIAS + i] += noise[2]
        P[FIELD + i, FIELD + i] += s.field_walk**2 * dt * k[NORTH_SET]
        P[IRON + i, IRON + i] += s.hard_iron_walk**2 * dt
        if s.bounded:
            P[VELOCITY + i, VELOCITY + i] += s.force_noise**2 * dt
    if s.bounded and (not has_force or dt > s.gyro_gap):
        forget(P, VELOCITY)
        for i in range(3):
            x[3 + i] = 0.0
            P[VELOCITY + i, VELOCITY + i] = s.speed**2


@njit(cache=True, nogil=True)
def _heed_magnetometer(q, x, P, k, z, reference, variance, learned, rate2, dt, s):  # type: ignore[no-untyped-def]
    """The field, known or learned; whether it was believed."""
    R, m = empty((3, 3)), empty(3)
    H, HP, S, noise, r = zeros((3, SIZE)), empty((3, SIZE)), empty((3, 3)), zeros((3, 3)), empty(3)
    building_from_body(q, R)
    if s.learn_hard_iron:
        blame_device(x, P, k, R, z, learned, dt, s)
    for i in range(3):
        m[i] = x[FIELD - BIAS + i] if learned else reference[i]
    if k[NORTH_SET] < 1.0:
        set_north(q, x, P, k, R, z, m, variance, learned, dt, s)
        return True
    predicted = empty(3)
    for i in range(3):
        predicted[i] = R[0, i] * m[0] + R[1, i] * m[1] + R[2, i] * m[2]
        r[i] = z[i] - predicted[i] - x[IRON - BIAS + i]
        H[i, IRON + i] = 1.0
        for j in range(3):
            H[i, FIELD + j] = R[j, i] if learned else 0.0
    cross_into(H, ANGLE, predicted, 1.0)
    innovation_covariance(P, H, HP, S)
    for i in range(3):
        for j in range(3):
            for a in range(3):
                for b in range(3):
                    noise[i, j] += R[a, i] * variance[a, b] * R[b, j]  # A V A^T: the map's, turned into the body's axes
            S[i, j] += noise[i, j]
    watch_disturbance(x, k, R, z, m, S, dt, s)
    size2 = m[0] ** 2 + m[1] ** 2 + m[2] ** 2
    disturbance = k[DISTURBANCE] if s.weigh_disturbances else 0.0
    slow = s.field**2 + disturbance
    for i in range(3):
        S[i, i] += s.reading**2 + s.field**2 + s.delay**2 * rate2 * size2
    believed = squared_distance(S, r) < s.magnetometer_gate
    if believed:
        k[MAG_REJECTED_S] = 0.0
        more = max(1.0, 2.0 * s.field_correlation / dt) - 1.0
        for i in range(3):
            for j in range(3):
                noise[i, j] *= more
            noise[i, i] += slow * more + disturbance
        measure(q, x, P, H, r, HP, S, noise, learned)
    else:
        disturbed = k[DISTURBANCE] > s.disturbed**2
        k[MAG_REJECTED_S] += dt * ((s.recovery / s.new_field if learned else 0.0) if disturbed else 1.0)
        if k[MAG_REJECTED_S] > s.recovery:
            k[MAG_REJECTED_S], k[NORTH_SET] = 0.0, 0.0  # the next readings set it anew
            if learned:
                keep_north(q, x, P, k)
    return believed


@njit(cache=True, nogil=True)
def run(q, x, P, k, t, gyro, force, mag, reference, variance, has_reference, learned, s, out):  # type: ignore[no-untyped-def]
    """Follow n samples: q (4,), x (12,), P (15, 15) and k (KEPT,) change in place; what is known after each into `out`.

    reference (n or 1, 3) and variance (n or 1, 3, 3) uT, uT^2 in the building frame; `out`: q (n, 4), P (n, 3, 3),
    bias (n, 3), and flags (n, 3): magnetometer believed, disturbed, accelerometer believed.
    """
    rate, pulled, held = empty(3), empty(3), empty(3)
    for n in range(len(t)):
        has_gyro, has_force, has_mag = _finite(gyro[n]), _finite(force[n]), _finite(mag[n])
        dt = t[n] - k[T] if isfinite(k[T]) else 0.0
        if dt > 0.0:
            for i in range(3):
                rate[i] = (gyro[n, i] if has_gyro else k[LAST_GYRO + i]) - x[i]  # a reading is the mean since the last
                now = force[n, i] if has_force else k[LAST_FORCE + i]
                pulled[i] = 0.5 * (k[LAST_FORCE + i] + now)
            fresh = has_force or t[n] - k[T_FORCE] < s.gyro_gap
            _predict(q, x, P, k, dt, rate, pulled, fresh, s)
        k[T] = t[n]
        if has_force:
            step = t[n] - k[T_FORCE] if isfinite(k[T_FORCE]) else 0.0
            fade = exp(-step / REST_MEAN_S) if isfinite(k[T_FORCE]) else 0.0
            for i in range(3):
                k[LAST_FORCE + i] = force[n, i]
                k[MEAN_FORCE + i] = fade * k[MEAN_FORCE + i] + (1.0 - fade) * force[n, i]
            k[T_FORCE] = t[n]
            if step > 0.0:
                out[3][n, 2] = heed_accelerometer(q, x, P, k, force[n], step, s)
        if has_gyro:
            step = t[n] - k[T_GYRO] if isfinite(k[T_GYRO]) else 0.0
            for i in range(3):
                k[LAST_GYRO + i] = gyro[n, i]
                held[i] = k[LAST_FORCE + i]
            k[T_GYRO] = t[n]
            if s.rest and step > 0.0 and isfinite(k[T_FORCE]):
                watch_rest(k, gyro[n], held, step, s)
                if k[STILL_S] > s.rest_after:
                    at_rest(q, x, P, k, gyro[n], step, s)
        if has_mag and has_reference:
            row = n if len(reference) > 1 else 0
            if learned or _finite(reference[row]):
                step = t[n] - k[T_MAG] if isfinite(k[T_MAG]) else 0.0
                rate2 = 0.0
                for i in range(3):
                    rate2 += (k[LAST_GYRO + i] - x[i]) ** 2
                at = row if len(variance) > 1 else 0
                if step > 0.0:
                    out[3][n, 0] = _heed_magnetometer(
                        q, x, P, k, mag[n], reference[row], variance[at], learned, rate2, step, s
                    )
                    out[3][n, 1] = k[DISTURBANCE] > s.disturbed**2 or not out[3][n, 0]
                k[T_MAG] = t[n]
        tell(n, q, x, P, k, learned, s.gyro_delay, out)
