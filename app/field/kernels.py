"""Isotropic kernels of unit variance: covariance, its slope, and the spectral density in two or three dimensions.

A Hilbert-space Gaussian process needs only the spectral density: the Fourier transform of the covariance
`S(w) = integral k(|r|) exp(-i w.r) dr` over d dimensions, so that `k(0) = (2 pi)^-d integral S(w) dw = 1`.
Rasmussen & Williams 2006, eq. 4.11 (squared exponential) and 4.15 (Matern).

A field that is minus the gradient of a potential has the smoothness of its name when the potential is once smoother
(Matern nu + 1); the potential's variance is such that every component of the field has unit variance.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.special import betainc, gamma, gammaincc

from app.field.spec import BaseKernel, Kernel
from app.geometry import Array

__all__ = [
    "MATERN_SMOOTHNESS",
    "Term",
    "base_kernel",
    "covariance",
    "covariance_slope",
    "is_sum",
    "log_spectral_slope",
    "spectral_density",
    "variance_beyond",
]

MATERN_SMOOTHNESS: dict[BaseKernel, float] = {"matern32": 1.5, "matern52": 2.5}


class Term(NamedTuple):
    """One kernel of a sum: its share of the variance."""

    kernel: BaseKernel
    length_m: float
    share: float


def is_sum(kernel: Kernel) -> bool:
    return "+" in kernel


def base_kernel(kernel: Kernel) -> BaseKernel:
    """The kernel both terms of a sum have, or the kernel itself."""
    base: BaseKernel = kernel.split("+")[0]  # type: ignore[assignment]  # the literals of Kernel are made of these
    return base


def covariance(kernel: BaseKernel, distance_m: Array, length_m: float) -> Array:
    """k(r) of a unit-variance field, any shape of distances."""
    if kernel == "squared_exponential":
        return np.asarray(np.exp(-0.5 * np.square(distance_m / length_m)))
    z = np.sqrt(2.0 * MATERN_SMOOTHNESS[kernel]) * distance_m / length_m
    polynomial = 1.0 + z if kernel == "matern32" else 1.0 + z + np.square(z) / 3.0
    return np.asarray(polynomial * np.exp(-z))


def covariance_slope(kernel: BaseKernel, distance_m: Array, length_m: float) -> Array:
    """k'(r) / r in 1/m^2: multiplied by a displacement it is the gradient of the covariance; finite at r = 0."""
    if kernel == "squared_exponential":
        return -covariance(kernel, distance_m, length_m) / length_m**2
    rate = np.sqrt(2.0 * MATERN_SMOOTHNESS[kernel]) / length_m
    z = rate * distance_m
    if kernel == "matern32":
        return np.asarray(-(rate**2) * np.exp(-z))
    return np.asarray(-(rate**2) / 3.0 * (1.0 + z) * np.exp(-z))


def spectral_density(
    kernel: BaseKernel, frequency_squared: Array, length_m: float, dimensions: int = 2, potential: bool = False
) -> Array:
    """S(w), m^d, at squared angular frequencies (rad/m)^2: of a unit-variance field, or of its potential (m^(d+2))."""
    d = dimensions
    if kernel == "squared_exponential":
        variance = length_m**2 if potential else 1.0
        return np.asarray(
            variance * (2.0 * np.pi * length_m**2) ** (d / 2) * np.exp(-0.5 * frequency_squared * length_m**2)
        )
    nu, variance = MATERN_SMOOTHNESS[kernel], 1.0
    if potential:
        nu, variance = nu + 1.0, length_m**2 * nu / (nu + 1.0)
    at_zero = (4.0 * np.pi) ** (d / 2) * gamma(nu + d / 2) / gamma(nu) * (length_m**2 / (2.0 * nu)) ** (d / 2)
    decay = np.power(1.0 + frequency_squared * length_m**2 / (2.0 * nu), -(nu + d / 2))
    return np.asarray(variance * at_zero * decay)


def log_spectral_slope(
    kernel: BaseKernel, frequency_squared: Array, length_m: float, dimensions: int = 2, potential: bool = False
) -> Array:
    """d log S / d log length at squared angular frequencies (rad/m)^2."""
    d = dimensions + (2.0 if potential else 0.0)
    if kernel == "squared_exponential":
        return d - frequency_squared * length_m**2
    nu = MATERN_SMOOTHNESS[kernel] + potential
    z = frequency_squared * length_m**2 / (2.0 * nu)
    return d - 2.0 * (nu + dimensions / 2) * z / (1.0 + z)


@lru_cache(maxsize=64)
def variance_beyond(
    kernel: BaseKernel, cutoff_rad_per_m: float, length_m: float, dimensions: int = 2, potential: bool = False
) -> float:
    """Share of a field's unit variance at frequencies above the cutoff."""
    half = dimensions / 2 + potential
    z = 0.5 * (cutoff_rad_per_m * length_m) ** 2
    if kernel == "squared_exponential":
        return float(gammaincc(half, z))
    nu = MATERN_SMOOTHNESS[kernel]
    z /= nu + potential
    return float(betainc(nu, half, 1.0 / (1.0 + z)))
