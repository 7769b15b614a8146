import numpy as np
import pytest

from app.field.basis import CosineBasis, VarianceSeries


@pytest.fixture
def basis():
    return CosineBasis((-1.5, 2.0), 6.0, 7)


def test_functions_are_orthonormal(basis):
    centres = (np.arange(200) + 0.5) / 200 * basis.side_m
    x, y = np.meshgrid(basis.corner_m[0] + centres, basis.corner_m[1] + centres)
    values = basis.at(np.column_stack([x.ravel(), y.ravel()]))
    gram = values.T @ values * (basis.side_m / 200) ** 2
    assert np.allclose(gram, np.eye(basis.size), atol=1e-9)


def test_functions_are_eigenfunctions_of_the_laplacian(basis):
    point, h = np.array([[0.7, 4.1]]), 1e-3
    around = [point + h * np.array(d) for d in ((1, 0), (-1, 0), (0, 1), (0, -1))]
    laplacian = (sum(basis.at(p) for p in around) - 4 * basis.at(point)) / h**2
    assert np.allclose(-laplacian, basis.frequencies_squared * basis.at(point), atol=1e-3)


@pytest.mark.parametrize("axis", [0, 1])
def test_slopes_are_derivatives(basis, axis):
    at, h = np.linspace(2.1, 4.4, 5), 1e-6
    numeric = (basis.along(axis, at + h) - basis.along(axis, at - h)) / (2 * h)
    assert np.allclose(basis.slope_along(axis, at), numeric, atol=1e-6)


def test_variance_series_equals_the_quadratic_form(basis):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(basis.size, basis.size))
    covariance = root @ root.T
    points = rng.uniform([-1.5, 2.0], [4.5, 8.0], (30, 2))
    phi = basis.at(points)
    naive = np.einsum("nm,mk,nk->n", phi, covariance, phi)
    series = VarianceSeries.of(basis, covariance)
    assert np.allclose(series.at(points), naive, rtol=1e-10)
    x, y = points[:4, 0], points[4:9, 1]
    lattice = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    assert np.allclose(series.on_lattice(x, y).ravel(), series.at(lattice), rtol=1e-10)
