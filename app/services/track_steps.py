"""A step as it was sent -> a step as it is followed: the same on the way in, after a restart and in a replay."""

import numpy as np

from app.calibration.sensor_model import SensorModel
from app.geometry import rotate_by_quaternion
from app.services.step_order import RawStep
from app.tracking.step import Step

__all__ = ["core_step"]


def core_step(raw: RawStep, frame: str, calibration: SensorModel | None = None) -> Step:
    """A body step is calibrated, and turned to the core's frame, here; its orientation is one of nearly unit length."""
    told = raw.get("b_ut")
    B = None if told is None else np.atleast_1d(np.asarray(told, dtype=np.float64))
    if B is not None and calibration is not None:
        B = calibration.apply(B)
    device_to_frame = None
    if frame == "body" and raw.get("orientation") is not None:
        q = np.asarray(raw["orientation"], dtype=np.float64)
        q = q / np.linalg.norm(q)
        device_to_frame = rotate_by_quaternion(np.repeat(q[None], 3, axis=0), np.eye(3)).T
        if B is not None:
            B = rotate_by_quaternion(q[None], B[None])[0]
    displacement = raw.get("displacement_m")
    return Step(
        number=raw["number"],
        t_s=raw["t_s"],
        B_uT=B,
        displacement_m=None if displacement is None else np.asarray(displacement, dtype=np.float64),
        yaw_rad=raw.get("yaw_rad"),
        device_to_frame=device_to_frame,
        heading_rad=raw.get("heading_rad"),
        heading_sd_rad=raw.get("heading_sd_rad"),
    )
