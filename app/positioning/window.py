"""A window: a short run of magnetometer samples with the displacement walked between them."""

from dataclasses import dataclass
from typing import Literal

from app.geometry import Array

__all__ = ["Composition", "Window", "WindowFrame"]

WindowFrame = Literal["building", "level", "norm"]
Composition = Literal["raw", "demeaned"]


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
    """

    frame: WindowFrame
    B_uT: Array
    displacement_m: Array
    noise_uT: float
    t_s: Array | None = None
    heading_rad: float | None = None
    heading_sd_rad: float | None = None
    yaw_rad: Array | None = None
