"""The field is of one strength all around: the parameters whose corrected readings all have it, without bias.

The fit by linear algebra is biased by noise, and so is a plain least squares of norms: noise lengthens a vector, and a
derivative taken at a noisy reading goes with its error. Here every derivative is taken at the reading's foot on the
ellipsoid, and the lengthening is taken off; what is left has no mean to second order in noise over field. The
distances are those of the sensor's own axes, in which its noise is the same in all directions.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.calibration.coverage import refusal
from app.geometry import Array

__all__ = ["Linearised", "NormFit", "fit_norms", "symmetric_parameters", "symmetric_start"]

TUKEY = 6.0
"""Readings this many robust sds off weigh nothing: clean ones lose 2 % of their worth."""
OUTLIER = 4.5
ROBUST_SD = 1.4826
MOST_ROUNDS = 60
LEAST_NOISE = 1e-9
"""Of the field: exact readings end the iteration too."""


class Linearised(NamedTuple):
    """A correction (d, d) and a hard iron (d,), with their derivatives by the parameters (p, d, d), (p, d)."""

    correction: Array
    hard_iron_uT: Array
    d_correction: Array
    d_hard_iron_uT: Array


Parametrisation = Callable[[Array], Linearised]


class NormFit(NamedTuple):
    """theta (p,), covariance (p, p); residual_uT (n,) and directions (n, d) of the corrected readings.

    condition: of the derivatives, the field's strength setting the scale of those that have no unit.
    """

    theta: Array
    covariance: Array
    residual_uT: Array
    directions: Array
    outlier: NDArray[np.bool_]
    noise_uT: float
    condition: float


class _Norms(NamedTuple):
    """At one theta: distances (n,) from the ellipsoid in the sensor's axes, their Jacobian, directions, |B| - R."""

    distance_uT: Array
    jacobian: Array
    directions: Array
    residual_uT: Array


def fit_norms(B_uT: Array, reference_uT: float, start: Array, parametrisation: Parametrisation) -> NormFit:
    """From a start near the answer to the answer, for readings (n, d), by iterated reweighted least squares."""
    theta, noise = start, 0.0
    for _ in range(MOST_ROUNDS):
        norms = _norms(B_uT, reference_uT, parametrisation(theta), noise)
        noise = max(ROBUST_SD * float(np.median(np.abs(norms.distance_uT))), LEAST_NOISE * reference_uT)
        weight = _tukey(norms.distance_uT, noise)
        normal = norms.jacobian.T @ (weight[:, None] * norms.jacobian)
        scale = np.sqrt(np.maximum(np.diag(normal), 1e-300))
        step = -_solve(normal / np.outer(scale, scale), norms.jacobian.T @ (weight * norms.distance_uT) / scale) / scale
        theta = theta + step
        if not np.isfinite(theta).all():
            break
        if np.all(np.abs(step) * scale < 1e-4 * noise):
            return _finished(B_uT, reference_uT, theta, parametrisation, noise)
    raise refusal("The fit found no end: the readings lie on no ellipse around one hard iron", [])


def symmetric_parameters(d: int) -> Parametrisation:
    """theta = hard iron (d), then the diagonal of a symmetric correction, then its upper triangle."""
    first, second = np.triu_indices(d, 1)
    p = d + d + len(first)
    d_correction, d_hard_iron = np.zeros((p, d, d)), np.zeros((p, d))
    d_hard_iron[:d] = np.eye(d)
    for k in range(d):
        d_correction[d + k, k, k] = 1.0
    for k, (i, j) in enumerate(zip(first, second, strict=True)):
        d_correction[2 * d + k, i, j] = d_correction[2 * d + k, j, i] = 1.0

    def linearise(theta: Array) -> Linearised:
        correction = np.tensordot(theta, d_correction, axes=1)
        return Linearised(correction, theta[:d], d_correction, d_hard_iron)

    return linearise


def symmetric_start(correction: Array, hard_iron_uT: Array) -> Array:
    """The theta of `symmetric_parameters`."""
    return np.concatenate([hard_iron_uT, np.diag(correction), correction[np.triu_indices(len(correction), 1)]])


def _norms(B_uT: Array, reference_uT: float, model: Linearised, noise_uT: float) -> _Norms:
    A = model.correction
    v = (B_uT - model.hard_iron_uT) @ A.T
    norm = np.linalg.norm(v, axis=1)
    normal = v / norm[:, None] @ A  # A^T n: how the norm grows along the sensor's axes
    gain = np.linalg.norm(normal, axis=1)
    foot = v - ((norm - reference_uT) / gain**2)[:, None] * (normal @ A.T)
    n = foot / np.linalg.norm(foot, axis=1, keepdims=True)
    lengthened = noise_uT**2 * (np.sum(A**2) - gain**2) / (2.0 * reference_uT)
    at_foot = reference_uT * n @ np.linalg.inv(A).T
    by_correction = np.einsum("ni,pij,nj->np", n, model.d_correction, at_foot, optimize=True)
    jacobian = (by_correction - (n @ A) @ model.d_hard_iron_uT.T) / gain[:, None]
    return _Norms((norm - reference_uT - lengthened) / gain, jacobian, n, norm - reference_uT)


def _finished(
    B_uT: Array, reference_uT: float, theta: Array, parametrisation: Parametrisation, noise_uT: float
) -> NormFit:
    model = parametrisation(theta)
    norms = _norms(B_uT, reference_uT, model, noise_uT)
    n, p = norms.jacobian.shape
    r = norms.distance_uT
    u = np.clip(r / (TUKEY * noise_uT), -1.0, 1.0)
    psi, slope = r * (1.0 - u**2) ** 2, (1.0 - u**2) * (1.0 - 5.0 * u**2)
    variance = np.sum(psi**2) / (n - p) / np.mean(slope) ** 2 * _serial(psi)
    has_unit = np.any(model.d_hard_iron_uT != 0.0, axis=1)
    scaled = norms.jacobian / np.where(has_unit, 1.0, reference_uT)
    values = np.asarray(np.linalg.svd(scaled, compute_uv=False))
    condition = float(values[0] / max(values[-1], 1e-300))
    return NormFit(
        theta, variance * np.linalg.pinv(norms.jacobian.T @ norms.jacobian, hermitian=True, rcond=1e-18),
        norms.residual_uT, norms.directions, np.abs(r) > OUTLIER * noise_uT, noise_uT, condition,
    )  # fmt: skip


def _serial(psi: Array) -> float:
    """How much less than independent ones readings in a row are worth: (1 + r) / (1 - r), r of neighbours' errors."""
    r = float(psi[1:] @ psi[:-1] / max(float(psi @ psi), 1e-300))
    return (1.0 + r) / (1.0 - min(r, 0.999)) if r > 3.0 / np.sqrt(len(psi)) else 1.0


def _tukey(r: Array, sd: float) -> Array:
    return np.asarray((1.0 - np.minimum((r / (TUKEY * sd)) ** 2, 1.0)) ** 2)


def _solve(normal: Array, right: Array) -> Array:
    """Directions that nothing determines stay where they are."""
    values, vectors = np.linalg.eigh(normal)
    kept = values > 1e-13 * values[-1]
    return np.asarray(vectors[:, kept] @ (vectors[:, kept].T @ right / values[kept]))
