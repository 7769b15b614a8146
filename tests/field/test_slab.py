"""Boxes of cosines against dense Gaussian processes in three dimensions, and against what a potential must obey."""

import numpy as np
import pytest

from app.field.exact import ExactProcess
from app.field.hilbert import posterior
from app.field.hyperparameters import Hyperparameters
from app.field.slab import SlabBasis
from app.field.statistics import marginalise, survey_statistics
from app.field.tiles import Lattice, Tile
from app.field.walk_noise import WHITE

POTENTIAL = SlabBasis((-1.0, 2.0, -0.5), 5.0, 3.0, 4.0, potential=True)


def points(rng, n, side=3.2, low=0.0, high=1.0):
    return np.column_stack([rng.uniform(-0.3 * side / 1.6, 1.3 * side / 1.6, (n, 2)), rng.uniform(low, high, n)])


def test_the_field_is_minus_the_gradient_of_the_functions():
    p, h = np.random.default_rng(0).uniform([0, 3, 0], [3, 6, 2], (20, 3)), 1e-5
    rows = POTENTIAL.rows(p)
    for axis, step in enumerate(h * np.eye(3)):
        numeric = -(POTENTIAL.at(p + step) - POTENTIAL.at(p - step)) / (2 * h)
        assert np.allclose(rows[axis], numeric, atol=1e-7)
    steps = enumerate(h * np.eye(3))
    divergence = sum((POTENTIAL.rows(p + s)[a] - POTENTIAL.rows(p - s)[a]) / (2 * h) for a, s in steps)
    assert np.allclose(POTENTIAL.divergence_rows(p), divergence, atol=1e-6)


@pytest.mark.parametrize("potential", [False, True])
def test_values_on_a_lattice_are_those_at_its_points(potential):
    rng = np.random.default_rng(0)
    basis = SlabBasis((-1.0, 2.0, -0.5), 5.0, 3.0, 4.0, potential)
    weights = rng.normal(size=(basis.size, 1 if potential else 2))
    x, y, z = np.array([0.1, 1.7]), np.array([2.5, 3.0, 6.9]), np.array([0.0, 1.1])
    _, field, gradient = basis.on_lattice(weights, x, y, z)
    zz, yy, xx = np.meshgrid(z, y, x, indexing="ij")
    p = np.column_stack([xx.ravel(), yy.ravel(), zz.ravel()])

    def at(q):
        rows = basis.rows(q) @ weights
        return rows[:, :, 0] if potential else rows[0].T

    assert np.allclose(field.reshape(len(field), -1), at(p), atol=1e-10)
    for axis, step in enumerate(1e-5 * np.eye(3)):
        numeric = (at(p + step) - at(p - step)) / 2e-5
        assert np.allclose(gradient[axis].reshape(len(field), -1), numeric, atol=1e-6)


@pytest.mark.parametrize("kernel", ["squared_exponential", "matern52"])
def test_independent_components_agree_with_the_exact_process_in_three_dimensions(kernel):
    rng = np.random.default_rng(1)
    p, q = points(rng, 500), np.column_stack([rng.uniform(0.3, 1.7, (60, 2)), rng.uniform(0.1, 0.9, 60)])
    y = 4.0 * np.sin(p @ [1.0, 0.7, 0.9]) + 0.2 * rng.normal(size=500)
    hyper = Hyperparameters(kernel, 1.2, np.array([3.0]), white_ratio=0.01)
    lattice = Lattice.of_slabs(kernel, 1.2, (0.0, 1.0), potential=False)
    mean, variance = fit(lattice, hyper, p, y[:, None]).at(q)
    exact_mean, exact_variance = ExactProcess(kernel, 1.2, 3.0, 0.3).condition(p, y).at(q)
    assert np.sqrt(np.mean(np.square(mean[:, 0] - exact_mean))) < 0.02 * np.std(y)
    ratio = np.sqrt(variance[:, 0] / exact_variance)  # detail that the functions cannot follow is added
    assert np.all((ratio > 0.9) & (ratio < 2.0))


def test_a_potential_agrees_with_the_exact_curl_free_process():
    """B = -grad phi, phi squared exponential: cov(B_i, B_j) = s^2 (delta_ij - r_i r_j / l^2) exp(-r^2 / 2 l^2)."""
    rng = np.random.default_rng(2)
    length, noise = 1.1, 0.2
    p, q = points(rng, 160), np.column_stack([rng.uniform(0.3, 1.7, (40, 2)), rng.uniform(0.1, 0.9, 40)])

    def covariance(a, b):
        r = a[:, None] - b[None]
        k = np.exp(-0.5 * np.sum(r**2, axis=-1) / length**2)
        blocks = (np.eye(3) - r[..., :, None] * r[..., None, :] / length**2) * k[..., None, None]
        return 9.0 * blocks.transpose(0, 2, 1, 3).reshape(3 * len(a), 3 * len(b))

    both = np.concatenate([p, q])
    truth = np.linalg.cholesky(covariance(both, both) + 1e-8 * np.eye(600)) @ rng.normal(size=600)
    y = truth[:480].reshape(-1, 3) + noise * rng.normal(size=(160, 3))
    gram = covariance(p, p) + noise**2 * np.eye(480)
    cross = covariance(q, p)
    exact_mean = (cross @ np.linalg.solve(gram, y.ravel())).reshape(-1, 3)
    exact_variance = (9.0 - np.einsum("ij,ji->i", cross, np.linalg.solve(gram, cross.T))).reshape(-1, 3)
    hyper = Hyperparameters("squared_exponential", length, np.array([3.0]), white_ratio=noise**2 / 9.0)
    lattice = Lattice.of_slabs("squared_exponential", length, (0.0, 1.0), potential=True)
    basis = lattice.basis(Tile(0, 0))
    survey = survey_statistics(basis, p, y, np.arange(160.0), WHITE)
    without_air = marginalise(basis, "", type(survey)(**{**fields(survey), "sources": None}), hyper)
    mean, variance = posterior(basis, without_air, hyper).at(q)
    assert np.sqrt(np.mean(np.square(mean - exact_mean))) < 0.02 * np.std(y)
    ratio = np.sqrt((variance - hyper.detail_ratio(basis)) * 9.0 / exact_variance)
    assert np.all((ratio > 0.9) & (ratio < 1.1))


def fields(survey):
    return {name: getattr(survey, name) for name in survey.__dataclass_fields__}


def fit(lattice, hyper, p, y):
    basis = lattice.basis(Tile(0, 0))
    survey = survey_statistics(basis, p, y, np.arange(float(len(p))), WHITE)
    return posterior(basis, marginalise(basis, "", survey, hyper), hyper)
