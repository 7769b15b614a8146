"""Quaternions, and how small errors of attitude and gyro bias grow between samples, compiled (Kuevor, B20).

Quaternions are scalar-first, body to building. The error of attitude is an angle about the body's axes,
`R_true = R_estimate (I + [delta x])`, which is Kuevor's delta alpha though his quaternion is the conjugate and last.
"""

from numba import njit
from numpy import cos, empty, sin, sqrt

__all__ = ["advance", "bias_response", "building_from_body", "process_noise", "turn_back"]

SMALL_RAD = 0.02
"""Below this angle the closed forms lose digits, and their series are exact to rounding."""


@njit(cache=True, nogil=True)
def building_from_body(q, out):  # type: ignore[no-untyped-def]
    """The rotation matrix (3, 3) of a unit quaternion (4,), into `out`."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    out[0, 0], out[0, 1], out[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)


@njit(cache=True, nogil=True)
def advance(q, a, b, c):  # type: ignore[no-untyped-def]
    """Turn `q` (4,) in place by a rotation vector, rad, about the body's axes; unit length (Kuevor, eq. 3.2)."""
    angle2 = a * a + b * b + c * c
    angle = sqrt(angle2)
    if angle < SMALL_RAD:
        s = 0.5 - angle2 / 48.0 * (1.0 - angle2 / 80.0)
        c0 = 1.0 - angle2 / 8.0 * (1.0 - angle2 / 48.0 * (1.0 - angle2 / 120.0))
    else:
        s, c0 = sin(0.5 * angle) / angle, cos(0.5 * angle)
    x, y, z = s * a, s * b, s * c
    w0, x0, y0, z0 = q[0], q[1], q[2], q[3]
    q[0] = w0 * c0 - x0 * x - y0 * y - z0 * z
    q[1] = w0 * x + x0 * c0 + y0 * z - z0 * y
    q[2] = w0 * y - x0 * z + y0 * c0 + z0 * x
    q[3] = w0 * z + x0 * y - y0 * x + z0 * c0
    length = sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for i in range(4):
        q[i] /= length


@njit(cache=True, nogil=True)
def _polynomial(out, w, one, cross, square):  # type: ignore[no-untyped-def]
    """one I + cross [w x] + square [w x]^2 into `out` (3, 3)."""
    x, y, z = w[0], w[1], w[2]
    n2 = x * x + y * y + z * z
    for i in range(3):
        for j in range(3):
            out[i, j] = square * w[i] * w[j]
        out[i, i] += one - square * n2
    out[0, 1] -= cross * z
    out[0, 2] += cross * y
    out[1, 0] += cross * z
    out[1, 2] -= cross * x
    out[2, 0] -= cross * y
    out[2, 1] += cross * x


@njit(cache=True, nogil=True)
def turn_back(rate, dt, out):  # type: ignore[no-untyped-def]
    """Phi11 (3, 3) = exp(-[rate x] dt), rate (3,) rad/s (Kuevor, B20)."""
    n2 = rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2
    n = sqrt(n2)
    if n * dt < SMALL_RAD:
        a2 = n2 * dt * dt
        first, second = dt * (1.0 - a2 / 6.0 * (1.0 - a2 / 20.0)), dt * dt * (0.5 - a2 / 24.0 * (1.0 - a2 / 30.0))
    else:
        first, second = sin(n * dt) / n, (1.0 - cos(n * dt)) / n2
    _polynomial(out, rate, 1.0, -first, second)


@njit(cache=True, nogil=True)
def bias_response(rate, dt, out):  # type: ignore[no-untyped-def]
    """Phi12 (3, 3): the error of attitude after dt that a unit error of gyro bias makes, s (Kuevor, B20)."""
    n2 = rate[0] ** 2 + rate[1] ** 2 + rate[2] ** 2
    n = sqrt(n2)
    if n * dt < SMALL_RAD:
        a2 = n2 * dt * dt
        second = dt * dt * (0.5 - a2 / 24.0 * (1.0 - a2 / 30.0))
        third = dt**3 * (1.0 / 6.0 - a2 / 120.0 * (1.0 - a2 / 42.0))
    else:
        second, third = (1.0 - cos(n * dt)) / n2, (n * dt - sin(n * dt)) / (n2 * n)
    _polynomial(out, rate, -dt, second, -third)


@njit(cache=True, nogil=True)
def process_noise(noise_density, bias_walk, dt):  # type: ignore[no-untyped-def]
    """Per axis: variance of attitude, covariance with bias, variance of bias after dt (Kuevor, B20).

    Upsilon Q Upsilon^T: rad^2, rad^2/s, (rad/s)^2. Exact without rotation, and nearly so for turns of a few degrees.
    """
    v, u = noise_density * noise_density, bias_walk * bias_walk
    out = empty(3)
    out[0], out[1], out[2] = v * dt + u * dt**3 / 3.0, -u * dt * dt / 2.0, u * dt
    return out
