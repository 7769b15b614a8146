"""The multiplicative extended Kalman filter, sample by sample, compiled (Kuevor, B20; Brommer, 1.3-1.9).

Errors, in blocks of three: attitude (body's axes), gyro bias, velocity, the field learned where no reference is given
(building frame, as Brommer's W_m), hard iron. Until a reading sets north, yaw is a matter of convention: it is fixed, and told
as unknown. Where the field is learned it stays so: it is learned in the frame chosen, and north read from it. Given the attitude from gyro and
gravity, field and hard iron are linear in the readings, so the filter needs no good first guess of either.

A disturbance shows in the two directions in which it cannot be taken for an error of yaw. Its power there, beyond what
the filter expects, is taken to be its power in every direction, and is added to the noise; so a slight disturbance
weighs a little, a strong one is ignored, and no threshold decides on it.

`plain_kernel` is its twin, in plain matrices.
"""

from numba import njit
from numpy import arctan2, cos, empty, exp, isfinite, pi, sin, sqrt, zeros

from app.attitude.error_dynamics import advance, bias_response, building_from_body, process_noise, turn_back
from app.attitude.joseph import condition, gain, innovation_covariance, inverse, squared_distance

__all__ = [
    "ANGLE", "BIAS", "FIELD", "IRON", "KEPT", "LAST_FORCE", "LAST_GYRO", "MEAN_FORCE", "MEAN_GYRO", "MEAN_RESIDUAL",
    "SIZE", "STILL_S", "T", "T_FORCE", "T_GYRO", "T_MAG", "DISTURBANCE", "FORCE_REJECTED_S", "MAG_REJECTED_S",
    "NORTH_SET", "VELOCITY", "run",
]  # fmt: skip

ANGLE, BIAS, VELOCITY, FIELD, IRON, SIZE = 0, 3, 6, 9, 12, 15

T, T_GYRO, T_FORCE, T_MAG = 0, 1, 2, 3
LAST_GYRO, LAST_FORCE, MEAN_GYRO, MEAN_FORCE, MEAN_RESIDUAL = 4, 7, 10, 13, 16
STILL_S, DISTURBANCE, FORCE_REJECTED_S, MAG_REJECTED_S, NORTH_SET, GRAVITY = 19, 20, 21, 22, 23, 24
SUM_WEIGHT, SUM_POWER, SUM_FIELD, SUM_IRON, SUM_R, KEPT = 25, 26, 27, 30, 33, 42
"""What is kept between samples besides mean and covariance: times, last and smoothed readings, how long rejected."""

REST_MEAN_S = 0.5
RESIDUAL_MEAN_S = 0.3
REST_CORRELATION_S = 1.0
NORTH_SET_S = 0.3
REST_SPEED_M_S = 0.02
RELEVELLED_RAD, LOST_RAD2 = 0.2, 0.1
BLAME_S, BLAME_SPREAD, BLAME_UT, BLAME_SHARE, LEAST_SPREAD, BLAMED_UT = 3.0, 0.2, 3.0, 0.7, 0.005, 1.5
"""Seconds looked back on, the rotation and scatter needed to judge, the share hard iron must explain of the scatter."""
UNKNOWN_YAW_RAD2 = pi * pi / 3.0


@njit(cache=True, nogil=True)
def _finite(row):  # type: ignore[no-untyped-def]
    return isfinite(row[0]) and isfinite(row[1]) and isfinite(row[2])


@njit(cache=True, nogil=True)
def _cross_into(H, column, v, sign):  # type: ignore[no-untyped-def]
    """sign [v x] into H (3, n) from a column."""
    H[0, column + 1], H[0, column + 2] = -sign * v[2], sign * v[1]
    H[1, column], H[1, column + 2] = sign * v[2], -sign * v[0]
    H[2, column], H[2, column + 1] = -sign * v[1], sign * v[0]
    H[0, column] = H[1, column + 1] = H[2, column + 2] = 0.0


@njit(cache=True, nogil=True)
def _forget(P, block):  # type: ignore[no-untyped-def]
    """No covariance of a block of three with anything."""
    for i in range(block, block + 3):
        for j in range(SIZE):
            P[i, j] = P[j, i] = 0.0


@njit(cache=True, nogil=True)
def _apply(q, x, dx):  # type: ignore[no-untyped-def]
    """Errors into the estimate: attitude by multiplication, the rest by addition (Kuevor, L1023 corrected)."""
    advance(q, dx[0], dx[1], dx[2])
    for i in range(SIZE - BIAS):
        x[i] += dx[BIAS + i]


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
            k[FORCE_REJECTED_S], k[NORTH_SET] = -1.0, 0.0
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
        _forget(P, VELOCITY)
        for i in range(3):
            x[3 + i] = 0.0
            P[VELOCITY + i, VELOCITY + i] = s.speed**2


@njit(cache=True, nogil=True)
def _measure(q, x, P, H, r, HP, S, noise, upright):  # type: ignore[no-untyped-def]
    """Condition on an innovation r (3,), its covariance S (3, 3) so far without this noise (3, 3).

    upright: tilt, level gyro biases and velocity are considered, not corrected (Schmidt).
    """
    total, dx = empty((3, 3)), empty(SIZE)
    for a in range(3):
        for b in range(3):
            total[a, b] = S[a, b] + noise[a, b]
    R, K = empty((3, 3)), empty((SIZE, 3))
    gain(HP, total, K)
    if upright:
        building_from_body(q, R)
        for a in range(3):
            for block in (ANGLE, BIAS):
                up = R[2, 0] * K[block, a] + R[2, 1] * K[block + 1, a] + R[2, 2] * K[block + 2, a]
                for i in range(3):
                    K[block + i, a] = R[2, i] * up
            for i in range(3):
                K[VELOCITY + i, a] = 0.0
    condition(P, HP, total, K, r, dx)
    _apply(q, x, dx)


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
    _forget(P, ANGLE)
    k[SUM_WEIGHT:KEPT] = 0.0
    for i in range(3):
        for j in range(3):
            P[i, j] = sd * sd * (R[0, i] * R[0, j] + R[1, i] * R[1, j]) + yaw * R[2, i] * R[2, j]


@njit(cache=True, nogil=True)
def _learn_field(q, x, P, z, sd):  # type: ignore[no-untyped-def]
    """Set the field state from a reading z (3,): its errors are those of attitude, hard iron and the reading's sd."""
    R, J, reading = empty((3, 3)), zeros((3, SIZE)), empty(3)
    building_from_body(q, R)
    for i in range(3):
        reading[i] = z[i] - x[IRON - BIAS + i]
    for i in range(3):
        x[FIELD - BIAS + i] = R[i, 0] * reading[0] + R[i, 1] * reading[1] + R[i, 2] * reading[2]
        J[i, 0] = -(R[i, 1] * reading[2] - R[i, 2] * reading[1])
        J[i, 1] = -(R[i, 2] * reading[0] - R[i, 0] * reading[2])
        J[i, 2] = -(R[i, 0] * reading[1] - R[i, 1] * reading[0])
        for j in range(3):
            J[i, IRON + j] = -R[i, j]
    _forget(P, FIELD)
    JP, S = empty((3, SIZE)), empty((3, 3))
    innovation_covariance(P, J, JP, S)
    for i in range(3):
        for j in range(SIZE):
            P[FIELD + i, j] = P[j, FIELD + i] = JP[i, j]
    for i in range(3):
        for j in range(3):
            P[FIELD + i, FIELD + j] = S[i, j] + (sd * sd if i == j else 0.0)


@njit(cache=True, nogil=True)
def _set_yaw(q, x, P, k, z, m, variance):  # type: ignore[no-untyped-def]
    """Turn the attitude about the vertical until a reading z (3,) has the azimuth of the field m (3,), uT.

    The error of yaw is then that of tilt about the field's level direction, times the slope of the field, that of hard
    iron across it, and the reading's; told as covariances, or later readings would be counted twice.
    """
    R, b = empty((3, 3)), zeros(3)
    building_from_body(q, R)
    for i in range(3):
        for j in range(3):
            b[i] += R[i, j] * (z[j] - x[IRON - BIAS + j])
    yaw = arctan2(m[1], m[0]) - arctan2(b[1], b[0])
    yaw = arctan2(sin(yaw), cos(yaw))
    advance(q, R[2, 0] * yaw, R[2, 1] * yaw, R[2, 2] * yaw)
    building_from_body(q, R)
    level = max(sqrt(m[0] * m[0] + m[1] * m[1]), 1e-6)
    T, TP, S = zeros((3, SIZE)), empty((3, SIZE)), empty((3, 3))
    for i in range(3):
        for j in range(3):
            along = (R[0, j] * m[0] + R[1, j] * m[1]) / level
            across = (R[1, j] * m[0] - R[0, j] * m[1]) / level
            T[i, j] = (1.0 if i == j else 0.0) - R[2, i] * R[2, j] + R[2, i] * along * m[2] / level
            T[i, IRON + j] = R[2, i] * across / level
    innovation_covariance(P, T, TP, S)
    known = 0.0
    for i in range(3):
        for j in range(3):
            known += R[2, i] * S[i, j] * R[2, j]
    more = variance / (level * level)
    if known + more > UNKNOWN_YAW_RAD2:  # a field that is all but vertical tells nothing of yaw
        k[NORTH_SET] = 0.0
        return
    for i in range(3):
        for j in range(SIZE):
            P[i, j] = P[j, i] = TP[i, j]
    for i in range(3):
        for j in range(3):
            P[i, j] = S[i, j] + more * R[2, i] * R[2, j]
    k[SUM_WEIGHT:KEPT] = 0.0


@njit(cache=True, nogil=True)
def _at_rest(q, x, P, k, gyro, dt, s):  # type: ignore[no-untyped-def]
    """A body that lies still does not turn and does not move."""
    H, HP, S, noise, r = zeros((3, SIZE)), empty((3, SIZE)), empty((3, 3)), zeros((3, 3)), empty(3)
    variance = s.gyro_noise**2 / dt + s.rest_rate**2 * max(1.0, 2.0 * REST_CORRELATION_S / dt)
    for i in range(3):
        H[i, BIAS + i], noise[i, i], r[i] = 1.0, variance, gyro[i] - x[i]
    innovation_covariance(P, H, HP, S)
    _measure(q, x, P, H, r, HP, S, noise, False)


@njit(cache=True, nogil=True)
def _watch_rest(k, gyro, force, dt, s):  # type: ignore[no-untyped-def]
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
def _relevel(q, x, P, k, s):  # type: ignore[no-untyped-def]
    """Believe the accelerometer again: what it read lately is gravity, and the velocity starts anew."""
    k[FORCE_REJECTED_S] = 0.0
    _level(q, P, k, k[MEAN_FORCE : MEAN_FORCE + 3], RELEVELLED_RAD)
    _forget(P, VELOCITY)
    for i in range(3):
        x[3 + i], P[VELOCITY + i, VELOCITY + i] = 0.0, s.speed**2 if s.bounded else 0.0


@njit(cache=True, nogil=True)
def _accelerometer(q, x, P, k, f, dt, s):  # type: ignore[no-untyped-def]
    """Gravity, or a velocity that stays small; whether it was believed."""
    H, HP, S, noise, r = zeros((3, SIZE)), empty((3, SIZE)), empty((3, 3)), zeros((3, 3)), empty(3)
    if k[FORCE_REJECTED_S] < 0.0:
        _relevel(q, x, P, k, s)
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
        _cross_into(H, ANGLE, k[GRAVITY] * R[2], 1.0)
    innovation_covariance(P, H, HP, S)
    for i in range(3):
        S[i, i] += sd * sd
    believed = squared_distance(S, r) < s.accelerometer_gate
    if believed:
        k[FORCE_REJECTED_S] = 0.0
        for i in range(3):
            noise[i, i] = sd * sd * (max(1.0, 2.0 * correlation / dt) - 1.0)
        _measure(q, x, P, H, r, HP, S, noise, False)
    else:
        k[FORCE_REJECTED_S] += dt
        if k[FORCE_REJECTED_S] > s.recovery:
            _relevel(q, x, P, k, s)
    return believed


@njit(cache=True, nogil=True)
def _disturbance(x, k, R, z, m, S, dt, s):  # type: ignore[no-untyped-def]
    """Keep the power (uT^2 per axis) of what is wrong with the field whatever the yaw: down, and level magnitude."""
    fade = exp(-dt / RESIDUAL_MEAN_S)
    level = sqrt(m[0] ** 2 + m[1] ** 2)
    along = empty(3)
    for i in range(3):  # the field's level direction, in the body's axes
        along[i] = (R[0, i] * m[0] + R[1, i] * m[1]) / max(level, 1e-9)
    for i in range(3):
        b = 0.0
        for j in range(3):
            b += R[i, j] * (z[j] - x[IRON - BIAS + j])
        k[MEAN_RESIDUAL + i] = fade * k[MEAN_RESIDUAL + i] + (1.0 - fade) * b
    down = k[MEAN_RESIDUAL + 2] - m[2]
    size = sqrt(k[MEAN_RESIDUAL] ** 2 + k[MEAN_RESIDUAL + 1] ** 2) - level
    expected_down = expected_size = 0.0
    for i in range(3):
        for j in range(3):
            expected_down += R[2, i] * S[i, j] * R[2, j]
            expected_size += along[i] * S[i, j] * along[j]
    own = s.field**2
    power = 0.5 * (max(0.0, down**2 - expected_down - own) + max(0.0, size**2 - expected_size - own))
    k[DISTURBANCE] = max(power, exp(-dt / s.memory) * k[DISTURBANCE])


@njit(cache=True, nogil=True)
def _blame_device(x, P, k, R, z, dt, s):  # type: ignore[no-untyped-def]
    """Learn the hard iron anew where it explains what was read lately.

    Least squares of R z = m + R h over the last seconds, by sums that fade: a magnet on the device turns with it, one
    in the room does not. Without rotation the two cannot be told apart, and nothing changes.
    """
    fade = exp(-dt / BLAME_S)
    k[SUM_WEIGHT] = fade * k[SUM_WEIGHT] + 1.0
    power = 0.0
    for i in range(3):
        b = R[i, 0] * z[0] + R[i, 1] * z[1] + R[i, 2] * z[2]
        k[SUM_FIELD + i] = fade * k[SUM_FIELD + i] + b
        k[SUM_IRON + i] = fade * k[SUM_IRON + i] + z[i]
        power += z[i] * z[i]
        for j in range(3):
            k[SUM_R + 3 * i + j] = fade * k[SUM_R + 3 * i + j] + R[i, j]
    k[SUM_POWER] = fade * k[SUM_POWER] + power
    n = k[SUM_WEIGHT]
    information, right, inverted, iron = empty((3, 3)), empty(3), empty((3, 3)), zeros(3)
    spread, scatter = 3.0, k[SUM_POWER] / n - 3.0 * s.reading**2
    for i in range(3):
        right[i] = k[SUM_IRON + i] / n
        scatter -= (k[SUM_FIELD + i] / n) ** 2
        for j in range(3):
            right[i] -= k[SUM_R + 3 * j + i] / n * k[SUM_FIELD + j] / n
            information[i, j] = 1.0 + LEAST_SPREAD if i == j else 0.0
            for a in range(3):
                information[i, j] -= k[SUM_R + 3 * a + i] / n * k[SUM_R + 3 * a + j] / n
        spread -= information[i, i] - LEAST_SPREAD
    spread = 1.0 - spread / 3.0
    inverse(information, inverted)
    explained = off = 0.0
    for i in range(3):
        for j in range(3):
            iron[i] += inverted[i, j] * right[j]
        own = x[IRON - BIAS + i]
        scatter -= 2.0 * own * right[i]
        for j in range(3):
            scatter += own * information[i, j] * x[IRON - BIAS + j]
    for i in range(3):
        miss = iron[i] - x[IRON - BIAS + i]
        off += miss * miss / 3.0
        for j in range(3):
            explained += miss * information[i, j] * (iron[j] - x[IRON - BIAS + j])
    if spread < BLAME_SPREAD or scatter < BLAME_UT**2 or explained < BLAME_SHARE * scatter:
        return
    if off > BLAMED_UT**2:
        _forget(P, IRON)
        k[DISTURBANCE] *= max(0.0, 1.0 - explained / scatter)
        for i in range(3):
            x[IRON - BIAS + i], P[IRON + i, IRON + i] = iron[i], BLAMED_UT**2


@njit(cache=True, nogil=True)
def _set_north(q, x, P, k, R, z, m, variance, learned, dt, s):  # type: ignore[no-untyped-def]
    """Yaw, or the learned field, from the mean of the first readings: their white noise need not be lived with."""
    mean, weight = empty(3), min(1.0, dt / (k[NORTH_SET] * NORTH_SET_S + dt))
    k[NORTH_SET] = min(1.0, k[NORTH_SET] + dt / NORTH_SET_S)
    k[DISTURBANCE] = 0.0
    for i in range(3):
        level = R[i, 0] * z[0] + R[i, 1] * z[1] + R[i, 2] * z[2]
        k[MEAN_RESIDUAL + i] += weight * (level - k[MEAN_RESIDUAL + i])
    for i in range(3):
        mean[i] = 0.0
        for j in range(3):
            mean[i] += R[j, i] * k[MEAN_RESIDUAL + j]
    if learned:
        _learn_field(q, x, P, mean, sqrt(s.reading**2 + s.field**2))
    elif k[NORTH_SET] == 1.0:
        typical = (variance[0, 0] + variance[1, 1] + variance[2, 2]) / 3.0
        _set_yaw(q, x, P, k, mean, m, s.reading**2 + s.field**2 + typical)
        for i in range(3):
            k[MEAN_RESIDUAL + i] = m[i]


@njit(cache=True, nogil=True)
def _magnetometer(q, x, P, k, z, reference, variance, learned, rate2, dt, s):  # type: ignore[no-untyped-def]
    """The field, known or learned; whether it was believed."""
    R, m = empty((3, 3)), empty(3)
    H, HP, S, noise, r = zeros((3, SIZE)), empty((3, SIZE)), empty((3, 3)), zeros((3, 3)), empty(3)
    for i in range(3):
        m[i] = x[FIELD - BIAS + i] if learned else reference[i]
    building_from_body(q, R)
    if s.learn_hard_iron:
        _blame_device(x, P, k, R, z, dt, s)
    if k[NORTH_SET] < 1.0:
        _set_north(q, x, P, k, R, z, m, variance, learned, dt, s)
        return True
    predicted = empty(3)
    for i in range(3):
        predicted[i] = R[0, i] * m[0] + R[1, i] * m[1] + R[2, i] * m[2]
        r[i] = z[i] - predicted[i] - x[IRON - BIAS + i]
        H[i, IRON + i] = 1.0
        for j in range(3):
            H[i, FIELD + j] = R[j, i] if learned else 0.0
    _cross_into(H, ANGLE, predicted, 1.0)
    innovation_covariance(P, H, HP, S)
    for i in range(3):
        for j in range(3):
            for a in range(3):
                for b in range(3):
                    noise[i, j] += R[a, i] * variance[a, b] * R[b, j]  # A V A^T: the map's, turned into the body's axes
            S[i, j] += noise[i, j]
    _disturbance(x, k, R, z, m, S, dt, s)
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
        _measure(q, x, P, H, r, HP, S, noise, learned)
    else:
        disturbed = k[DISTURBANCE] > s.disturbed**2
        k[MAG_REJECTED_S] += dt * ((s.recovery / s.new_field if learned else 0.0) if disturbed else 1.0)
        if k[MAG_REJECTED_S] > s.recovery:
            k[MAG_REJECTED_S], k[NORTH_SET] = 0.0, 0.0  # the next reading sets it anew
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
                out[3][n, 2] = _accelerometer(q, x, P, k, force[n], step, s)
        if has_gyro:
            step = t[n] - k[T_GYRO] if isfinite(k[T_GYRO]) else 0.0
            for i in range(3):
                k[LAST_GYRO + i] = gyro[n, i]
                held[i] = k[LAST_FORCE + i]
            k[T_GYRO] = t[n]
            if s.rest and step > 0.0 and isfinite(k[T_FORCE]):
                _watch_rest(k, gyro[n], held, step, s)
                if k[STILL_S] > s.rest_after:
                    _at_rest(q, x, P, k, gyro[n], step, s)
        if has_mag and has_reference:
            row = n if len(reference) > 1 else 0
            if learned or _finite(reference[row]):
                step = t[n] - k[T_MAG] if isfinite(k[T_MAG]) else 0.0
                rate2 = 0.0
                for i in range(3):
                    rate2 += (k[LAST_GYRO + i] - x[i]) ** 2
                at = row if len(variance) > 1 else 0
                if step > 0.0:
                    out[3][n, 0] = _magnetometer(
                        q, x, P, k, mag[n], reference[row], variance[at], learned, rate2, step, s
                    )
                    out[3][n, 1] = k[DISTURBANCE] > s.disturbed**2 or not out[3][n, 0]
                k[T_MAG] = t[n]
        _write(n, q, x, P, k, learned, s.gyro_delay, out)


@njit(cache=True, nogil=True)
def _write(n, q, x, P, k, learned, lead, out):  # type: ignore[no-untyped-def]
    """One row: where the field is learned, yaw counts from its azimuth, and yaw's variance is of that difference."""
    shown, R, J = empty(4), empty((3, 3)), zeros((3, SIZE))
    for i in range(4):
        shown[i] = q[i]
    if lead > 0.0:
        advance(shown, lead * (k[LAST_GYRO] - x[0]), lead * (k[LAST_GYRO + 1] - x[1]), lead * (k[LAST_GYRO + 2] - x[2]))
    building_from_body(shown, R)
    for i in range(3):
        J[i, i] = 1.0
    if learned and k[NORTH_SET] > 0.0:
        mx, my = x[FIELD - BIAS], x[FIELD - BIAS + 1]
        level2 = max(mx * mx + my * my, 1e-12)
        azimuth = arctan2(my, mx)
        advance(shown, -azimuth * R[2, 0], -azimuth * R[2, 1], -azimuth * R[2, 2])
        for i in range(3):  # d azimuth = (mx dmy - my dmx) / level2, taken off about the vertical
            J[i, FIELD] = R[2, i] * my / level2
            J[i, FIELD + 1] = -R[2, i] * mx / level2
    JP, S = empty((3, SIZE)), empty((3, 3))
    innovation_covariance(P, J, JP, S)
    unknown = UNKNOWN_YAW_RAD2 if k[NORTH_SET] < 1.0 else 0.0
    for i in range(3):
        out[2][n, i] = x[i]
        for j in range(3):
            out[1][n, i, j] = S[i, j] + unknown * R[2, i] * R[2, j]
    for i in range(4):
        out[0][n, i] = shown[i]
