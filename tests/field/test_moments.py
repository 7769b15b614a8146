"""The tables of cosine moments against the direct products they stand for."""

import numpy as np
import pytest

from app.field.basis import CosineBasis
from app.field.moments import VarianceSeries, cosines, gram_of_moments, moments_of, scaled_functions
from app.field.statistics import survey_statistics
from app.field.walk_noise import WHITE, WalkNoise


@pytest.fixture(params=[1, 2, 7])
def basis(request):
    return CosineBasis((-1.5, 2.0), 6.0, request.param)


def points_in(basis, count):
    return np.random.default_rng(0).uniform([-1.5, 2.0], [4.5, 8.0], (count, 2))


def test_cosines_are_those_of_every_degree(basis):
    x = np.append(points_in(basis, 30)[:, 0], [-1.5, 4.5])
    direct = np.cos(np.pi / 6.0 * np.multiply.outer(x + 1.5, np.arange(2 * basis.functions_per_axis - 1)))
    assert np.allclose(cosines(basis, 0, x), direct, atol=1e-12)


def test_the_gram_matrix_of_the_moments_is_the_direct_one(basis):
    points = points_in(basis, 50)
    moments = cosines(basis, 0, points[:, 0]).T @ cosines(basis, 1, points[:, 1])
    scale = np.random.default_rng(1).uniform(0.1, 2.0, basis.size)
    scaled = basis.at(points) * scale
    assert np.allclose(gram_of_moments(basis, moments, scale), np.tril(scaled.T @ scaled), atol=1e-12)


def test_moments_and_functions_are_the_direct_products(basis):
    points, features = points_in(basis, 50), np.random.default_rng(3).normal(size=(50, 2))
    moments, weighted = moments_of(basis, points, features)
    assert np.allclose(moments, cosines(basis, 0, points[:, 0]).T @ cosines(basis, 1, points[:, 1]), atol=1e-11)
    assert np.allclose(weighted, basis.at(points).T @ features, atol=1e-11)
    scale = np.random.default_rng(1).uniform(0.1, 2.0, basis.size)
    assert np.allclose(scaled_functions(basis, points, scale), (basis.at(points) * scale).T, atol=1e-12)


def test_variance_series_equals_the_quadratic_form(basis):
    rng = np.random.default_rng(0)
    root = rng.normal(size=(basis.size, basis.size))
    scale = rng.uniform(0.1, 2.0, basis.size)
    covariance = root @ root.T
    points = points_in(basis, 30)
    phi = basis.at(points) * scale
    naive = np.einsum("nm,mk,nk->n", phi, covariance, phi)
    series = VarianceSeries.of(basis, np.tril(covariance), scale)
    assert np.allclose(series.at(points), naive, rtol=1e-10)
    x, y = points[:4, 0], points[4:9, 1]
    lattice = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    assert np.allclose(
        series.on_lattice(cosines(basis, 0, x), cosines(basis, 1, y)).ravel(), series.at(lattice), rtol=1e-10
    )


def test_statistics_by_moments_equal_those_of_vanishing_walk_noise(basis):
    rng, points = np.random.default_rng(2), points_in(basis, 40)
    features, path = rng.normal(size=(40, 3)), np.arange(40.0)
    white = survey_statistics(basis, points, features, path, WHITE)
    direct = survey_statistics(basis, points, features, path, WalkNoise(1e-14, 1.0))
    ones = np.ones(basis.size)
    lower = [np.tril(s.gram.scaled(basis, ones)) for s in (white, direct)]
    assert np.allclose(*lower, atol=1e-10)
    for name in ("target", "offsets", "ones", "ones_target", "energy", "log_det_shape", "count"):
        assert np.allclose(getattr(white, name), getattr(direct, name), atol=1e-10), name
