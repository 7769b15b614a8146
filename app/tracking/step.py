"""A step: what a device knows about itself since its last step, and what it measured there."""

from dataclasses import dataclass

from app.attitude.options import InertialSamples
from app.geometry import Array

__all__ = ["Step"]


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """One step of a track. A body-frame step is rotated before it gets here.

    The track's frame is the building's ("building"), or the level frame of the track's first step ("level", "norm").

    number             counts from zero; a step of a number that was followed already is not followed again
    t_s                seconds; does not decrease
    B_uT               (3,) in the track's frame, (1,) of "norm", or None: nothing was measured
    displacement_m     (3,) where the device is by its own reckoning, from the first step, in the track's frame; None:
                       it does not know how it moves
    yaw_rad            of the device since the first step (None: it turns with the path)
    device_to_frame    (3, 3) rotation of the sensor's axes to the track's frame, or None: level, turned by yaw_rad
    inertial           samples since the step before, for the track's own attitude (None: there are none)
    B_body_uT          (3,) the reading in the sensor's axes, to be turned by that attitude; B_uT is None then
    heading_rad, heading_sd_rad   yaw of the track's frame in the building as the device believes it now (None: unknown)
    """

    number: int
    t_s: float
    B_uT: Array | None
    displacement_m: Array | None
    yaw_rad: float | None = None
    device_to_frame: Array | None = None
    heading_rad: float | None = None
    heading_sd_rad: float | None = None
    inertial: InertialSamples | None = None
    B_body_uT: Array | None = None
