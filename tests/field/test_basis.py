import numpy as np
import pytest

from app.field.basis import CosineBasis


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
