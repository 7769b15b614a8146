"""The steps of the particle filter, and the filter against a Kalman filter where both are exact."""

import numpy as np
import pytest
from filterpy.kalman import KalmanFilter
from hypothesis import given, settings
from hypothesis import strategies as st

from app.tracking.motion import Accelerometer, GaussMarkov
from app.tracking.particle_filter import (
    Particles,
    effective_sample_size,
    estimate,
    kld_sample_size,
    needs_resampling,
    normalise,
    occupied_bins,
    roughen,
    systematic_ancestors,
    update,
)

weights = st.lists(st.one_of(st.just(0.0), st.floats(1e-6, 1.0)), min_size=1, max_size=40).filter(lambda w: sum(w) > 0)


@pytest.fixture
def rng():
    return np.random.default_rng(5)


class TestNormalise:
    def test_far_below_zero_and_far_above(self):
        for shift in (-1e5, 0.0, 1e5):
            found = normalise(np.log([1.0, 3.0]) + shift)
            np.testing.assert_allclose(found.weight, [0.25, 0.75])
            assert found.log_sum == pytest.approx(np.log(4.0) + shift)
            assert not found.diverged

    @pytest.mark.parametrize("lost", [-np.inf, np.nan])
    def test_all_lost_is_a_divergence_and_no_nan(self, lost):
        found = normalise(np.full(4, lost))
        assert found.diverged
        np.testing.assert_array_equal(found.weight, 0.25)

    def test_nan_counts_as_lost(self):
        np.testing.assert_array_equal(normalise(np.array([0.0, np.nan])).weight, [1.0, 0.0])


class TestResampling:
    def test_effective_sample_size(self):
        assert effective_sample_size(np.full(8, 0.125)) == pytest.approx(8.0)
        assert effective_sample_size(np.array([1.0, 0.0, 0.0])) == 1.0

    def test_triggers_strictly_below_three_quarters(self):
        """Equal weights on three of four particles are worth exactly 0.75 n (Kuevor, L1565)."""
        exactly = np.array([1.0, 1.0, 1.0, 0.0]) / 3.0
        assert effective_sample_size(exactly) == pytest.approx(3.0)
        assert not needs_resampling(exactly)
        assert needs_resampling(np.array([0.34, 0.33, 0.33, 0.0]))

    @given(weights, st.floats(0.0, 1.0, exclude_max=True), st.integers(1, 60))
    @settings(deadline=None)
    def test_copies_are_the_expected_number_rounded_up_or_down(self, weight, uniform, count):
        weight = np.array(weight) / np.sum(weight)
        ancestors = systematic_ancestors(weight, uniform, count)
        copies = np.bincount(ancestors, minlength=len(weight))
        assert len(ancestors) == count
        assert np.all(np.diff(ancestors) >= 0)
        assert np.all(np.abs(copies - count * weight) < 1.0 + 1e-9)
        assert np.all(copies[weight == 0.0] == 0)

    @given(weights)
    @settings(deadline=None, max_examples=25)
    def test_unbiased_over_its_one_draw(self, weight):
        weight = np.array(weight) / np.sum(weight)
        draws = (np.arange(2000) + 0.5) / 2000
        copies = np.mean([np.bincount(systematic_ancestors(weight, u), minlength=len(weight)) for u in draws], axis=0)
        np.testing.assert_allclose(copies, len(weight) * weight, atol=2e-3)

    def test_jitter_parts_the_copies(self, rng):
        apart = roughen(np.zeros((20_000, 2)), np.array([0.02, 0.05]), rng)
        np.testing.assert_allclose(apart.std(axis=0), [0.02, 0.05], rtol=0.03)


class TestUpdate:
    def test_estimate_is_of_the_weighted_set(self, rng):
        state = np.array([[0.0], [1.0]])
        found = update(Particles.equal(state), np.log([0.25, 0.75]), rng)
        np.testing.assert_allclose(found.estimate.mean, [0.75])
        np.testing.assert_allclose(found.estimate.covariance, [[0.1875]])
        assert found.log_evidence == pytest.approx(np.log(0.5))

    def test_resampling_draws_one_uniform(self):
        """Not one more: replay depends on it."""
        used, twin = np.random.default_rng(1), np.random.default_rng(1)
        assert update(Particles.equal(np.eye(4)), np.array([0.0, -9.0, -9.0, -9.0]), used).resampled
        twin.random()
        assert used.random() == twin.random()

    def test_keeps_weights_while_enough_are_effective(self, rng):
        found = update(Particles.equal(np.eye(4)), np.log([0.3, 0.25, 0.25, 0.2]), rng)
        assert not found.resampled
        np.testing.assert_allclose(np.exp(found.particles.log_weight), [0.3, 0.25, 0.25, 0.2])

    def test_all_lost(self, rng):
        found = update(Particles.equal(np.eye(3)), np.full(3, -np.inf), rng)
        assert found.diverged
        assert not found.resampled
        assert found.log_evidence == -np.inf
        assert np.isfinite(found.estimate.mean).all()
        np.testing.assert_allclose(np.exp(found.particles.log_weight), 1.0 / 3.0)


class TestSampleSize:
    def test_is_the_chi_square_quantile(self):
        """Wilson-Hilferty is within a percent of the exact quantile (Fox 2003)."""
        from scipy.stats import chi2

        for bins in (5, 50, 500):
            exact = chi2.ppf(0.99, bins - 1) / (2.0 * 0.05)
            assert kld_sample_size(bins) == pytest.approx(exact, rel=0.01, abs=1.0)

    def test_by_hand(self):
        k, z = 10, 2.3263478740408408
        a = 2.0 / (9.0 * (k - 1))
        assert kld_sample_size(k, 0.05, 0.01) == int(np.ceil((k - 1) / 0.1 * (1.0 - a + np.sqrt(a) * z) ** 3))
        assert kld_sample_size(1) == 1

    def test_bins(self):
        state = np.array([[0.1, 0.1], [0.4, 0.2], [0.6, 0.1], [-0.1, 0.0]])
        assert occupied_bins(state, np.array([0.5, 0.5])) == 3


def kalman(model: GaussMarkov, H: np.ndarray, R: np.ndarray, start_sd: np.ndarray, step_s: float) -> KalmanFilter:
    kf = KalmanFilter(dim_x=6, dim_z=len(H))
    kf.x, kf.P = np.zeros((6, 1)), np.diag(start_sd**2)
    kf.F = np.kron(model.transition(step_s), np.eye(2))
    kf.Q = np.kron(model.noise_covariance(step_s), np.eye(2))
    kf.H, kf.R = H, R
    return kf


def test_is_a_kalman_filter_where_the_field_is_linear():
    """Mean and covariance over eight steps, B = B0 + J p: within the scatter of sixteen independent filters."""
    step_s, rng = 0.5, np.random.default_rng(11)
    model = GaussMarkov(2.0, 0.5)
    J = np.array([[0.6, 0.1], [-0.2, 0.4], [0.1, -0.2]])
    H, R = np.hstack([J, np.zeros((3, 4))]), np.array([0.5, 0.7, 0.4]) ** 2
    start_sd = np.array([0.8, 0.5, 0.3, 0.3, 0.2, 0.2])
    kf = kalman(model, H, np.diag(R), start_sd, step_s)
    filters = [Particles.equal(start_sd * rng.normal(size=(6000, 6))) for _ in range(16)]
    truth, resampled = start_sd * rng.normal(size=6), 0
    for _ in range(8):
        truth = model.propagate(truth[None], step_s, rng)[0]
        reading = H @ truth + np.sqrt(R) * rng.normal(size=3)
        kf.predict()
        kf.update(reading[:, None])
        found = []
        for particles in filters:
            state = model.propagate(particles.state, step_s, rng)
            log_l = -0.5 * np.sum((reading - state @ H.T) ** 2 / R, axis=1)
            found.append(update(Particles(state, particles.log_weight), log_l, rng))
        filters, resampled = [each.particles for each in found], resampled + sum(each.resampled for each in found)
        sd = np.sqrt(np.diag(kf.P))
        means = np.array([each.estimate.mean for each in found]) / sd
        covariances = np.array([each.estimate.covariance for each in found]) / np.outer(sd, sd)
        assert within_scatter(means, kf.x[:, 0] / sd, at_most=0.05)
        assert within_scatter(covariances, kf.P / np.outer(sd, sd), at_most=0.05)
    assert 16 < resampled < 16 * 8


def within_scatter(found: np.ndarray, exact: np.ndarray, at_most: float) -> bool:
    """Whether the means over the first axis are five standard errors from what is exact, which are small at that."""
    standard_error = found.std(axis=0, ddof=1) / np.sqrt(len(found))
    return bool(
        np.all(np.abs(found.mean(axis=0) - exact) < 5.0 * standard_error + 1e-3) and standard_error.max() < at_most
    )


def test_dead_reckoning_in_one_burst_is_as_many_steps():
    model, rng = Accelerometer(0.001, 0.03), np.random.default_rng(2)
    acceleration = rng.normal(size=(10, 3))
    start = np.tile([0.1, 0.2, 0.3, 1.0, -0.5, 0.2], (40_000, 1))
    state = start
    for a in acceleration:
        state = model.propagate(state, a, 0.005, rng)
    burst = model.propagate_burst(start, acceleration, 0.005, rng)
    one, all_at_once = (estimate(s, np.full(len(s), 1.0 / len(s))) for s in (state, burst))
    sd = np.sqrt(np.diag(one.covariance))
    np.testing.assert_allclose(one.mean, all_at_once.mean, atol=float(0.03 * sd.max()))
    np.testing.assert_allclose(one.covariance / np.outer(sd, sd), all_at_once.covariance / np.outer(sd, sd), atol=0.03)
