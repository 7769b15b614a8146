"""Where north is: yaw or the learned field set from the first readings, and yaw as it is told, compiled."""

from numba import njit
from numpy import arctan2, cos, empty, isfinite, sin, sqrt, zeros

from app.attitude.correction import forget
from app.attitude.error_dynamics import advance, building_from_body
from app.attitude.joseph import innovation_covariance
from app.attitude.layout import (
    BIAS,
    DECLINATION,
    DECLINATION_RAD2,
    DISTURBANCE,
    FIELD,
    IRON,
    LAST_GYRO,
    MEAN_RESIDUAL,
    NORTH,
    NORTH_SET,
    NORTH_SET_S,
    SIZE,
    SUM_END,
    SUM_WEIGHT,
    UNKNOWN_YAW_RAD2,
)

__all__ = ["keep_north", "set_north", "tell"]


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
    forget(P, FIELD)
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
    k[SUM_WEIGHT:SUM_END] = 0.0


@njit(cache=True, nogil=True)
def keep_north(q, x, P, k):  # type: ignore[no-untyped-def]
    """Note where north is, and how well, before the field is learned anew: another place, but north is where it was."""
    R, g = empty((3, 3)), zeros(SIZE)
    building_from_body(q, R)
    mx, my = x[FIELD - BIAS], x[FIELD - BIAS + 1]
    level2 = max(mx * mx + my * my, 1e-12)
    k[NORTH] = arctan2(my, mx) - k[DECLINATION]
    g[FIELD], g[FIELD + 1] = my / level2, -mx / level2
    for i in range(3):
        g[i] = R[2, i]
    for i in range(SIZE):
        for j in range(SIZE):
            k[DECLINATION_RAD2] += g[i] * P[i, j] * g[j]


@njit(cache=True, nogil=True)
def set_north(q, x, P, k, R, z, m, variance, learned, dt, s):  # type: ignore[no-untyped-def]
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
        if isfinite(k[NORTH]):
            k[DECLINATION] = arctan2(x[FIELD - BIAS + 1], x[FIELD - BIAS]) - k[NORTH]
    elif k[NORTH_SET] == 1.0:
        typical = (variance[0, 0] + variance[1, 1] + variance[2, 2]) / 3.0
        _set_yaw(q, x, P, k, mean, m, s.reading**2 + s.field**2 + typical)
        for i in range(3):
            k[MEAN_RESIDUAL + i] = m[i]


@njit(cache=True, nogil=True)
def tell(n, q, x, P, k, learned, lead, out):  # type: ignore[no-untyped-def]
    """One row: where the field is learned, yaw counts from its azimuth, and yaw's variance is of that difference."""
    shown, R, J = empty(4), empty((3, 3)), zeros((3, SIZE))
    for i in range(4):
        shown[i] = q[i]
    if lead > 0.0:
        advance(shown, lead * (k[LAST_GYRO] - x[0]), lead * (k[LAST_GYRO + 1] - x[1]), lead * (k[LAST_GYRO + 2] - x[2]))
    building_from_body(shown, R)
    for i in range(3):
        J[i, i] = 1.0
    if learned and (k[NORTH_SET] > 0.0 or isfinite(k[NORTH])):
        mx, my = x[FIELD - BIAS], x[FIELD - BIAS + 1]
        level2 = max(mx * mx + my * my, 1e-12)
        azimuth = arctan2(my, mx) - k[DECLINATION]
        advance(shown, -azimuth * R[2, 0], -azimuth * R[2, 1], -azimuth * R[2, 2])
        for i in range(3):  # d azimuth = (mx dmy - my dmx) / level2, taken off about the vertical
            J[i, FIELD] = R[2, i] * my / level2
            J[i, FIELD + 1] = -R[2, i] * mx / level2
    JP, S = empty((3, SIZE)), empty((3, 3))
    innovation_covariance(P, J, JP, S)
    unknown = UNKNOWN_YAW_RAD2 if k[NORTH_SET] < 1.0 and not isfinite(k[NORTH]) else k[DECLINATION_RAD2]
    for i in range(3):
        out[2][n, i] = x[i]
        for j in range(3):
            out[1][n, i, j] = S[i, j] + unknown * R[2, i] * R[2, j]
    for i in range(4):
        out[0][n, i] = shown[i]
