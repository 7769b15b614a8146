"""Refinement between the cells: its derivatives, what it reaches, and the covariance it states."""

from collections.abc import Callable

import numpy as np
import pytest

from app.field.error_structure import ErrorStructure
from app.positioning.floors import prepare_floor, reduce_floor
from app.positioning.lattice import reduce_window
from app.positioning.refine import PoseGaussian, _linearise, refine_poses
from app.positioning.window_error import plain_error, window_error

FREE = PoseGaussian(np.zeros(5), np.array([0.0, 0.0, 0.0, 400.0, 1e5]), np.ones(5))


@pytest.mark.parametrize("precision", [None, 0.0, 1.0])
def test_reaches_the_true_pose_of_a_window_without_noise(
    precision: float | None, grid_of: Callable, walk_on: Callable
) -> None:
    rng = np.random.default_rng(2)
    grid = grid_of(rng, (60, 60), map_sd_uT=0.05, noise_sd_uT=0.0, length_m=2.0)
    floor = prepare_floor("a", grid)
    walked = walk_on(rng, grid, length_m=6.0, samples=20, noise_uT=0.0)
    truth = np.array([*walked.position_m, walked.yaw_rad, 0.0, 0.0])
    window = reduce_window(walked.window, "vector", 0.25)
    start = truth + np.array([[0.1, -0.12, 0.04, 0.01, 0.001], [-0.1, 0.08, -0.03, 0.0, 0.0]])
    refined = refine_poses(floor, floor.planes[0], window, start, FREE, plain_error(len(window), precision))
    np.testing.assert_allclose(refined.pose[:, :2], [truth[:2]] * 2, atol=0.01)
    np.testing.assert_allclose(refined.pose[:, 2:], [truth[2:]] * 2, atol=2e-3)
    assert (refined.distance2 < 0.1).all()


@pytest.mark.parametrize("components", ["vector", "level", "norm"])
def test_gradient_is_that_of_the_objective(components: str, grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(3)
    grid = grid_of(rng, (60, 60), length_m=3.0, noise_sd_uT=1.0)
    uniform = type(grid)(**{**{n: getattr(grid, n) for n in grid.__slots__}, "sd_uT": np.ones_like(grid.sd_uT)})
    floor = reduce_floor(prepare_floor("a", uniform), components)
    walked = walk_on(rng, grid, length_m=5.0, samples=12)
    window = reduce_window(walked.window, components, 0.25)
    prior = PoseGaussian(np.array([1.0, 12.0, 0.3, 0.0, 0.0]), np.array([0.1, 0.1, 2.0, 400.0, 1e4]), np.ones(5))
    pose = np.array([[*(walked.position_m + 0.05), walked.yaw_rad + 0.05, 0.02, 0.005]])
    path = window.path_m
    structure = ErrorStructure(0.1, 0.5, 0.4, 1.5)
    error = window_error(path, window.noise_variance_uT2, 1.0, structure, 1.0)

    def objective(at: np.ndarray) -> float:
        return float(_linearise(floor, floor.planes[0], window, at, prior, error).objective[0])

    numeric = [(objective(pose + e) - objective(pose - e)) / 2e-4 for e in 1e-4 * np.eye(5)]
    got = _linearise(floor, floor.planes[0], window, pose, prior, error).gradient[0]
    np.testing.assert_allclose(got, numeric, rtol=0.12, atol=0.05 * float(np.abs(numeric).max()))


def test_stated_covariance_is_that_of_repeated_windows(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(4)
    grid = grid_of(rng, (60, 60), map_sd_uT=1e-3, noise_sd_uT=0.5, length_m=2.0)
    floor = prepare_floor("a", grid)
    squared = []
    for _ in range(120):
        walked = walk_on(rng, grid, length_m=4.0, samples=12, noise_uT=0.0)
        truth = np.array([*walked.position_m, walked.yaw_rad, 0.0, 0.0])
        window = reduce_window(walked.window, "vector", 0.25)
        refined = refine_poses(floor, floor.planes[0], window, truth[None], FREE, plain_error(len(window)))
        error = (refined.pose[0] - truth)[:3]
        squared.append(error @ np.linalg.solve(refined.covariance[0, :3, :3], error))
    assert 2.2 < np.mean(squared) < 3.9  # chi-square with three degrees of freedom, bilinear interpolation on top


def test_what_is_not_free_stays(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(5)
    grid = grid_of(rng, (60, 60))
    floor = prepare_floor("a", grid)
    walked = walk_on(rng, grid, "building", length_m=4.0, samples=12)
    start = np.array([[*(walked.position_m + 0.1), 0.0, 0.0, 0.0]])
    held = PoseGaussian(np.zeros(5), np.zeros(5), np.array([1.0, 1.0, 0.0, 0.0, 0.0]))
    window = reduce_window(walked.window, "vector", 0.25)
    refined = refine_poses(floor, floor.planes[0], window, start, held, plain_error(len(window)))
    assert refined.pose[0, 2] == 0.0
    assert (refined.covariance[0, 2] == 0.0).all()
    assert (np.diag(refined.covariance[0])[:2] > 0.0).all()
