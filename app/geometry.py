"""Frames, rotations and units: the conventions, stated once.

Building frame  right-handed, x and y along the floor plan, **z up**, metres.
Level frame     gravity-levelled, yaw unknown: x forward, y left, z up. `B_building = Rz(heading) B_level`.
Body frame      the sensor's own axes. Quaternions are scalar-first `[w, x, y, z]` and rotate body to building.
Field           microtesla everywhere; other units are converted where bytes become samples, and nowhere else.
Headings        radians, counter-clockwise from the building's +x, in (-pi, pi].
"""

import numpy as np
from numpy.typing import NDArray

__all__ = [
    "UT_PER_GAUSS",
    "UT_PER_MILLIGAUSS",
    "UT_PER_NANOTESLA",
    "Array",
    "horizontal_and_vertical",
    "path_length_m",
    "rotate_by_quaternion",
    "wrap_angle_rad",
    "yaw_matrix",
]

Array = NDArray[np.float64]

UT_PER_NANOTESLA = 1e-3
UT_PER_MILLIGAUSS = 0.1
UT_PER_GAUSS = 100.0


def wrap_angle_rad(angle_rad: Array | float) -> Array:
    """Wrap angles to (-pi, pi]. Any shape."""
    return np.asarray(np.pi - np.mod(np.pi - np.asarray(angle_rad, dtype=np.float64), 2 * np.pi))


def yaw_matrix(heading_rad: float) -> Array:
    """The 3 x 3 rotation Rz(heading) taking level-frame vectors to the building frame."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def path_length_m(p_m: Array) -> Array:
    """(n,) distance walked since the first of positions (n, 2 or 3), along the floor."""
    steps = np.linalg.norm(np.diff(p_m[:, :2], axis=0), axis=1)
    return np.concatenate([[0.0], np.cumsum(steps)])


def rotate_by_quaternion(q_wxyz: Array, v: Array) -> Array:
    """Rotate vectors `v` (n, 3) by unit quaternions `q_wxyz` (n, 4), scalar first: body to building, no loop."""
    w, u = q_wxyz[..., :1], q_wxyz[..., 1:]
    t = 2.0 * np.cross(u, v)
    return np.asarray(v + w * t + np.cross(u, t))


def horizontal_and_vertical(B_uT: Array) -> Array:
    """Heading-free features of field vectors (n, 3), z up: (n, 2) horizontal magnitude and vertical component, uT."""
    return np.stack([np.hypot(B_uT[..., 0], B_uT[..., 1]), B_uT[..., 2]], axis=-1)
