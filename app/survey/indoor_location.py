"""`indoor-location-2020`: traces of the Indoor Location Competition 2.0, an Android phone carried between waypoints.

Up from the phone, yaw from the gyroscope with one offset per walk, positions from detected steps between waypoints, and
the field from the raw magnetometer less the phone's own bias. What was assumed is in the walk's report.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from app.errors import Fault, UnreadableSurvey
from app.field.samples import Samples
from app.geometry import Array
from app.survey.columns import check_sample_count
from app.survey.dead_reckoning import Motion, legs_between, observe_motion, reckon
from app.survey.heading import YawOffset, infer_yaw_offset
from app.survey.levelling import attitude_quaternions
from app.survey.quality import describe_samples, sample_warnings
from app.survey.trace_report import trace_report
from app.survey.traces import Stream, Trace, parse_trace
from app.survey.units import field_faults
from app.survey.walk import DeadReckoning, Walk
from app.survey.waypoints import label_positions

__all__ = ["DEVICE_HEIGHT_M", "read_indoor_location"]

DEVICE_HEIGHT_M = 1.2
"""A phone held in front of the chest, above the floor's slab: an assumption, the format does not say."""
TARGET_RATE_HZ = 12.5
BIAS_SD_UT = 8.0
"""Sd per axis of the hard iron left after the phone's own bias is subtracted, for one session nothing is known of."""
FEWEST_SAMPLES = 20


@dataclass(frozen=True, slots=True, eq=False)
class _Magnetometer:
    """Times, field in the body frame with the phone's bias subtracted, and where that bias came from."""

    t_s: Array
    B_body_uT: Array
    session: str | None
    bias_uT: Array | None
    bias_changes: int


def read_indoor_location(
    data: bytes, session: str | None = None, correct: Callable[[Array], Array] | None = None
) -> Walk:
    """Read one trace. Raises UnreadableSurvey with line and reason, TooLarge.

    `correct` is a calibration of the phone's raw channel, in place of the phone's own bias, and `session` its label.
    """
    trace = parse_trace(data)
    waypoints = _waypoints(trace)
    magnetometer = _magnetometer(trace, session, correct)
    kept = _between_waypoints(magnetometer.t_s, waypoints)
    t_s = magnetometer.t_s[kept]
    start_s = t_s[0]
    motion = observe_motion(trace, t_s)
    B_level_uT = np.einsum("nij,nj->ni", motion.level, magnetometer.B_body_uT[kept])
    legs = legs_between(motion, waypoints.t_s, waypoints.values)
    offset = infer_yaw_offset(t_s - start_s, motion.magnetic_less_gyro_rad, legs)
    p_m = _positions(motion, offset, waypoints)
    yaw = motion.yaw_rad + offset.offset_rad + offset.drift_rad_per_s * (t_s - start_s)
    B_building_uT = _turned(B_level_uT, yaw)
    groups = _Groups(len(t_s), max(1, round(1.0 / (float(np.median(np.diff(t_s))) * TARGET_RATE_HZ))))
    samples = Samples(
        t_s=groups.mean(t_s) - start_s,
        p_building_m=np.column_stack([groups.mean(p_m), np.full(groups.count, DEVICE_HEIGHT_M)]),
        B_uT=groups.mean(B_building_uT),
        frame="building",
        q_body_to_building=attitude_quaternions(motion.level[groups.middle], yaw[groups.middle]),
        session=magnetometer.session,
    )
    report: dict[str, object] = {
        "format": "indoor-location-2020",
        **describe_samples(samples),
        **trace_report(
            trace=trace,
            motion=motion,
            legs=legs,
            offset=offset,
            waypoints=waypoints,
            thinned=groups.size,
            device_height_m=DEVICE_HEIGHT_M,
            session=magnetometer.session,
            bias_uT=magnetometer.bias_uT,
            bias_changes=magnetometer.bias_changes,
            corrected=correct is not None,
        ),
    }
    warnings = report["warnings"]
    assert isinstance(warnings, list)
    warnings += sample_warnings(samples)
    return Walk(samples, report, _dead_reckoning(motion, B_level_uT, groups))


def _waypoints(trace: Trace) -> Stream:
    waypoints = trace.streams.get("WAYPOINT")
    if waypoints is None or len(waypoints) < 2:
        found = 0 if waypoints is None else len(waypoints)
        raise UnreadableSurvey(
            f"the trace has {found} waypoint{'s' * (found != 1)}, and positions need two at least: "
            f"tap a TYPE_WAYPOINT at the start and at the end of the walk",
            Fault("TYPE_WAYPOINT", f"{found} records"),
        )
    far = np.flatnonzero(np.abs(waypoints.values).max(axis=1) > 10_000.0)
    if len(far):
        x, y = waypoints.values[far[0]]
        raise UnreadableSurvey(
            f"waypoint {far[0] + 1} at ({x:,.6g}, {y:,.6g}) m is not on a floor plan; "
            f"give metres from the plan's corner",
            Fault(f"TYPE_WAYPOINT {far[0] + 1}", "farther than 10,000 m from the origin"),
        )
    return waypoints


def _magnetometer(trace: Trace, session: str | None, correct: Callable[[Array], Array] | None) -> _Magnetometer:
    """The raw field as calibrated, or less the phone's own bias where the trace has both, else the phone's field."""
    raw, calibrated = trace.streams.get("MAGNETIC_FIELD_UNCALIBRATED"), trace.streams.get("MAGNETIC_FIELD")
    if correct is not None and raw is None:
        raise UnreadableSurvey(
            "the calibration cannot be applied: the trace has no TYPE_MAGNETIC_FIELD_UNCALIBRATED, and the phone took "
            "a bias of its own off the rest",
            Fault("calibration", "no raw channel"),
        )
    stream = raw or calibrated
    if stream is None or len(stream) < FEWEST_SAMPLES:
        found = 0 if stream is None else len(stream)
        raise UnreadableSurvey(
            f"the trace has {found} magnetometer samples, a walk needs {FEWEST_SAMPLES} at least",
            Fault("TYPE_MAGNETIC_FIELD", f"{found} records"),
        )
    check_sample_count(len(stream))
    if correct is not None:
        magnetometer = _Magnetometer(stream.t_s, correct(stream.values[:, :3]), session, None, 0)
    elif raw is None:
        magnetometer = _Magnetometer(stream.t_s, stream.values, None, None, 0)
    else:
        triples, counts = np.unique(raw.values[:, 3:], axis=0, return_counts=True)
        bias_uT = triples[np.argmax(counts)]
        changes = int(np.sum(np.any(np.diff(raw.values[:, 3:], axis=0) != 0.0, axis=1)))
        session = ",".join(f"{x:.4f}" for x in bias_uT)
        magnetometer = _Magnetometer(raw.t_s, raw.values[:, :3] - bias_uT, session, bias_uT, changes)
    message, faults = field_faults(
        np.linalg.norm(magnetometer.B_body_uT, axis=1), lambda i: f"magnetometer record {i + 1}"
    )
    if message:
        raise UnreadableSurvey(message, *faults)
    return magnetometer


def _between_waypoints(t_s: Array, waypoints: Stream) -> Array:
    """Mask of the samples between the first and the last waypoint: elsewhere there is no label."""
    kept = (t_s >= waypoints.t_s[0]) & (t_s <= waypoints.t_s[-1])
    if kept.sum() < FEWEST_SAMPLES:
        raise UnreadableSurvey(
            f"only {int(kept.sum())} magnetometer samples lie between the first and the last waypoint, "
            f"{FEWEST_SAMPLES} are needed; was the recording cut?",
            Fault("TYPE_WAYPOINT", "too few samples between waypoints"),
        )
    return np.asarray(kept)


def _positions(motion: Motion, offset: YawOffset, waypoints: Stream) -> Array:
    """(n, 2) labels: dead reckoning turned to the walking direction, bent to the waypoints."""
    walking = offset.offset_rad + (offset.holding_rad or 0.0) + offset.drift_rad_per_s * (motion.t_s - motion.t_s[0])
    reckoned_m = reckon(motion.distance_m, motion.yaw_rad + walking)
    at_s = np.clip(waypoints.t_s, motion.t_s[0], motion.t_s[-1])
    at_s, first = np.unique(at_s, return_index=True)
    return label_positions(motion.t_s, reckoned_m, motion.distance_m, at_s, waypoints.values[first])


def _turned(B_level_uT: Array, yaw_rad: Array) -> Array:
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    x, y, z = B_level_uT.T
    return np.column_stack([c * x - s * y, s * x + c * y, z])


def _dead_reckoning(motion: Motion, B_level_uT: Array, groups: "_Groups") -> DeadReckoning:
    middle = groups.middle
    yaw = motion.yaw_rad
    turned = groups.mean(_turned(B_level_uT, yaw))
    p_m = groups.mean(reckon(motion.distance_m, yaw))
    displacement = np.column_stack([p_m - p_m[0], np.zeros(groups.count)])
    yaw_0 = yaw[middle][0]
    return DeadReckoning(
        displacement_m=_turned(displacement, np.full(groups.count, -yaw_0)),
        yaw_rad=yaw[middle] - yaw_0,
        B_level_uT=_turned(turned, -yaw[middle]),
        q_body_to_level=attitude_quaternions(motion.level[middle], np.zeros(groups.count)),
        step_t_s=motion.steps.end_s - motion.t_s[0],
        step_length_m=motion.steps.length_m,
        heading_rad=None if motion.heading_rad is None else motion.heading_rad[middle],
        heading_sd_rad=None if motion.heading_sd_rad is None else motion.heading_sd_rad[middle],
        bias_sd_uT=BIAS_SD_UT,
    )


class _Groups:
    """Neighbouring samples taken together: the sensor repeats itself, the field changes over metres."""

    def __init__(self, n: int, size: int) -> None:
        self.size = size
        self.count = n // size
        self.middle = np.arange(self.count) * size + size // 2

    def mean(self, values: Array) -> Array:
        """Means over each group of values (n, ...)."""
        whole = values[: self.count * self.size]
        return np.asarray(whole.reshape(self.count, self.size, *values.shape[1:]).mean(axis=1))
