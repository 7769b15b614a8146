"""What is wrong with the field read, and whether the device is to blame, compiled (compare Brommer, 1.8-1.9).

A disturbance shows in the two directions in which it cannot be taken for an error of yaw. Its power there, beyond what
the filter expects, is taken to be its power in every direction, and is added to the noise; so a slight disturbance
weighs a little, a strong one is ignored, and no threshold decides on it.
"""

from numba import njit
from numpy import empty, exp, sqrt, zeros

from app.attitude.correction import forget
from app.attitude.joseph import inverse
from app.attitude.layout import (
    BIAS,
    BLAME_S,
    BLAME_SHARE,
    BLAME_SPREAD,
    BLAME_UT,
    BLAMED_UT,
    DISTURBANCE,
    FIELD,
    IRON,
    LEAST_SPREAD,
    MEAN_RESIDUAL,
    MEND_S,
    MENDING_S,
    RESIDUAL_MEAN_S,
    SUM_FIELD,
    SUM_IRON,
    SUM_POWER,
    SUM_R,
    SUM_WEIGHT,
)

__all__ = ["blame_device", "watch_disturbance"]


@njit(cache=True, nogil=True)
def watch_disturbance(x, k, R, z, m, S, dt, s):  # type: ignore[no-untyped-def]
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
def blame_device(x, P, k, R, z, learned, dt, s):  # type: ignore[no-untyped-def]
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
    off, left = 0.0, scatter
    for i in range(3):
        for j in range(3):
            iron[i] += inverted[i, j] * right[j]
        information[i, i] -= LEAST_SPREAD
    for i in range(3):
        own = x[IRON - BIAS + i]
        off += (iron[i] - own) ** 2 / 3.0
        scatter -= 2.0 * own * right[i]
        left -= 2.0 * iron[i] * right[i]
        for j in range(3):
            scatter += own * information[i, j] * x[IRON - BIAS + j]
            left += iron[i] * information[i, j] * iron[j]
    k[MENDING_S] = max(0.0, k[MENDING_S] - dt)
    if spread < BLAME_SPREAD:
        return
    if scatter > BLAME_UT**2 and scatter - left > BLAME_SHARE * scatter and off > BLAMED_UT**2:
        _set_iron(x, P, iron)
        k[DISTURBANCE] *= max(0.0, left / scatter)
        k[MENDING_S] = MEND_S
    if learned and k[MENDING_S] > 0.0 and left < 3.0 * BLAMED_UT**2:
        _mend_field(x, P, k, iron)


@njit(cache=True, nogil=True)
def _set_iron(x, P, iron):  # type: ignore[no-untyped-def]
    forget(P, IRON)
    for i in range(3):
        x[IRON - BIAS + i], P[IRON + i, IRON + i] = iron[i], BLAMED_UT**2


@njit(cache=True, nogil=True)
def _mend_field(x, P, k, iron):  # type: ignore[no-untyped-def]
    """The field that goes with this hard iron (3,), where the one learned was learned with another."""
    field, off, size = empty(3), 0.0, 0.0
    for i in range(3):
        field[i] = k[SUM_FIELD + i] / k[SUM_WEIGHT]
        for j in range(3):
            field[i] -= k[SUM_R + 3 * i + j] / k[SUM_WEIGHT] * iron[j]
        size += iron[i] * iron[i] / 3.0
        off += (field[i] - x[FIELD - BIAS + i]) ** 2 / 3.0
    if off > BLAME_UT**2 and size > BLAME_UT**2:
        k[MENDING_S] = 0.0
        _set_iron(x, P, iron)
        forget(P, FIELD)
        for i in range(3):
            x[FIELD - BIAS + i], P[FIELD + i, FIELD + i] = field[i], BLAMED_UT**2
