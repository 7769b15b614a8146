import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import j0

from app.field.kernels import covariance, covariance_slope, log_spectral_slope, spectral_density, variance_beyond

KERNELS = ("squared_exponential", "matern32", "matern52")


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("frequency", [0.0, 0.4, 1.5, 3.0])
def test_spectral_density_is_the_fourier_transform_of_the_covariance(kernel, frequency):
    length = 1.7

    def integrand(r):
        return 2 * np.pi * r * covariance(kernel, r, length) * j0(frequency * r)

    transform, _ = quad(integrand, 0.0, 60.0, limit=400)
    density = spectral_density(kernel, np.array([frequency**2]), length)[0]
    assert density == pytest.approx(transform, rel=1e-6, abs=1e-7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_log_spectral_slope_is_the_derivative_with_the_log_of_the_length(kernel):
    w2, step = np.linspace(0.0, 9.0, 7), 1e-6
    above = np.log(spectral_density(kernel, w2, 2.0 * np.exp(step)))
    below = np.log(spectral_density(kernel, w2, 2.0 * np.exp(-step)))
    assert np.allclose(log_spectral_slope(kernel, w2, 2.0), (above - below) / (2 * step), atol=1e-7)


@pytest.mark.parametrize("kernel", KERNELS)
def test_covariance_slope_is_the_derivative_over_the_distance(kernel):
    r, step = np.array([0.3, 1.0, 2.5]), 1e-6
    slope = (covariance(kernel, r + step, 1.3) - covariance(kernel, r - step, 1.3)) / (2 * step)
    assert np.allclose(covariance_slope(kernel, r, 1.3) * r, slope, atol=1e-8)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("potential", [False, True])
def test_variance_beyond_a_cutoff_is_the_integral_of_the_density_there(kernel, dimensions, potential):
    length, cutoff = 1.4, 2.2

    def integrand(w):
        surface = 2 * np.pi * w if dimensions == 2 else 4 * np.pi * w**2
        density = spectral_density(kernel, np.array(w**2), length, dimensions, potential)
        one_component = w**2 / dimensions if potential else 1.0
        return surface * density * one_component / (2 * np.pi) ** dimensions

    below, _ = quad(integrand, 0.0, cutoff)
    beyond = variance_beyond(kernel, cutoff, length, dimensions, potential)
    assert beyond == pytest.approx(1.0 - below, abs=1e-9)
    above, _ = quad(integrand, cutoff, np.inf, limit=200)
    assert beyond == pytest.approx(above, abs=1e-6)
