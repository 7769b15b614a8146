"""Windows before they are matched: resampling by distance, headings, turning, and what correlated errors leave."""

import numpy as np
import pytest

from app.positioning.lattice import (
    heading_lattice,
    reduce_window,
    single_course,
    turn_window,
)
from app.positioning.matching import device_turn_rad
from app.positioning.window import Window


def window_along(p: np.ndarray, **more: object) -> Window:
    displacement = np.column_stack([p, np.zeros(len(p))])
    B = np.column_stack([p, np.arange(len(p))]).astype(float)
    return Window("level", B, displacement, 0.6, **more)  # type: ignore[arg-type]


def test_standing_still_adds_nothing() -> None:
    p = np.zeros((9, 2))
    p[4:, 0], p[7:, 0] = 1.0, 2.0  # four samples at 0, three at 1 m, two at 2 m
    reduced = reduce_window(window_along(p), "vector", 0.25)
    assert len(reduced) == 3
    np.testing.assert_allclose(reduced.from_last_m, [[-2.0, 0.0], [-1.0, 0.0], [0.0, 0.0]])
    np.testing.assert_allclose(reduced.features_uT[:, 2], [1.5, 5.0, 7.5])
    np.testing.assert_allclose(reduced.noise_variance_uT2, 0.36 / np.array([4, 3, 2]))


def test_samples_further_apart_than_the_spacing_stay() -> None:
    p = np.column_stack([np.arange(5) * 0.5, np.zeros(5)])
    reduced = reduce_window(window_along(p), "vector", 0.25)
    np.testing.assert_allclose(reduced.features_uT[:, :2], p)


def test_headings_cover_the_circle_evenly() -> None:
    headings = heading_lattice(window_along(np.zeros((2, 2))), 2 * np.pi / 72)
    assert len(headings) == 72
    np.testing.assert_allclose(np.diff(np.append(headings, headings[0] + 2 * np.pi)), 2 * np.pi / 72)


def test_a_heading_prior_limits_the_search_and_is_on_the_lattice() -> None:
    window = window_along(np.zeros((2, 2)), heading_rad=1.0, heading_sd_rad=0.1)
    headings = heading_lattice(window, 0.03)
    assert np.abs(headings - 1.0).min() == pytest.approx(0.0, abs=1e-12)
    assert headings.min() == pytest.approx(0.55)
    assert headings.max() == pytest.approx(1.45)
    assert np.diff(headings).max() <= 0.03


def test_a_heading_without_sd_is_believed_and_a_building_window_has_one() -> None:
    np.testing.assert_allclose(heading_lattice(window_along(np.zeros((2, 2)), heading_rad=1.0), 0.1), [1.0])
    assert heading_lattice(Window("building", np.zeros((1, 3)), np.zeros((1, 3)), 0.1), 0.1).tolist() == [0.0]


def test_turning_by_a_quarter() -> None:
    reduced = reduce_window(window_along(np.array([[0.0, 0.0], [2.0, 0.0]])), "vector", 0.25)
    turned = turn_window(reduced, single_course(np.array([0.0, np.pi / 2])), 0.5)
    np.testing.assert_array_equal(turned.offset_cells[0], [[0, -4], [0, 0]])  # (row, column) = (y, x)
    np.testing.assert_array_equal(turned.offset_cells[1], [[-4, 0], [0, 0]])
    np.testing.assert_allclose(turned.features_uT[1, 1], [0.0, 2.0, 1.0], atol=1e-12)


def test_device_turns_with_its_path_unless_told() -> None:
    corner = np.array([[0.0, 0], [1, 0], [2, 0], [2, 1], [2, 2]])
    assert device_turn_rad(window_along(corner)) == pytest.approx(np.pi / 2)
    assert device_turn_rad(window_along(corner[:, ::-1])) == pytest.approx(-np.pi / 2)
    assert device_turn_rad(window_along(corner, yaw_rad=np.linspace(0, 0.3, 5))) == pytest.approx(0.3)
    assert device_turn_rad(window_along(corner * 0.01)) == 0.0
    assert device_turn_rad(window_along(corner[:1])) == 0.0
