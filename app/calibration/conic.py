"""Ellipses and ellipsoids through readings by linear algebra: the starts of the fits, and the source's own fit.

`(x - b)^T Q (x - b) = R^2` with Q = A^T A, in two or three dimensions.
"""

from typing import NamedTuple

import numpy as np

from app.calibration.coverage import refusal
from app.geometry import Array

__all__ = ["Conic", "fit_conic", "fit_without_constant", "symmetric_root"]

LARGEST_RATIO = 100.0
"""Of the eigenvalues of Q: axes that differ by a factor of ten are no sensor's."""


class Conic(NamedTuple):
    """Q (d, d) and b (d,) uT."""

    Q: Array
    hard_iron_uT: Array


def fit_conic(B_uT: Array, reference_uT: float) -> Conic:
    """The homogeneous conic through readings (n, d), centred and scaled: no constant is dropped (Shockley, 3.6, 3).

    The sign and the scale of the singular vector cancel in kappa, so it works wherever the origin lies.
    """
    centre = B_uT.mean(axis=0)
    scale = float(np.sqrt(np.mean(np.sum((B_uT - centre) ** 2, axis=1))))
    x = (B_uT - centre) / scale
    v = np.linalg.svd(np.column_stack([_monomials(x), np.ones(len(x))]), full_matrices=False)[2][-1]
    Q, linear = _unpack(v[:-1], x.shape[1])
    if np.linalg.cond(Q) > 1e10:
        raise refusal("No ellipse fits the readings", [])
    b = np.linalg.solve(Q, linear)
    kappa = float(b @ linear - v[-1])
    if kappa == 0.0:
        raise refusal("No ellipse fits the readings", [])
    return Conic(Q * (reference_uT / scale) ** 2 / kappa, b * scale + centre)


def fit_without_constant(B_uT: Array, reference_uT: float) -> Conic:
    """The source's least squares with k = 0 (Shockley, Eqs. 2.19-2.21, 2.25-2.27): Q comes out Q_true / (1 - rho).

    rho = b^T Q_true b / R^2; where rho is 1 the fit is singular, where it is larger Q is negative definite.
    """
    x = B_uT / reference_uT
    p = np.asarray(np.linalg.lstsq(_monomials(x), np.ones(len(x)), rcond=None)[0], dtype=np.float64)
    Q, linear = _unpack(p, x.shape[1])
    return Conic(Q, np.asarray(np.linalg.solve(Q, linear)) * reference_uT)


def symmetric_root(Q: Array, advice: tuple[str, ...] = ()) -> Array:
    """A symmetric with A A = Q, by eigenvalues: a singular value decomposition would hide a negative one (E6)."""
    values, vectors = np.linalg.eigh(Q)
    if values[0] <= 0.0 or values[-1] > LARGEST_RATIO * values[0]:
        raise refusal(
            f"The readings lie on no ellipse: its eigenvalues are {np.array2string(values, precision=3)}", advice
        )
    return np.asarray(vectors * np.sqrt(values) @ vectors.T)


def _monomials(x: Array) -> Array:
    """[x^2 y^2 (z^2) 2xy (2xz 2yz) -2x -2y (-2z)] (Shockley, Eqs. 2.19, 2.25)."""
    first, second = np.triu_indices(x.shape[1], 1)
    return np.column_stack([x**2, 2.0 * x[:, first] * x[:, second], -2.0 * x])


def _unpack(p: Array, d: int) -> tuple[Array, Array]:
    Q = np.diag(p[:d])
    first, second = np.triu_indices(d, 1)
    Q[first, second] = Q[second, first] = p[d : d + len(first)]
    return Q, p[d + len(first) :]
