"""What particles say: places, radii, and how many particles a belief needs."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.tracking.estimate import carried_on, describe, occupied_bins
from app.tracking.options import TrackOptions
from app.tracking.particles import COURSE, HEADING, MEASURED, SCALE, Particles, new_particles, weights
from app.tracking.resampling import enough


def cloud(seed: int, centres: list[tuple[float, float, int, float]], n: int = 4000, sd_m: float = 0.3) -> Particles:
    """Gaussian heaps: x, y, floor, share."""
    rng = np.random.default_rng(seed)
    share = np.array([each[3] for each in centres])
    of = np.sort(rng.choice(len(centres), n, p=share / share.sum()))
    position = np.array([[x, y, 1.2 + 4 * floor] for x, y, floor, _ in centres])[of]
    position[:, :2] += sd_m * rng.normal(size=(n, 2))
    floor = np.array([each[2] for each in centres])[of]
    return new_particles(position, floor, 0.5 + 0.05 * rng.normal(size=n), 1.0)


def test_one_heap_is_one_place_with_its_moments_and_radii() -> None:
    particles = cloud(1, [(5.0, 7.0, 0, 1.0)])
    said = describe(particles, weights(particles), 2, 0.0)
    assert len(said.spots) == 1
    assert said.concentration == 1.0
    np.testing.assert_allclose(said.position_m, (5.0, 7.0, 1.2), atol=0.02)
    np.testing.assert_allclose(said.covariance_m2, 0.09 * np.eye(2), atol=0.01)
    assert said.radius_68_m == pytest.approx(0.3 * 1.51, rel=0.05)
    assert said.radius_95_m == pytest.approx(0.3 * 2.448, rel=0.05)
    assert said.heading_rad == pytest.approx(0.5, abs=0.01)
    assert said.heading_sd_rad == pytest.approx(0.05, rel=0.1)
    np.testing.assert_allclose(said.floor_probability, (1.0, 0.0))


def test_places_come_strongest_first_and_the_rest_of_the_belief_widens_the_radius() -> None:
    particles = cloud(2, [(5.0, 7.0, 0, 0.2), (30.0, 7.0, 0, 0.5), (5.0, 7.0, 1, 0.3)])
    said = describe(particles, weights(particles), 2, 0.0)
    assert [(spot.floor, round(spot.position_m[0])) for spot in said.spots] == [(0, 30), (1, 5), (0, 5)]
    np.testing.assert_allclose([spot.probability for spot in said.spots], (0.5, 0.3, 0.2), atol=0.03)
    np.testing.assert_allclose(said.floor_probability, (0.7, 0.3), atol=0.03)
    assert said.floor == 0
    assert said.radius_68_m < 1.0  # five sevenths of that floor are here
    assert said.radius_95_m > 20.0


def test_what_places_of_the_map_err_by_is_in_covariance_and_radius() -> None:
    particles = cloud(3, [(5.0, 7.0, 0, 1.0)])
    said = describe(particles, weights(particles), 1, 2.0**2)
    np.testing.assert_allclose(said.covariance_m2, (4.0 + 0.09) * np.eye(2), atol=0.02)
    assert said.radius_95_m == pytest.approx(2.448 * np.hypot(2.0, 0.3), rel=0.03)


@settings(deadline=None, max_examples=40)
@given(st.integers(0, 10_000), st.integers(1, 4))
def test_shares_are_a_belief(seed: int, heaps: int) -> None:
    rng = np.random.default_rng(seed)
    centres = [(*rng.uniform(0, 40, 2), int(rng.integers(3)), float(rng.uniform(0.1, 1.0))) for _ in range(heaps)]
    particles = cloud(seed, centres, n=500, sd_m=float(rng.uniform(0.05, 2.0)))  # type: ignore[arg-type]
    particles = Particles(particles.rows, particles.floor, rng.normal(0, 1, 500))
    said = describe(particles, weights(particles), 3, 0.0)
    assert said.floor_probability.sum() == pytest.approx(1.0)
    assert 0.0 < sum(spot.probability for spot in said.spots) <= 1.0 + 1e-9
    assert said.spots[0].probability == max(spot.probability for spot in said.spots)
    assert 0.0 < said.radius_68_m <= said.radius_95_m
    assert np.linalg.eigvalsh(said.covariance_m2).min() >= 0.0


def test_an_estimate_is_carried_on_as_the_device_reckons() -> None:
    particles = cloud(4, [(5.0, 7.0, 0, 1.0)])
    particles.rows[:, SCALE], particles.rows[:, COURSE], particles.rows[:, HEADING] = 1.1, 0.2, 0.5
    on = carried_on(describe(particles, weights(particles), 1, 0.0), np.array([2.0, 0.0, 0.3]))
    before = describe(particles, weights(particles), 1, 0.0).position_m
    np.testing.assert_allclose(
        np.subtract(on.position_m, before), (2.2 * np.cos(0.7), 2.2 * np.sin(0.7), 0.3), rtol=1e-9
    )
    assert on.spots[0].position_m == on.position_m
    assert particles.rows[0, MEASURED] == 1.0


def test_a_wide_belief_needs_more_particles_than_a_narrow_one_within_limits() -> None:
    options = TrackOptions(particles=3000, least_particles=200)
    narrow, wide = cloud(5, [(5.0, 7.0, 0, 1.0)], sd_m=0.1), cloud(5, [(5.0, 7.0, 0, 1.0)], sd_m=8.0)
    assert occupied_bins(narrow) < occupied_bins(wide)
    few, many = (enough(each, weights(each), options) for each in (narrow, wide))
    assert 200 <= few < many == 3000
    light = Particles(wide.rows, wide.floor, np.where(np.arange(4000) < 20, 0.0, -40.0))
    assert enough(light, weights(light), options) < many  # those that count for nothing are not counted
