from typing import Literal

import numpy as np
import pytest

from app.synthetic import SyntheticBuilding, lawn_mower, ornstein_uhlenbeck, random_waypoints


@pytest.mark.parametrize("along", ["x", "y"])
def test_lanes_cover_the_floor(building: SyntheticBuilding, rng: np.random.Generator, along: Literal["x", "y"]) -> None:
    walk = lawn_mower(building, 1, rng, along=along)
    grid = building.device_grid_m(1).reshape(-1, 3)[:, :2]
    nearest = [np.linalg.norm(walk.p_building_m[:, :2] - p, axis=1).min() for p in grid]
    assert max(nearest) < 0.6
    x0, y0, x1, y1 = building.walkable_m
    assert np.all(walk.p_building_m[:, :2] >= np.array([x0, y0]) - 1e-9)
    assert np.all(walk.p_building_m[:, :2] <= np.array([x1, y1]) + 1e-9)


def test_lanes_two_apart_and_offset_interleave(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    even = lawn_mower(building, 0, rng, lane_m=2.0)
    odd = lawn_mower(building, 0, rng, lane_m=2.0, offset_m=1.0)
    middle = abs(even.p_building_m[:, 0] - 10.0) < 2.0
    lanes = np.unique(even.p_building_m[middle, 1].round(2))
    np.testing.assert_allclose(np.diff(lanes), 2.0)
    middle = abs(odd.p_building_m[:, 0] - 10.0) < 2.0
    np.testing.assert_allclose(np.unique(odd.p_building_m[middle, 1].round(2))[:3], lanes[:3] + 1.0)


def test_random_walk_is_walked_like_a_person(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    walk = random_waypoints(building, 1, rng, length_m=100.0)
    assert walk.path_length_m()[-1] >= 100.0
    step = np.diff(walk.p_building_m[:, :2], axis=0)
    speed = np.linalg.norm(step, axis=1) / np.diff(walk.t_s)
    assert np.median(speed) == pytest.approx(1.2, abs=0.1)
    assert speed.max() < 1.6
    turn = np.diff(np.unwrap(walk.heading_rad)) / np.diff(walk.t_s)
    assert np.abs(turn).max() < 2 * np.pi
    along = np.cos(np.arctan2(step[:, 1], step[:, 0]) - walk.heading_rad[:-1])
    assert np.median(along) > 0.999
    assert np.mean(along > 0.9) > 0.95
    height = walk.p_building_m[:, 2] - building.elevations_m[1]
    assert height.mean() == pytest.approx(1.2, abs=0.03)
    assert 0.01 < height.std() < 0.04


def test_same_seed_same_walk(building: SyntheticBuilding) -> None:
    first, second = (random_waypoints(building, 0, np.random.default_rng(4), length_m=30.0) for _ in range(2))
    np.testing.assert_array_equal(first.p_building_m, second.p_building_m)
    np.testing.assert_array_equal(first.heading_rad, second.heading_rad)


def test_ornstein_uhlenbeck_is_stationary_and_forgets() -> None:
    rng = np.random.default_rng(9)
    t = np.cumsum(rng.uniform(0.1, 1.0, 400))
    paths = ornstein_uhlenbeck(rng, t, 2.0, 5.0, 4000)
    sd = paths.std(axis=1)
    assert sd[0] == pytest.approx(2.0, rel=0.06)
    assert np.all(np.abs(sd / 2.0 - 1.0) < 0.06)
    lag = 10
    found = np.mean(paths[100] * paths[100 + lag])
    assert found == pytest.approx(4.0 * np.exp(-(t[100 + lag] - t[100]) / 5.0), abs=0.2)
    assert np.abs(np.mean(paths)) < 0.05


def test_ornstein_uhlenbeck_of_one_point_and_of_no_spread() -> None:
    rng = np.random.default_rng(0)
    assert ornstein_uhlenbeck(rng, np.zeros(1), 1.0, 1.0, 3).shape == (1, 3)
    assert not ornstein_uhlenbeck(rng, np.arange(5.0), np.zeros(2), 1.0, 2).any()
