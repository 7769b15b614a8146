"""Isotropic kernels of unit variance: covariance, its slope, and the spectral density in the plane.

A Hilbert-space Gaussian process needs only the spectral density: the Fourier transform of the covariance
`S(w) = integral k(|r|) exp(-i w.r) dr`, here over two dimensions, so that `k(0) = (2 pi)^-2 integral S(w) dw = 1`.
Rasmussen & Williams 2006, eq. 4.11 (squared exponential) and 4.15 (Matern).
"""

import numpy as np

from app.field.spec import Kernel
from app.geometry import Array

__all__ = [
    "MATERN_SMOOTHNESS",
    "covariance",
    "covariance_slope",
    "log_spectral_slope",
    "spectral_density",
    "variance_beyond",
]

MATERN_SMOOTHNESS: dict[Kernel, float] = {"matern32": 1.5, "matern52": 2.5}


def covariance(kernel: Kernel, distance_m: Array, length_m: float) -> Array:
    """k(r) of a unit-variance field, any shape of distances."""
    if kernel == "squared_exponential":
        return np.asarray(np.exp(-0.5 * np.square(distance_m / length_m)))
    z = np.sqrt(2.0 * MATERN_SMOOTHNESS[kernel]) * distance_m / length_m
    polynomial = 1.0 + z if kernel == "matern32" else 1.0 + z + np.square(z) / 3.0
    return np.asarray(polynomial * np.exp(-z))


def covariance_slope(kernel: Kernel, distance_m: Array, length_m: float) -> Array:
    """k'(r) / r in 1/m^2: multiplied by a displacement it is the gradient of the covariance; finite at r = 0."""
    if kernel == "squared_exponential":
        return -covariance(kernel, distance_m, length_m) / length_m**2
    rate = np.sqrt(2.0 * MATERN_SMOOTHNESS[kernel]) / length_m
    z = rate * distance_m
    if kernel == "matern32":
        return np.asarray(-(rate**2) * np.exp(-z))
    return np.asarray(-(rate**2) / 3.0 * (1.0 + z) * np.exp(-z))


def spectral_density(kernel: Kernel, frequency_squared: Array, length_m: float) -> Array:
    """S(w) of a unit-variance field in the plane, m^2, at squared angular frequencies (rad/m)^2."""
    if kernel == "squared_exponential":
        return np.asarray(2.0 * np.pi * length_m**2 * np.exp(-0.5 * frequency_squared * length_m**2))
    nu = MATERN_SMOOTHNESS[kernel]
    decay = np.power(1.0 + frequency_squared * length_m**2 / (2.0 * nu), -(nu + 1.0))
    return np.asarray(2.0 * np.pi * length_m**2 * decay)


def log_spectral_slope(kernel: Kernel, frequency_squared: Array, length_m: float) -> Array:
    """d log S / d log length at squared angular frequencies (rad/m)^2."""
    if kernel == "squared_exponential":
        return 2.0 - frequency_squared * length_m**2
    nu = MATERN_SMOOTHNESS[kernel]
    z = frequency_squared * length_m**2 / (2.0 * nu)
    return 2.0 - 2.0 * (nu + 1.0) * z / (1.0 + z)


def variance_beyond(kernel: Kernel, cutoff_rad_per_m: float, length_m: float) -> float:
    """Share of a unit variance at frequencies above the cutoff."""
    z = 0.5 * (cutoff_rad_per_m * length_m) ** 2
    if kernel == "squared_exponential":
        return float(np.exp(-z))
    nu = MATERN_SMOOTHNESS[kernel]
    return float((1.0 + z / nu) ** -nu)
