"""The conventions, against scipy and by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.geometry import horizontal_and_vertical, rotate_by_quaternion, wrap_angle_rad, yaw_matrix

angles = st.floats(-50, 50)
vectors = st.lists(st.floats(-100, 100), min_size=3, max_size=3).map(np.array)


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1), vectors)
def test_quaternions_are_scalar_first_and_rotate_body_to_building(q: list[float], v: np.ndarray) -> None:
    unit = np.array(q) / np.linalg.norm(q)
    expected = Rotation.from_quat(unit, scalar_first=True).apply(v)
    np.testing.assert_allclose(rotate_by_quaternion(unit[None], v[None])[0], expected, atol=1e-9)


@given(angles, vectors)
def test_yaw_turns_about_up_and_keeps_heading_free_features(heading: float, v: np.ndarray) -> None:
    turned = yaw_matrix(heading) @ v
    np.testing.assert_allclose(horizontal_and_vertical(turned[None]), horizontal_and_vertical(v[None]), atol=1e-9)


def test_a_quarter_turn_takes_forward_to_left() -> None:
    np.testing.assert_allclose(yaw_matrix(np.pi / 2) @ [1.0, 0.0, 5.0], [0.0, 1.0, 5.0], atol=1e-15)


@given(angles)
def test_wrapped_angles_are_the_same_direction_in_range(angle: float) -> None:
    wrapped = float(wrap_angle_rad(angle))
    assert -np.pi < wrapped <= np.pi
    assert np.cos(wrapped - angle) == pytest.approx(1.0)


def test_pi_stays_pi() -> None:
    assert wrap_angle_rad(-np.pi) == np.pi
    assert wrap_angle_rad(np.pi) == np.pi
