"""Angles in the order 3-2-1 against scipy's, their variances against finite differences."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.attitude.euler import LARGEST_RAD2, euler_zyx_rad, euler_zyx_variance_rad2
from app.geometry import wrap_angle_rad

angle = st.floats(-3.1, 3.1)


@given(angle, st.floats(-1.5, 1.5), angle)
def test_angles_come_back(yaw: float, pitch: float, roll: float) -> None:
    q = Rotation.from_euler("ZYX", [[yaw, pitch, roll]]).as_quat(scalar_first=True)
    back = euler_zyx_rad(q)
    assert np.allclose(np.concatenate(back), [yaw, pitch, roll], atol=1e-9)
    assert np.allclose(np.concatenate(euler_zyx_rad(-q)), [yaw, pitch, roll], atol=1e-9)


def test_straight_up_and_down_are_still_the_attitude() -> None:
    for pitch in (np.pi / 2, -np.pi / 2):
        given_ = Rotation.from_euler("ZYX", [[0.7, pitch, -0.4]])
        back = np.concatenate(euler_zyx_rad(given_.as_quat(scalar_first=True)))
        assert back[2] == 0.0
        assert (Rotation.from_euler("ZYX", back) * given_.inv()).magnitude()[0] < 1e-7


def test_variances_follow_finite_differences() -> None:
    rng = np.random.default_rng(3)
    attitude = Rotation.from_euler("ZYX", rng.uniform(-1.2, 1.2, (20, 3)))
    A = rng.normal(size=(20, 3, 3))
    P = 1e-4 * A @ A.transpose(0, 2, 1)
    q, step = attitude.as_quat(scalar_first=True), 1e-6
    slopes = []
    for axis in np.eye(3):
        ahead, behind = ((attitude * Rotation.from_rotvec(s * axis)).as_quat(scalar_first=True) for s in (step, -step))
        slopes.append(wrap_angle_rad(np.stack(euler_zyx_rad(ahead)) - np.stack(euler_zyx_rad(behind))) / (2 * step))
    J = np.stack(slopes, axis=-1)  # (angle, n, axis)
    expected = np.einsum("ani,nij,anj->an", J, P, J)
    assert np.allclose(np.stack(euler_zyx_variance_rad2(q, P)), expected, rtol=1e-5)


def test_nothing_is_known_of_yaw_straight_up() -> None:
    q = Rotation.from_euler("ZYX", [[0.3, np.pi / 2, 0.0]]).as_quat(scalar_first=True)
    yaw, pitch, roll = euler_zyx_variance_rad2(q, 1e-4 * np.eye(3)[None])
    assert yaw[0] == roll[0] == LARGEST_RAD2
    assert pitch[0] <= 1e-4
