"""Motion models against the values and identities of their sources."""

import numpy as np
import pytest
from scipy.linalg import expm

from app.tracking.motion import GRAVITY_M_S2, Accelerometer, Displacement, GaussMarkov, RandomWalk, without_gravity


@pytest.fixture
def rng():
    return np.random.default_rng(8)


def van_loan(model: GaussMarkov, elapsed_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Transition and noise by the matrix exponential."""
    F = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / model.time_constant_s]])
    Q = np.zeros((3, 3))
    Q[2, 2] = 2.0 * model.acceleration_sd_m_s2**2 / model.time_constant_s
    block = expm(elapsed_s * np.block([[-F, Q], [np.zeros((3, 3)), F.T]]))
    transition = block[3:, 3:].T
    return transition, transition @ block[:3, 3:]


class TestGaussMarkov:
    def test_printed_values(self):
        """T = 1 s, tau = 2 s, sd 5 m/s^2 (Shockley 10.2)."""
        model = GaussMarkov()
        transition, Q = model.transition(1.0), model.noise_covariance(1.0)
        np.testing.assert_allclose(transition[0], [1.0, 1.0, 0.426123], atol=5e-7)
        np.testing.assert_allclose(transition[1], [0.0, 1.0, 0.786939], atol=5e-7)
        np.testing.assert_allclose(transition[2], [0.0, 0.0, 0.606531], atol=5e-7)
        printed = [[0.95703, 2.26976, 2.55899], [2.26976, 5.82432, 7.74091], [2.55899, 7.74091, 15.80301]]
        np.testing.assert_allclose(Q, printed, atol=5e-6)

    @pytest.mark.parametrize("elapsed_s", [0.05, 0.1, 0.19, 0.21, 1.0, 2.0])
    def test_is_van_loans(self, elapsed_s):
        model = GaussMarkov()
        transition, Q = van_loan(model, elapsed_s)
        np.testing.assert_allclose(model.transition(elapsed_s), transition, rtol=1e-9)
        np.testing.assert_allclose(model.noise_covariance(elapsed_s), Q, rtol=1e-6)

    @pytest.mark.parametrize("elapsed_s", [1e-4, 1e-3, 0.02])
    def test_short_steps(self, elapsed_s):
        """Where the closed form would be negative: q11 -> 2 sd^2 / tau T^5 / 20."""
        Q = GaussMarkov().noise_covariance(elapsed_s)
        assert Q[0, 0] == pytest.approx(25.0 * elapsed_s**5 / 20.0, rel=elapsed_s)
        assert np.all(np.linalg.eigvalsh(Q / np.sqrt(np.outer(np.diag(Q), np.diag(Q)))) > 0.0)

    @pytest.mark.parametrize(
        ("elapsed_s", "sd_m", "sd_m_s"), [(1.0, 0.98, 2.4), (5.0, 35.0, 15.0), (30.0, 856.0, 52.0)]
    )
    def test_growth_from_rest(self, elapsed_s, sd_m, sd_m_s):
        Q = GaussMarkov().noise_covariance(elapsed_s)
        np.testing.assert_allclose(np.sqrt(np.diag(Q))[:2], [sd_m, sd_m_s], rtol=0.02)

    @pytest.mark.parametrize("whole_s", [1.0, 5.0, 60.0])
    def test_two_steps_are_one(self, whole_s):
        model = GaussMarkov()
        first_s, last_s = 0.15 * whole_s, 0.85 * whole_s
        F = model.transition(last_s)
        np.testing.assert_allclose(F @ model.transition(first_s), model.transition(whole_s), rtol=1e-9, atol=1e-15)
        both = F @ model.noise_covariance(first_s) @ F.T + model.noise_covariance(last_s)
        np.testing.assert_allclose(both, model.noise_covariance(whole_s), rtol=1e-8)

    def test_particles_scatter_as_told(self, rng):
        model = GaussMarkov()
        state = model.propagate(np.zeros((40_000, 6)), 1.0, rng)
        np.testing.assert_allclose(np.cov(state[:, [0, 2, 4]].T), model.noise_covariance(1.0), rtol=0.05)
        assert model.propagate(state, 0.0, rng) is state

    def test_speed_limit(self, rng):
        state = GaussMarkov(speed_limit_m_s=1.5).propagate(np.zeros((1000, 6)), 10.0, rng)
        assert np.hypot(state[:, 2], state[:, 3]).max() < 1.5 + 1e-9


class TestDisplacement:
    def test_turns_and_scales(self, rng):
        still = Displacement(0.0, 0.0, 0.0)
        moved = still.propagate(np.array([[1.0, 2.0, np.pi / 2.0, 1.1]]), np.array([2.0, 0.5]), rng)
        np.testing.assert_allclose(moved, [[1.0 - 0.55, 2.0 + 2.2, np.pi / 2.0, 1.1]], atol=1e-12)

    def test_noise_grows_with_the_root_of_the_distance(self, rng):
        model = Displacement(0.1, 0.02, 0.005)
        start = np.tile([0.0, 0.0, 0.0, 1.0], (40_000, 1))
        for told_m in (1.0, 4.0):
            moved = model.propagate(start, np.array([told_m, 0.0]), rng)
            root = np.sqrt(told_m)
            np.testing.assert_allclose(moved[:, 2:].std(axis=0), [0.02 * root, 0.005 * root], rtol=0.03)
            across = np.hypot(0.1 * root, told_m * 0.02 * root)
            assert moved[:, 1].std() == pytest.approx(across, rel=0.03)

    def test_heading_drifts_while_standing(self):
        assert Displacement(heading_sd_rad_per_sqrt_s=0.01).sds(0.0, 4.0) == (0.0, pytest.approx(0.02), 0.0)


class TestAccelerometer:
    def test_position_uses_the_new_velocity(self, rng):
        """Semi-implicit Euler (Kuevor, L1530)."""
        still = Accelerometer(1e-12, 1e-12)
        moved = still.propagate(np.array([[0.0, 0.0, 1.0, 1.0, 0.0, 0.0]]), np.array([2.0, 0.0, -4.0]), 0.1, rng)
        np.testing.assert_allclose(moved, [[0.12, 0.0, 0.96, 1.2, 0.0, -0.4]], atol=1e-9)

    def test_rest_is_no_acceleration(self):
        np.testing.assert_allclose(without_gravity(np.array([[0.0, 0.0, GRAVITY_M_S2]])), 0.0)

    def test_noise_of_a_step_is_as_given(self):
        Q = Accelerometer(0.001, 0.03).noise_covariance(1, 0.005)
        np.testing.assert_allclose(Q, np.diag([1e-6, 9e-4]))


def test_random_walk(rng):
    moved = RandomWalk(0.5).propagate(np.zeros((40_000, 2)), 4.0, rng)
    np.testing.assert_allclose(moved.std(axis=0), 1.0, rtol=0.02)
