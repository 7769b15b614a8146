"""A step as it was sent -> a step as it is followed: the same on the way in, after a restart and in a replay."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from app.attitude.options import InertialSamples
from app.calibration.sensor_model import SensorModel
from app.geometry import Array, rotate_by_quaternion
from app.services.step_order import RawStep
from app.services.track_spec import StepKind
from app.tracking.step import Step

__all__ = ["INERTIAL", "core_step"]

INERTIAL = ("gyro_rad_per_s", "accelerometer_m_per_s2", "magnetometer_ut")
"""Columns of a step's inertial samples."""


def core_step(raw: RawStep, kind: StepKind) -> Step:
    """A body step is calibrated, and turned to the core's frame, here; its orientation is one of nearly unit length."""
    told, frame, calibration = raw.get("b_ut"), kind.frame, kind.calibration
    B = None if told is None else np.atleast_1d(np.asarray(told, dtype=np.float64))
    if B is not None and calibration is not None:
        B = calibration.apply(B)
    device_to_frame, B_body = None, None
    if frame == "body" and raw.get("orientation") is not None:
        q = np.asarray(raw["orientation"], dtype=np.float64)
        q = q / np.linalg.norm(q)
        device_to_frame = rotate_by_quaternion(np.repeat(q[None], 3, axis=0), np.eye(3)).T
        if B is not None:
            B = rotate_by_quaternion(q[None], B[None])[0]
    elif frame == "body":
        B, B_body = None, B
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
        inertial=None if raw.get("inertial") is None else _inertial(raw["inertial"], calibration),
        B_body_uT=B_body,
    )


def _inertial(told: Mapping[str, Any], calibration: SensorModel | None) -> InertialSamples:
    """Samples, NaN where a sensor has none, the magnetometer calibrated. Raises InvalidInput."""
    t_s = np.asarray(told["t_s"], dtype=np.float64)
    columns = [_rows(told.get(name), len(t_s)) for name in INERTIAL]
    if calibration is not None:
        columns[2] = calibration.apply(columns[2])
    return InertialSamples(t_s, *columns)


def _rows(rows: Sequence[Sequence[float] | None] | None, n: int) -> Array:
    nothing = [np.nan] * 3
    told = [nothing] * n if rows is None else [nothing if row is None else row for row in rows]
    return np.array(told, dtype=np.float64).reshape(-1, 3)
