"""A measurement of three numbers into a joint covariance, compiled: gain, chi-square, and Joseph's form written out."""

from numba import njit
from numpy import empty, sqrt

__all__ = ["condition", "gain", "innovation_covariance", "inverse", "squared_distance"]


@njit(cache=True, nogil=True)
def inverse(S, out):  # type: ignore[no-untyped-def]
    """The inverse of a symmetric positive (3, 3), into `out`, by Cholesky: cofactors would square its condition."""
    l00 = sqrt(S[0, 0])
    l10, l20 = S[1, 0] / l00, S[2, 0] / l00
    l11 = sqrt(S[1, 1] - l10 * l10)
    l21 = (S[2, 1] - l20 * l10) / l11
    l22 = sqrt(S[2, 2] - l20 * l20 - l21 * l21)
    a, b, c = 1.0 / l00, 1.0 / l11, 1.0 / l22  # the lower triangle's inverse: [a], [d b], [f e c]
    d, e = -l10 * a * b, -l21 * b * c
    f = -(l20 * a + l21 * d) * c
    out[0, 0], out[1, 1], out[2, 2] = a * a + d * d + f * f, b * b + e * e, c * c
    out[0, 1] = out[1, 0] = d * b + f * e
    out[0, 2] = out[2, 0] = f * c
    out[1, 2] = out[2, 1] = e * c


@njit(cache=True, nogil=True)
def innovation_covariance(P, H, HP, S):  # type: ignore[no-untyped-def]
    """HP (3, n) and S (3, 3) = H P H^T, without the noise, into the arrays given."""
    n = P.shape[0]
    for a in range(3):
        for j in range(n):
            HP[a, j] = 0.0
        for i in range(n):
            h = H[a, i]
            if h != 0.0:
                for j in range(n):
                    HP[a, j] += h * P[i, j]
    for a in range(3):
        for b in range(3):
            total = 0.0
            for j in range(n):
                total += HP[a, j] * H[b, j]
            S[a, b] = total


@njit(cache=True, nogil=True)
def squared_distance(S, r):  # type: ignore[no-untyped-def]
    """r^T S^-1 r: chi-square with three degrees of freedom under a correct model."""
    W = empty((3, 3))
    inverse(S, W)
    total = 0.0
    for a in range(3):
        for b in range(3):
            total += r[a] * W[a, b] * r[b]
    return total


@njit(cache=True, nogil=True)
def gain(HP, S, K):  # type: ignore[no-untyped-def]
    """Kalman's gain (n, 3) = P H^T S^-1, noise included in S, into K."""
    W = empty((3, 3))
    inverse(S, W)
    for i in range(K.shape[0]):
        for a in range(3):
            K[i, a] = HP[0, i] * W[0, a] + HP[1, i] * W[1, a] + HP[2, i] * W[2, a]


@njit(cache=True, nogil=True)
def condition(P, HP, S, K, r, dx):  # type: ignore[no-untyped-def]
    """Update P (n, n) in place by an innovation r (3,) of covariance S (3, 3), noise included; its mean into dx (n,).

    (I - K H) P (I - K H)^T + K R K^T multiplied out: it stays symmetric, and holds for any gain K (n, 3).
    """
    n = P.shape[0]
    KS = empty((n, 3))
    for i in range(n):
        dx[i] = K[i, 0] * r[0] + K[i, 1] * r[1] + K[i, 2] * r[2]
        for a in range(3):
            KS[i, a] = K[i, 0] * S[0, a] + K[i, 1] * S[1, a] + K[i, 2] * S[2, a]
    for i in range(n):
        for j in range(i, n):
            total = P[i, j]
            for a in range(3):
                total += KS[i, a] * K[j, a] - K[i, a] * HP[a, j] - HP[a, i] * K[j, a]
            P[i, j] = total
            P[j, i] = total
