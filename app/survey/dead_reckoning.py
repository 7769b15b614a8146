"""What the device alone knows of its motion: attitude, turns, steps, and the path they make."""

from dataclasses import dataclass

import numpy as np

from app.errors import Fault, UnreadableSurvey
from app.geometry import Array
from app.survey.heading import Legs, heading_prior
from app.survey.levelling import (
    gyroscope_yaw,
    level_axes,
    level_axes_yaw,
    rotation_vector_matrices,
    up_from_accelerometer,
)
from app.survey.steps import Steps, detect_steps
from app.survey.traces import Stream, Trace

__all__ = ["Motion", "legs_between", "observe_motion", "reckon"]


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Motion at the times t_s (n,) of the magnetometer.

    level                     (n, 3, 3) body to level frame: rows forward, left, up
    yaw_rad                   (n,) yaw of the level frame since the first sample
    magnetic_less_gyro_rad    (n,) the rotation vector's yaw from East less yaw_rad; None without a rotation vector
    heading_rad, heading_sd_rad    (n,) the device's own belief of its yaw from East, from this and earlier samples
    steps, distance_m         steps, and (n,) the distance walked
    gravity_from, yaw_from    which sensors were used, in words
    """

    t_s: Array
    level: Array
    yaw_rad: Array
    magnetic_less_gyro_rad: Array | None
    heading_rad: Array | None
    heading_sd_rad: Array | None
    steps: Steps
    distance_m: Array
    gravity_from: str
    yaw_from: str


def observe_motion(trace: Trace, t_s: Array) -> Motion:
    """Motion from the inertial sensors of a trace at times t_s (n,). Raises UnreadableSurvey where they are missing."""
    force, rate, rotation = (trace.streams.get(k) for k in ("ACCELEROMETER", "GYROSCOPE", "ROTATION_VECTOR"))
    if force is None or len(force) < 2:
        raise _lacking("TYPE_ACCELEROMETER", "steps and gravity need it")
    if (rate is None or len(rate) < 2) and (rotation is None or len(rotation) < 2):
        raise _lacking("TYPE_GYROSCOPE", "turns need it, or TYPE_ROTATION_VECTOR")
    body_to_enu = rotation_vector_matrices(_nearest(rotation, t_s)) if rotation is not None else None
    rates = rate.at(t_s) if rate is not None else None
    if body_to_enu is not None:
        up, gravity_from = body_to_enu[:, 2, :], "rotation vector"
    else:
        up, gravity_from = up_from_accelerometer(t_s, force.at(t_s), rates), "accelerometer and gyroscope"
    level = level_axes(up)
    enu_yaw = None if body_to_enu is None else level_axes_yaw(body_to_enu, level)
    if rates is not None:
        yaw, yaw_from = gyroscope_yaw(t_s, rates, level), "gyroscope"
    else:
        assert enu_yaw is not None
        yaw, yaw_from = enu_yaw - enu_yaw[0], "rotation vector"
    difference = None if enu_yaw is None else enu_yaw - yaw
    prior = None if difference is None else heading_prior(t_s, difference)
    steps = detect_steps(force.t_s, force.values)
    return Motion(
        t_s=t_s,
        level=level,
        yaw_rad=yaw,
        magnetic_less_gyro_rad=difference,
        heading_rad=None if prior is None else prior[0] + yaw,
        heading_sd_rad=None if prior is None else prior[1],
        steps=steps,
        distance_m=steps.distance_m(t_s),
        gravity_from=gravity_from,
        yaw_from=yaw_from,
    )


def reckon(distance_m: Array, direction_rad: Array) -> Array:
    """(n, 2) path from the distance walked (n,) and the walking direction (n,), from the origin."""
    walked = np.diff(distance_m)
    middle = 0.5 * (direction_rad[1:] + direction_rad[:-1])
    steps = np.stack([walked * np.cos(middle), walked * np.sin(middle)], axis=1)
    return np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])


def legs_between(motion: Motion, waypoint_t_s: Array, waypoint_m: Array) -> Legs:
    """The legs between waypoints (k, 2), by label and by dead reckoning."""
    path = Stream(motion.t_s, reckon(motion.distance_m, motion.yaw_rad)).at(waypoint_t_s)
    middle_s = 0.5 * (waypoint_t_s[1:] + waypoint_t_s[:-1]) - motion.t_s[0]
    return Legs(middle_s, np.diff(waypoint_m, axis=0), np.diff(path, axis=0))


def _nearest(stream: Stream, t_s: Array) -> Array:
    """The stream's value nearest in time: rotation vectors do not interpolate linearly."""
    after = np.clip(np.searchsorted(stream.t_s, t_s), 1, max(len(stream) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(stream) - 1)
    nearer = np.where(t_s - stream.t_s[before] <= stream.t_s[after] - t_s, before, after)
    return stream.values[nearer]


def _lacking(kind: str, why: str) -> UnreadableSurvey:
    return UnreadableSurvey(f"the trace has no {kind} records; {why}", Fault(kind, "no records"))
