"""The fixed-lag smoother against the Rauch-Tung-Striebel smoother, where everything is linear."""

import numpy as np

from app.tracking.particles import Particles, new_particles, resample, weights
from app.tracking.smoother import Node, empty_lag, inherit, remember, settle


def test_the_smoothed_place_is_that_of_a_linear_smoother() -> None:
    """A random walk in x, seen with noise: means and variances of the places k - 4 given what was seen up to k."""
    rng = np.random.default_rng(1)
    steps, q, r, n, lag_m = 14, 0.5, 0.7, 60_000, 4.0
    x = np.cumsum(np.sqrt(q) * rng.normal(size=steps))
    seen = x + np.sqrt(r) * rng.normal(size=steps)
    particles = new_particles(np.zeros((n, 3)), np.zeros(n, dtype=int), np.zeros(n), 1.0)
    lag, got = empty_lag(n), {}
    for k in range(steps):
        rows = particles.rows.copy()
        rows[:, 0] += np.sqrt(q) * rng.normal(size=n)
        particles = Particles(rows, particles.floor, particles.log_weight - 0.5 * (seen[k] - rows[:, 0]) ** 2 / r)
        lag = remember(lag, Node(k, float(k), float(k)), particles)
        lag, settled = settle(lag, weights(particles), k - lag_m)
        got |= {place.node.number: place for place in settled}
        particles, chosen = resample(particles, weights(particles), n, float(rng.uniform()))
        lag = inherit(lag, chosen)
    assert sorted(got) == list(range(steps - 4))
    for k, place in got.items():
        mean, variance = linear_smoother(seen[: k + 5], q, r)
        assert abs(place.position_m[0] - mean[k]) < 0.03
        assert abs(place.covariance_m2[0, 0] / variance[k] - 1.0) < 0.06


def linear_smoother(seen: np.ndarray, q: float, r: float) -> tuple[np.ndarray, np.ndarray]:
    """Of a random walk from zero: the joint Gaussian of places and readings, conditioned at once."""
    n = len(seen)
    P = q * (np.minimum.outer(np.arange(n), np.arange(n)) + 1.0)
    gain = P @ np.linalg.inv(P + r * np.eye(n))
    return gain @ seen, np.diag(P - gain @ P)


def test_places_are_remembered_half_a_metre_apart_and_settle_once() -> None:
    particles = new_particles(np.zeros((3, 3)), np.zeros(3, dtype=int), np.zeros(3), 1.0)
    lag = empty_lag(3)
    for k, path_m in enumerate((0.0, 0.2, 0.5, 0.9, 1.0, 2.0)):
        lag = remember(lag, Node(k, float(k), path_m), particles)
    assert [node.number for node in lag.nodes] == [0, 2, 4, 5]
    lag, settled = settle(lag, np.full(3, 1 / 3), 0.6)
    assert [place.node.number for place in settled] == [0, 2]
    assert [node.number for node in lag.nodes] == [4, 5]
    assert settle(lag, np.full(3, 1 / 3), 0.6)[1] == ()
