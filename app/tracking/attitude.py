"""A track's attitude: inertial samples followed step after step, against the map where the track believes it is.

The filter is `app.attitude.mekf`; here is its reference. Of kind "map" there is none until the track has converged, and
yaw is not known before that; of kind "constant" it is one vector, as the Earth's; of kind "none" yaw counts from the
first step, and turns readings in the device's axes to the level frame of that step.
"""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from scipy.spatial.transform import Rotation

from app.attitude.mekf import AttitudeState, begin, follow_attitude
from app.attitude.options import AttitudeOptions, InertialSamples
from app.attitude.reference import MagneticReference, constant_reference, grid_reference
from app.geometry import Array
from app.tracking.estimate import Estimate
from app.tracking.step import Step

if TYPE_CHECKING:
    from app.tracking.track_state import Tracker, TrackState

__all__ = ["Attitude", "AttitudeReference", "oriented"]


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeReference:
    """What a track's magnetometer is compared with: of kind "constant" B_uT (3,) in the building frame, sd per axis."""

    kind: Literal["none", "constant", "map"]
    B_uT: Array | None = None
    sd_uT: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Attitude:
    """After a step: q (4,), of kind none to the level frame of the first step, else to the building; covariance (3, 3)
    of its error about the body's axes; and whether the last reading was disturbed (None: there was none)."""

    q_body_to_frame: Array
    covariance_rad2: Array
    disturbed: bool | None


def oriented(
    tracker: "Tracker", state: "TrackState", step: Step, estimate: Estimate | None
) -> tuple[Step, "TrackState"]:
    """The step with its readings turned, and the state with the attitude after the step's inertial samples.

    `estimate` is of the step before. Samples that are not later than those before count for nothing, and there is no
    attitude before the accelerometer's first reading.
    """
    if step.inertial is None or tracker.attitude is None:
        return step, state
    samples = _later(step.inertial, state.attitude)
    if not len(samples) or (state.attitude is None and not np.isfinite(samples.accelerometer_m_per_s2).all(1).any()):
        return step, state
    compared = _reference(tracker, state, estimate)
    options = AttitudeOptions(speed_m_per_s=max(AttitudeOptions().speed_m_per_s, tracker.options.speed_m_s))
    before = state.attitude or begin(samples, compared, options)
    after, run = follow_attitude(before, samples, compared, options)
    read = np.flatnonzero(np.isfinite(samples.magnetometer_uT).all(axis=1))
    attitude = Attitude(
        run.q_body_to_building[-1], run.covariance_rad2[-1], bool(run.disturbed[read[-1]]) if len(read) else None
    )
    state = replace(state, attitude=after, turned=attitude)
    if step.B_body_uT is None:
        return step, state
    turn = Rotation.from_quat(attitude.q_body_to_frame, scalar_first=True).as_matrix()
    return replace(step, B_uT=turn @ step.B_body_uT, device_to_frame=turn), state


def _later(samples: InertialSamples, before: AttitudeState | None) -> InertialSamples:
    """The samples that come after those that were followed."""
    if before is None or np.isnan(before.t_s) or samples.t_s[0] > before.t_s:
        return samples
    kept = samples.t_s > before.t_s
    return InertialSamples(
        samples.t_s[kept], samples.gyro_rad_per_s[kept], samples.accelerometer_m_per_s2[kept],
        samples.magnetometer_uT[kept],
    )  # fmt: skip


def _reference(tracker: "Tracker", state: "TrackState", estimate: Estimate | None) -> MagneticReference | None:
    told = tracker.attitude
    assert told is not None
    if told.kind == "none":
        return None
    if told.kind == "constant":
        assert told.B_uT is not None
        return constant_reference(told.B_uT, told.sd_uT)
    if estimate is None or state.state != "converged":
        return MagneticReference(np.full(3, np.nan), 0.0)
    grid = tracker.floors[estimate.floor].grid
    return grid_reference(grid, np.array([estimate.position_m]), estimate.covariance_m2)
