"""Looking the field up at particles, and what a reading says of them."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from app.field.grid import FieldGrid
from app.geometry import yaw_matrix
from app.tracking.field_likelihood import literal, log_likelihood, neutral, norm_of, turned
from app.tracking.field_lookup import Looked, field_table, look_up, look_up_plain
from app.tracking.particle_filter import Particles, normalise, update


@pytest.fixture
def rng():
    return np.random.default_rng(4)


def grid_of(rng: np.random.Generator, layers: int, components: str = "vector") -> FieldGrid:
    c = {"vector": 3, "level": 2, "norm": 1}[components]
    shape = (layers, 7, 9, c)
    return FieldGrid(
        components=components,
        origin_m=(-1.0, 2.0),
        resolution_m=0.5,
        heights_m=np.array([0.5, 1.0, 1.9, 2.0])[:layers],
        mean_uT=rng.normal(0.0, 20.0, shape).astype(np.float32),
        sd_uT=rng.uniform(0.1, 2.0, shape).astype(np.float32),
        gradient_uT_per_m=np.zeros((*shape, 2), dtype=np.float32),
        measured=rng.random(shape[:3]) > 0.15,
        ambient_uT=np.arange(1.0, c + 1.0),
        prior_sd_uT=np.full(c, 7.0),
        noise_sd_uT=np.ones(c),
    )


@pytest.mark.parametrize("components", ["vector", "level", "norm"])
@pytest.mark.parametrize("layers", [1, 2, 4])
def test_lookup_is_the_grids_own(rng, components, layers):
    grid = grid_of(rng, layers, components)
    inside = rng.uniform([-1.5, 1.5, 0.3], [3.5, 5.5, 2.2], (4000, 3))
    on_cells = np.array([[-1.0, 2.0, 0.5], [3.0, 5.0, 1.0], [3.0, 2.0, 2.0], [0.5, 3.5, 1.9], [3.0001, 5.0, 1.0]])
    for points in (inside, on_cells, inside[:, :2]):
        fast, plain = look_up(field_table(grid), points), look_up_plain(grid, points)
        np.testing.assert_allclose(fast.mean_uT, plain.mean_uT, atol=1e-4)
        np.testing.assert_allclose(fast.variance_uT2, plain.variance_uT2, rtol=1e-5, atol=1e-6)
        np.testing.assert_array_equal(fast.measured, plain.measured)
        assert 0 < fast.measured.sum() < len(points)


class TestLikelihood:
    @pytest.mark.parametrize("c", [1, 2, 3])
    def test_is_a_density_with_the_maps_variance(self, rng, c):
        looked = Looked(rng.normal(size=(5, c)), rng.uniform(0.1, 3.0, (5, c)), np.ones(5, dtype=bool))
        reading, sensor = rng.normal(size=c), rng.uniform(0.2, 1.0, c)
        found = log_likelihood(looked, reading, sensor)
        for k in range(5):
            R = np.diag(looked.variance_uT2[k] + sensor)
            assert found[k] == pytest.approx(multivariate_normal(looked.mean_uT[k], R).logpdf(reading))

    def test_a_vague_map_gains_nothing_from_being_vague(self):
        """The determinant's term: without it the vaguer of two maps that fit as well would always win."""
        looked = Looked(np.zeros((2, 1)), np.array([[0.1], [100.0]]), np.ones(2, dtype=bool))
        near, far = (log_likelihood(looked, np.array([x]), 1.0) for x in (0.5, 30.0))
        assert near[0] > near[1]
        assert far[0] < far[1]

    def test_components_that_were_not_read(self):
        looked = Looked(np.zeros((1, 3)), np.ones((1, 3)), np.ones(1, dtype=bool))
        only_z = log_likelihood(looked, np.array([np.nan, np.nan, 1.0]), 1.0)
        z = Looked(looked.mean_uT[:, 2:], looked.variance_uT2[:, 2:], looked.measured)
        np.testing.assert_allclose(only_z, log_likelihood(z, np.array([1.0]), 1.0))

    def test_literal_is_the_sources(self, rng):
        """exp(-1/2 dm' R^-1 dm), the map's variance unused (Kuevor, eq. 4.8)."""
        looked = Looked(rng.normal(size=(4, 3)), np.full((4, 3), 9.0), np.ones(4, dtype=bool))
        reading = np.array([0.3, -0.2, 1.0])
        off = reading - looked.mean_uT
        np.testing.assert_allclose(literal(looked, reading, 2.0), -0.25 * np.sum(off**2, axis=1))
        R = np.array([[2.0, 0.3, 0.0], [0.3, 1.0, 0.1], [0.0, 0.1, 3.0]])
        np.testing.assert_allclose(literal(looked, reading, R), [-0.5 * d @ np.linalg.inv(R) @ d for d in off])

    def test_level_readings_are_turned_by_each_particles_heading(self):
        reading, headings = np.array([20.0, 3.0, -45.0]), np.array([0.0, 0.7, -2.0])
        np.testing.assert_allclose(turned(reading, headings), [yaw_matrix(h) @ reading for h in headings])

    def test_norm_of_a_vector_map(self, rng):
        looked = Looked(np.array([[30.0, 0.0, -40.0]]), np.array([[1.0, 9.0, 4.0]]), np.ones(1, dtype=bool))
        norm = norm_of(looked)
        drawn = np.linalg.norm(looked.mean_uT + np.sqrt(looked.variance_uT2) * rng.normal(size=(40_000, 3)), axis=1)
        assert norm.mean_uT[0, 0] == pytest.approx(50.0)
        assert norm.variance_uT2[0, 0] == pytest.approx(drawn.var(), rel=0.05)


class TestUnmapped:
    def test_keep_the_share_they_had_whatever_is_read(self, rng):
        """Neither gain nor lose against the mapped, however good or bad the mapped fit."""
        measured = rng.random(50) > 0.4
        log_weight = np.log(rng.dirichlet(np.ones(50)))
        before = np.exp(log_weight)[~measured].sum()
        for scale in (0.1, 30.0, 3000.0):
            log_l = -scale * rng.exponential(size=50)
            after = normalise(log_weight + neutral(log_l, measured, log_weight)).weight
            assert after[~measured].sum() == pytest.approx(before)
            mapped = normalise(log_weight[measured] + log_l[measured]).weight
            np.testing.assert_allclose(after[measured] / after[measured].sum(), mapped)

    def test_nothing_mapped_says_nothing(self):
        log_l = np.array([-3.0, -9.0])
        np.testing.assert_array_equal(neutral(log_l, np.zeros(2, dtype=bool), np.log([0.5, 0.5])), 0.0)

    def test_mapped_particles_that_have_lost_do_not_count(self):
        measured, log_weight = np.array([True, True, False]), np.array([-np.inf, np.log(0.5), np.log(0.5)])
        found = neutral(np.array([0.0, -8.0, np.nan]), measured, log_weight)
        np.testing.assert_allclose(found[2], -8.0)

    def test_a_walk_through_a_gap_survives(self, rng):
        """Half of the particles cross a gap in the map for many readings, the others are mapped where it fits badly."""
        state, measured = np.repeat([[0.0], [1.0]], 500, axis=0), np.repeat([False, True], 500)
        particles = Particles.equal(state)
        for _ in range(30):
            log_l = np.where(measured, -0.5 * rng.normal(3.0, 0.3, 1000) ** 2, np.nan)
            measured = particles.state[:, 0] > 0.5
            particles = update(particles, neutral(log_l, measured, particles.log_weight), rng).particles
        assert np.mean(particles.state[:, 0] < 0.5) == pytest.approx(0.5, abs=0.1)
