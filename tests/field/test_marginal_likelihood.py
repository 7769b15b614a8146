"""Against the dense covariance that the statistics stand for."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from app.field.basis import CosineBasis
from app.field.hyperparameters import Hyperparameters
from app.field.kernels import spectral_density
from app.field.marginal_likelihood import TileStatistics, learn, negative_log_likelihood
from app.field.slab import SlabBasis
from app.field.statistics import survey_statistics
from app.field.walk_noise import WHITE, WalkNoise

BASIS = CosineBasis((0.0, 0.0), 8.0, 9)
NOISE = WalkNoise(2.0, 1.5)


def walks(noise, components=2, seed=0):
    rng = np.random.default_rng(seed)
    result = []
    for _ in range(3):
        n = 30
        points = np.cumsum(rng.normal(0.0, 0.4, (n, 2)), axis=0) + rng.uniform(2.0, 6.0, 2)
        points = np.clip(points, 0.0, 8.0)
        path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        y = 3.0 * np.sin(points @ rng.normal(size=(2, components))) + rng.normal(0.0, 0.5, (n, components)) + 1.0
        result.append((points, y, path))
    return result


def tile(data, noise):
    return TileStatistics.of(BASIS, [survey_statistics(BASIS, *walk, noise) for walk in data])


def dense_covariance(data, noise, length, white, bias, kernel):
    points = np.concatenate([p for p, _, _ in data])
    phi = BASIS.at(points)
    covariance = (phi * spectral_density(kernel, BASIS.frequencies_squared, length)) @ phi.T
    start = 0
    for p, _, path in data:
        block = slice(start, start + len(p))
        shape = np.eye(len(p)) + noise.variance_ratio * np.exp(-np.abs(path[:, None] - path) / noise.length_m)
        covariance[block, block] += white * shape + bias
        start += len(p)
    return covariance


@pytest.mark.parametrize("noise", [WHITE, NOISE])
@pytest.mark.parametrize("kernel", ["squared_exponential", "matern32", "matern52"])
def test_value_equals_the_density_of_the_dense_gaussian(kernel, noise):
    data = walks(noise)
    parameters = np.log([1.8, 0.05, 0.02])
    likelihood = negative_log_likelihood([tile(data, noise)], kernel, parameters)
    covariance = dense_covariance(data, noise, 1.8, 0.05, 0.02, kernel)
    y = np.concatenate([walk[1] for walk in data])
    naive = -sum(
        multivariate_normal(cov=variance * covariance).logpdf(column)
        for variance, column in zip(likelihood.signal_variance_uT2, y.T, strict=True)
    )
    assert likelihood.value == pytest.approx(naive, rel=1e-5)
    assert np.allclose(likelihood.signal_variance_uT2, [c @ np.linalg.solve(covariance, c) / len(c) for c in y.T])


@pytest.mark.parametrize("noise", [WHITE, NOISE])
@pytest.mark.parametrize("parameters", [(1.8, 0.05, 0.02), (0.9, 1.0, 1e-4), (5.0, 1e-3, 1.0)])
def test_gradient_equals_finite_differences(parameters, noise):
    tiles, at, h = [tile(walks(noise, seed=s), noise) for s in (0, 1)], np.log(parameters), 1e-5
    gradient = negative_log_likelihood(tiles, "matern32", at).gradient
    numeric = [
        (
            negative_log_likelihood(tiles, "matern32", at + h * e).value
            - negative_log_likelihood(tiles, "matern32", at - h * e).value
        )
        / (2 * h)
        for e in np.eye(3)
    ]
    assert np.allclose(gradient, numeric, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("base", ["squared_exponential", "matern32", "matern52"])
def test_gradient_of_a_sum_equals_finite_differences_on_a_box_of_a_potential(base):
    basis = SlabBasis((0.0, 0.0, -1.0), 8.0, 3.0, 2.4, potential=True)
    data = [(np.column_stack([p, np.full(len(p), 0.2)]), y, path) for p, y, path in walks(NOISE, components=3)]
    tiles = [TileStatistics.of(basis, [survey_statistics(basis, *walk, NOISE) for walk in data])]
    at, h = np.array([*np.log([1.8, 0.05, 0.02]), np.log(0.4), -1.0]), 1e-5
    sums = f"{base}+{base}"
    numeric = [
        (negative_log_likelihood(tiles, sums, at + e).value - negative_log_likelihood(tiles, sums, at - e).value) / 2e-5
        for e in h * np.eye(5)
    ]
    assert np.allclose(negative_log_likelihood(tiles, sums, at).gradient, numeric, rtol=1e-5, atol=1e-4)


def test_learning_never_ends_below_where_it_started():
    tiles = [tile(walks(WHITE, seed=3), WHITE)]
    start = np.log([3.0, 1e-2, 1e-3])
    found = learn(tiles, "matern32", WHITE, start)
    observations = 2 * tiles[0].count
    assert found.nats < negative_log_likelihood(tiles, "matern32", start).value / observations
    at_the_end = negative_log_likelihood(tiles, "matern32", found.log_parameters).value
    assert found.nats == pytest.approx(at_the_end / observations)


def test_a_constant_field_is_learned_without_dividing_by_zero():
    points, _, path = walks(WHITE)[0]
    flat = TileStatistics.of(BASIS, [survey_statistics(BASIS, points, np.zeros((len(points), 1)), path, WHITE)])
    found = learn([flat], "matern32", WHITE)
    assert np.isfinite(found.nats)
    assert found.hyper.signal_sd_uT[0] < 0.1


def test_a_potential_is_learned_given_the_air_it_was_measured_in():
    """The dense density of what was measured and of the divergences, over that of the divergences alone."""
    basis = SlabBasis((0.0, 0.0, -1.0), 8.0, 3.0, 1.8, potential=True, air_m=(0.0, 0.4))
    p, y, path = walks(WHITE, components=3)[0]
    points = np.column_stack([p, np.full(len(p), 0.2)])
    survey = survey_statistics(basis, points, y, path, WHITE)
    likelihood = negative_log_likelihood(
        [TileStatistics.of(basis, [survey])], "squared_exponential", np.log([1.8, 0.05, 1e-8])
    )
    hyper = Hyperparameters("squared_exponential", 1.8, np.ones(1), 0.05)
    air = points.copy()
    air[:, 2] = np.resize(np.linspace(0.0, 0.4, 4), len(air))
    rows = np.concatenate([*basis.rows(points), basis.divergence_rows(air)]) * hyper.prior_sd(basis)
    n = 3 * len(points)
    error = np.repeat([0.05, hyper.source_variance_ratio(basis)], [n, len(air)])
    covariance = likelihood.signal_variance_uT2[0] * (rows @ rows.T + np.diag(error))
    both = multivariate_normal(cov=covariance).logpdf(np.concatenate([y.T.ravel(), np.zeros(len(air))]))
    alone = multivariate_normal(cov=covariance[n:, n:]).logpdf(np.zeros(len(air)))
    assert likelihood.value == pytest.approx(alone - both, rel=1e-4)


def test_lengths_at_which_functions_vanish_have_a_finite_slope():
    basis = SlabBasis((0.0, 0.0, 0.0), 8.0, 3.0, 4.0, potential=True)
    p, _, path = walks(WHITE)[0]
    points = np.column_stack([p, np.full(len(p), 1.2)])
    tiles = [TileStatistics.of(basis, [survey_statistics(basis, points, np.zeros((len(p), 3)), path, WHITE)])]
    assert np.all(
        np.isfinite(negative_log_likelihood(tiles, "squared_exponential", np.log([20.0, 0.05, 1e-8])).gradient)
    )
