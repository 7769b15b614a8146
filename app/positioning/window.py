"""A window: a short run of magnetometer samples with the displacement walked between them."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from app.geometry import Array

__all__ = ["Composition", "Window", "WindowFrame", "course_yaw_rad"]

WindowFrame = Literal["building", "level", "norm"]
Composition = Literal["raw", "demeaned", "differenced", "feature"]

_COURSE_M = 1.0  # the stretch over which a course is taken


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """`n` samples. A body-frame window is rotated to the building frame before it gets here.

    frame              "building": B and displacement in the building frame
                       "level": both in the level frame of the first sample, yaw (`heading`) unknown or uncertain
                       "norm": B is (n, 1), displacement in the level frame
    B_uT               (n, 3) or (n, 1)
    displacement_m     (n, 3) position of each sample from the first, in `frame` (z may be 0)
    t_s                (n,) or None
    heading_rad, heading_sd_rad    yaw of the first sample's level frame and its sd (None: unknown, searched)
    noise_uT           sd of the sensor's white noise, per axis
    yaw_rad            (n,) yaw of the device at each sample relative to the first sample's level frame, or None
                       (then the device is taken to turn with the path)
    device_to_frame    (n, 3, 3) rotation of the sensor's axes to `frame`, of a window that came in body axes, or None
    """

    frame: WindowFrame
    B_uT: Array
    displacement_m: Array
    noise_uT: float
    t_s: Array | None = None
    heading_rad: float | None = None
    heading_sd_rad: float | None = None
    yaw_rad: Array | None = None
    device_to_frame: Array | None = None


def course_yaw_rad(displacement_m: Array) -> Array:
    """(n,) how far the course has turned since the start, from displacements (n, 2).

    The course is taken over a metre of path around every sample; a device that hardly moves is taken not to turn.
    """
    d = np.asarray(displacement_m, dtype=np.float64)[:, :2]
    path = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(d, axis=0), axis=1))])
    if path[-1] < _COURSE_M:
        return np.zeros(len(d))
    middle = np.clip(path, 0.5 * _COURSE_M, path[-1] - 0.5 * _COURSE_M)
    moved = path > np.concatenate([[-1.0], path[:-1]])  # a place is looked up once, however long it was stood at
    before, after = (
        np.stack([np.interp(middle + side, path[moved], d[moved, axis]) for axis in (0, 1)], axis=1)
        for side in (-0.5 * _COURSE_M, 0.5 * _COURSE_M)
    )
    way = after - before
    course = np.arctan2(way[:, 1], way[:, 0])
    return np.asarray(np.unwrap(course - course[0]))
