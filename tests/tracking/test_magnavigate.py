"""The filter along roads: it finds its place by the field, and tells when it is lost."""

import numpy as np

from app.tracking.constraints import RoadPenalty
from app.tracking.magnavigate import MagNavigate, begin_around
from app.tracking.particle_filter import Particles


def road_filter() -> tuple[MagNavigate, np.ndarray, np.ndarray]:
    along = np.arange(0.0, 400.0)
    sample_m = np.column_stack([along, np.zeros(400)])
    field = np.stack([np.sin(along / 7.0), np.cos(along / 11.0), np.sin(along / 23.0)], axis=1) * 5.0
    return MagNavigate(RoadPenalty.of(sample_m), field, np.full(3, 0.5)), sample_m, field


def test_starts_in_a_disc_at_rest():
    found = begin_around(np.array([3.0, -4.0]), np.random.default_rng(0), 4000)
    r = np.hypot(*(found.state[:, :2] - [3.0, -4.0]).T)
    assert r.max() <= 50.0
    assert abs(np.median(r) - 50.0 / np.sqrt(2.0)) < 1.0
    assert not found.state[:, 2:].any()


def test_follows_a_drive_by_its_field():
    navigate, sample_m, field = road_filter()
    rng = np.random.default_rng(1)
    particles, errors = begin_around(sample_m[30], rng), []
    for k in range(30, 350, 2):
        found = navigate.step(particles, 0.2, rng, reading_uT=field[k] + 0.2 * rng.normal(size=3))
        particles = found.particles
        errors.append(np.linalg.norm(found.estimate.mean[:2] - sample_m[k]))
        assert not found.diverged
    assert np.sqrt(np.mean(np.square(errors[40:]))) < 3.0


def test_positions_hold_it_where_they_say():
    navigate, sample_m, _ = road_filter()
    rng = np.random.default_rng(2)
    particles = begin_around(sample_m[100], rng)
    for _ in range(20):
        found = navigate.step(particles, 0.2, rng, position_m=sample_m[100])
        particles = found.particles
    assert np.linalg.norm(found.estimate.mean[:2] - sample_m[100]) < 10.0


def test_nothing_read_only_spreads_along_the_road():
    navigate, _, _ = road_filter()
    rng = np.random.default_rng(3)
    particles = Particles.equal(np.tile([200.0, 0.0, 0.0, 0.0, 0.0, 0.0], (500, 1)))
    for _ in range(20):
        found = navigate.step(particles, 0.5, rng)
        particles = found.particles
    sd = np.sqrt(np.diag(found.estimate.covariance))
    assert sd[0] > 3.0 * sd[1]
