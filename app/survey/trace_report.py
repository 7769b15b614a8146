"""The quality of a phone's walk, and everything its reader assumed, as plain JSON for the survey's report."""

from typing import Any

import numpy as np

from app.geometry import Array, wrap_angle_rad
from app.survey.dead_reckoning import Motion
from app.survey.heading import Legs, YawOffset
from app.survey.steps import STEP_LENGTH_FACTOR
from app.survey.traces import Stream, Trace

__all__ = ["trace_report"]

SLOW_WAYPOINTS_S = 30.0


def trace_report(
    *,
    trace: Trace,
    motion: Motion,
    legs: Legs,
    offset: YawOffset,
    waypoints: Stream,
    thinned: int,
    device_height_m: float,
    session: str | None,
    bias_uT: Array | None,
    bias_changes: int,
    corrected: bool,
) -> dict[str, object]:
    """Sections `device`, `assumptions`, `warnings` and `quality` of the report."""
    return {
        "device": trace.header,
        "session": session,
        "assumptions": _assumptions(motion, offset, thinned, device_height_m, bias_uT, corrected),
        "warnings": [*trace.warnings, *_warnings(motion, legs, offset, waypoints, session, bias_changes)],
        "quality": {
            **_path_quality(motion, legs),
            **_yaw_quality(motion, legs, offset),
            "bias_ut": None if bias_uT is None else [_round(x) for x in bias_uT],
            "bias_changes": bias_changes,
            "waypoints": len(waypoints),
            "waypoint_interval_s": {
                "median": _round(np.median(np.diff(waypoints.t_s))),
                "longest": _round(np.max(np.diff(waypoints.t_s))),
            },
        },
    }


def _assumptions(
    motion: Motion, offset: YawOffset, thinned: int, height_m: float, bias_uT: Array | None, corrected: bool
) -> list[str]:
    found = [
        "the floor plan's x points East and y North (any turn of the plan is left in the yaw offset)",
        f"the device was carried {height_m:g} m above the floor",
        f"up is from the {motion.gravity_from}, the shape of the yaw from the {motion.yaw_from}",
        f"one yaw offset for the whole walk, known to {np.degrees(offset.sd_rad):.0f} degrees (1 sd)",
        f"positions follow detected steps between waypoints; a step is {STEP_LENGTH_FACTOR:g} m times the fourth root "
        f"of the range of its acceleration",
        "waypoints are right to 0.5 m (1 sd)",
    ]
    if corrected:
        found.append("the field is the phone's raw channel, corrected by the device's calibration")
    elif bias_uT is None:
        found.append("the calibrated magnetometer channel is used; its bias may jump when the phone recalibrates")
    else:
        found.append("the field is the uncalibrated channel less the phone's own bias, one bias for the whole walk")
    if thinned > 1:
        found.append(
            f"{thinned} neighbouring samples were averaged: the sensor repeats values, the field varies over metres"
        )
    return found


def _warnings(
    motion: Motion, legs: Legs, offset: YawOffset, waypoints: Stream, session: str | None, bias_changes: int
) -> list[str]:
    found = []
    if not len(motion.steps):
        found.append("no steps were detected: positions between waypoints are spread evenly over time")
    if motion.magnetic_less_gyro_rad is None and not legs.long_enough().any():
        found.append("nothing tells the yaw of this walk: its horizontal field is of no use")
    elif motion.magnetic_less_gyro_rad is None:
        found.append("no TYPE_ROTATION_VECTOR: the yaw is from the walking direction alone")
    if not offset.agree:
        found.append(
            "the walking direction disagrees with the phone's compass; the phone was probably not held along the way, "
            "and the compass was believed"
        )
    if session is None:
        found.append("no TYPE_MAGNETIC_FIELD_UNCALIBRATED: the calibration session is unknown")
    if bias_changes:
        found.append(f"the phone changed its bias {bias_changes} times; the one used longest was subtracted throughout")
    longest_s = float(np.max(np.diff(waypoints.t_s)))
    if longest_s > SLOW_WAYPOINTS_S:
        found.append(f"{longest_s:.0f} s passed between two waypoints: positions there are uncertain")
    return found


def _path_quality(motion: Motion, legs: Legs) -> dict[str, object]:
    """Steps and the scale of dead reckoning against the labels."""
    usable = legs.long_enough()
    scale = np.linalg.norm(legs.reckoned_m[usable], axis=1) / np.linalg.norm(legs.label_m[usable], axis=1)
    duration_s = float(motion.t_s[-1] - motion.t_s[0])
    return {
        "steps": len(motion.steps),
        "steps_per_s": _round(len(motion.steps) / duration_s),
        "reckoned_length_m": _round(motion.distance_m[-1] - motion.distance_m[0]),
        "legs": int(usable.sum()),
        "leg_scale_median": _round(np.median(scale)) if len(scale) else None,
        "leg_scale_spread": _round(np.std(np.log(scale))) if len(scale) > 1 else None,
    }


def _yaw_quality(motion: Motion, legs: Legs, offset: YawOffset) -> dict[str, object]:
    """The yaw offset and how far its witnesses scatter."""
    usable = legs.long_enough()
    turn = legs.turn_rad()[usable]
    spread = None
    if len(turn) > 1:
        centred = np.degrees(wrap_angle_rad(turn - np.angle(np.sum(np.exp(1j * turn)))))
        spread = _round(np.std(centred))
    difference = motion.magnetic_less_gyro_rad
    swing = None
    if difference is not None:
        low, high = np.percentile(np.unwrap(difference), [2.5, 97.5])
        swing = _round(np.degrees(high - low))
    return {
        "yaw_offset_deg": _round(np.degrees(offset.offset_rad)),
        "yaw_offset_sd_deg": _round(np.degrees(offset.sd_rad)),
        "gyroscope_drift_deg_per_s": _round(np.degrees(offset.drift_rad_per_s)),
        "holding_deg": None if offset.holding_rad is None else _round(np.degrees(offset.holding_rad)),
        "leg_heading_residual_sd_deg": spread,
        "rotation_vector_swing_deg": swing,
    }


def _round(x: float | np.floating[Any]) -> float:
    return round(float(x), 4)
