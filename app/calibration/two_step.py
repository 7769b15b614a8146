"""Nine parameters of scale, bias and non-orthogonality, in two steps (Kuevor, B6; Eqs. 2.4-2.7, 3.12-3.15).

The sensor's x axis is true, y leans by rho, z by lambda and phi: measured = M true + b, with M lower-triangular. Two
misprints are mended: the right-hand side of Eq. 2.5 holds the true B_y (item 4.2), and theta_c multiplies all three
terms of Eq. 2.6 (item 4.3). Angles are radians here; the source's Table 3.1 is in degrees (item 4.36).
"""

from typing import cast

import numpy as np
from scipy.optimize import least_squares

from app.calibration.coverage import refusal, refuse_flat, sphere_coverage
from app.calibration.fit import CalibrationFit, conclude_sphere
from app.calibration.norm_fit import Linearised, fit_norms
from app.calibration.readings import check_readings, near_the_others
from app.calibration.sensor_model import SensorModel
from app.geometry import Array

__all__ = ["TWO_STEP_PARAMETERS", "distortion", "two_step"]

TWO_STEP_PARAMETERS = (
    "scale_x", "scale_y", "scale_z", "hard_iron_x_ut", "hard_iron_y_ut", "hard_iron_z_ut", "rho_rad", "lambda_rad",
    "phi_rad",
)  # fmt: skip
LEAST_SAMPLES = 60
_BIAS = slice(3, 6)


def two_step(B_uT: Array, field_uT: float, *, refined: bool = True) -> CalibrationFit:
    """From readings (n, 3), uT, in one field of strength `field_uT`, from a model of the Earth's field.

    Step 1 finds the biases alone, step 2 all nine, by Levenberg-Marquardt on squared strengths (Kuevor, Eq. 2.7). The
    source starts step 1 at zero, which fails where the hard iron is far stronger than the field; here it starts at the
    centre of a sphere, found by linear algebra. `refined`: a last step without the bias of noise, which spikes do not
    spoil; without it, the numbers are the source's. Raises InvalidInput with advice.
    """
    B = check_readings(B_uT, field_uT, LEAST_SAMPLES)
    near = B[near_the_others(B)]
    refuse_flat(near)
    theta = _two_steps(near, field_uT)
    fitted = fit_norms(B, field_uT, theta, _linearise)
    if not refined:
        fitted = fitted._replace(theta=theta, residual_uT=_norms_uT(B, theta) - field_uT)
    M, b = distortion(fitted.theta), fitted.theta[_BIAS]
    coverage = sphere_coverage(fitted.directions[~fitted.outlier], fitted.condition)
    if np.linalg.cond(M) > 10.0 or np.any(fitted.theta[:3] <= 0.0):
        raise refusal("The readings lie on no ellipsoid a sensor could have", coverage.advice)
    model = SensorModel(b, np.asarray(np.linalg.inv(M)))
    return conclude_sphere("two_step", TWO_STEP_PARAMETERS, fitted, model, coverage, field_uT)


def distortion(theta: Array) -> Array:
    """M (3, 3) of the nine parameters: measured = M true + b (Kuevor, B6)."""
    a, b, c = theta[:3]
    rho, lam, phi = theta[6:]
    return np.array([
        [a, 0.0, 0.0],
        [b * np.sin(rho), b * np.cos(rho), 0.0],
        [c * np.sin(lam), c * np.sin(phi) * np.cos(lam), c * np.cos(phi) * np.cos(lam)],
    ])  # fmt: skip


def _d_distortion(theta: Array) -> Array:
    """(9, 3, 3) derivatives of M by the parameters."""
    b, c = theta[1:3]
    rho, lam, phi = theta[6:]
    M = distortion(theta)
    d = np.zeros((9, 3, 3))
    for k in range(3):
        d[k, k] = M[k] / theta[k]
    d[6, 1] = [b * np.cos(rho), -b * np.sin(rho), 0.0]
    d[7, 2] = [c * np.cos(lam), -c * np.sin(phi) * np.sin(lam), -c * np.cos(phi) * np.sin(lam)]
    d[8, 2] = [0.0, c * np.cos(phi) * np.cos(lam), -c * np.sin(phi) * np.cos(lam)]
    return d


def _linearise(theta: Array) -> Linearised:
    A = np.asarray(np.linalg.inv(distortion(theta)), dtype=np.float64)
    d_bias = np.zeros((9, 3))
    d_bias[_BIAS] = np.eye(3)
    return Linearised(A, theta[_BIAS], -A @ _d_distortion(theta) @ A, d_bias)


def _two_steps(B: Array, field_uT: float) -> Array:
    theta = np.array([1.0, 1.0, 1.0, *_centre(B), 0.0, 0.0, 0.0])

    def biased(b: Array) -> Array:
        return np.concatenate([theta[:3], b, theta[6:]])

    def shortfall(every: Array) -> Array:
        return _shortfall(B, every, field_uT)

    def jacobian(every: Array) -> Array:
        return _jacobian(B, every)

    def shortfall_of_bias(b: Array) -> Array:
        return shortfall(biased(b))

    def jacobian_of_bias(b: Array) -> Array:
        return jacobian(biased(b))[:, _BIAS]

    only_bias = least_squares(shortfall_of_bias, theta[_BIAS], jacobian_of_bias, method="lm")
    x_scale = np.array([1.0, 1.0, 1.0, field_uT, field_uT, field_uT, 1.0, 1.0, 1.0])
    all_nine = least_squares(shortfall, biased(only_bias.x), jacobian, method="lm", x_scale=x_scale)
    return cast(Array, all_nine.x)


def _centre(B: Array) -> Array:
    """Of the sphere through the readings, its radius unknown: |B|^2 = 2 b B + k."""
    middle = B.mean(axis=0)
    x = B - middle
    design = np.column_stack([2.0 * x, np.ones(len(x))])
    return np.asarray(np.linalg.lstsq(design, np.sum(x**2, axis=1), rcond=None)[0][:3] + middle)


def _norms_uT(B: Array, theta: Array) -> Array:
    return np.asarray(np.linalg.norm(np.linalg.solve(distortion(theta), (B - theta[_BIAS]).T), axis=0))


def _shortfall(B: Array, theta: Array, field_uT: float) -> Array:
    """Delta B = B_R^2 - |g(B)|^2 of every reading (Kuevor, Eq. 2.7)."""
    return np.asarray(field_uT**2 - _norms_uT(B, theta) ** 2)


def _jacobian(B: Array, theta: Array) -> Array:
    """(n, 9) of `_shortfall`."""
    A, b, dA, db = _linearise(theta)
    x = B - b
    v = x @ A.T
    return np.asarray(-2.0 * (np.einsum("ni,pij,nj->np", v, dA, x, optimize=True) - (v @ A) @ db.T))
