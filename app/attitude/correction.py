"""What every measurement does to estimate and covariance, compiled (Kuevor, eqs. 3.9, 3.10; L1023 corrected)."""

from numba import njit
from numpy import empty

from app.attitude.error_dynamics import advance, building_from_body
from app.attitude.joseph import condition, gain
from app.attitude.layout import ANGLE, BIAS, SIZE, VELOCITY

__all__ = ["cross_into", "forget", "measure"]


@njit(cache=True, nogil=True)
def cross_into(H, column, v, sign):  # type: ignore[no-untyped-def]
    """sign [v x] into H (3, n) from a column."""
    H[0, column + 1], H[0, column + 2] = -sign * v[2], sign * v[1]
    H[1, column], H[1, column + 2] = sign * v[2], -sign * v[0]
    H[2, column], H[2, column + 1] = -sign * v[1], sign * v[0]
    H[0, column] = H[1, column + 1] = H[2, column + 2] = 0.0


@njit(cache=True, nogil=True)
def forget(P, block):  # type: ignore[no-untyped-def]
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
def measure(q, x, P, H, r, HP, S, noise, upright):  # type: ignore[no-untyped-def]
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
