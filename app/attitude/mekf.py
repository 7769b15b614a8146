"""The multiplicative extended Kalman filter: begin, then follow samples in chunks of any size (Kuevor, B20).

    state = begin(samples, reference, options)
    state, run = follow_attitude(state, samples, reference, options)

Frames are z-up and quaternions scalar-first, body to building; the source has z down and scalar last. Its equations
hold with the corrections of Part 4 (4.5, 4.6): one time index, squared sigmas. Beyond the source: the map's variance
and the place's, gates, Joseph's form, velocity, a learned field and hard iron (`kernel`).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from app.attitude import layout
from app.attitude.kernel import run
from app.attitude.options import AttitudeOptions, InertialSamples, tuning_of
from app.attitude.reference import MagneticReference
from app.errors import Fault, InvalidInput
from app.geometry import Array

__all__ = ["AttitudeRun", "AttitudeState", "begin", "follow_attitude"]

START_S = 0.3
START_TILT_RAD = 0.1
MOVING_TILT_RAD = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeState:
    """All that is kept between chunks: four arrays of float64, to be stored as they are.

    q_body_to_building (4,); mean (12,): gyro bias rad/s, velocity m/s, learned field and hard iron uT;
    joint_covariance (15, 15) of attitude error (rad, body's axes) and of `mean`; kept (layout.KEPT,): times, smoothed
    readings, how long rejected. Where the field is learned, yaw is in the filter's own frame: take it from the run.
    """

    q_body_to_building: Array
    mean: Array
    joint_covariance: Array
    kept: Array

    @property
    def t_s(self) -> float:
        """Of the last sample; not a number before the first."""
        return float(self.kept[layout.T])

    @property
    def gyro_bias_rad_per_s(self) -> Array:
        """(3,)."""
        return self.mean[:3]

    @property
    def field_uT(self) -> Array:
        """(3,) the learned field, in the filter's own frame."""
        return self.mean[6:9]

    @property
    def hard_iron_uT(self) -> Array:
        """(3,) the device's own field, body's axes."""
        return self.mean[9:12]

    @property
    def covariance(self) -> Array:
        """(6, 6) of attitude error and gyro bias, as the source has it: rad, rad/s. Yaw unknown until north is set."""
        P = self.joint_covariance[:6, :6].copy()
        if self.kept[layout.NORTH_SET] < 1.0:
            up = Rotation.from_quat(self.q_body_to_building, scalar_first=True).as_matrix()[2]
            P[:3, :3] += layout.UNKNOWN_YAW_RAD2 * np.outer(up, up)
        return P


@dataclass(frozen=True, slots=True, eq=False)
class AttitudeRun:
    """What was known after every sample.

    q_body_to_building (n, 4); covariance_rad2 (n, 3, 3) of the attitude error about the body's axes;
    gyro_bias_rad_per_s (n, 3); magnetometer_used, accelerometer_used, disturbed (n,): the field does not fit.
    """

    q_body_to_building: Array
    covariance_rad2: Array
    gyro_bias_rad_per_s: Array
    magnetometer_used: NDArray[np.bool_]
    disturbed: NDArray[np.bool_]
    accelerometer_used: NDArray[np.bool_]


def begin(
    samples: InertialSamples, reference: MagneticReference | None, options: AttitudeOptions | None = None
) -> AttitudeState:
    """The state before the first of these samples: levelled by their first accelerometer readings, yaw unknown.

    `follow_attitude` sets yaw by the first third of a second of readings that have a reference, wherever in the stream
    they come (TRIAD's answer: gravity is believed first), and tells it as unknown until then. A reference that is
    checked here is refused before anything is followed. Raises InvalidInput where no accelerometer reading is finite.
    """
    options = options or AttitudeOptions()
    tuning_of(options)
    if reference is not None:
        reference.rows(len(samples))
    finite = np.isfinite(samples.accelerometer_m_per_s2).all(axis=1)
    if not finite.any():
        message = "no accelerometer reading is finite: gravity is needed to begin"
        raise InvalidInput(message, Fault("/accelerometer_m_per_s2", "all missing"))
    first_s = samples.t_s[np.argmax(finite)]
    force = samples.accelerometer_m_per_s2[finite & (samples.t_s <= first_s + START_S)]
    mean = force.mean(axis=0)
    size = float(np.linalg.norm(mean))
    if size == 0.0:
        raise InvalidInput("the accelerometer reads nothing", Fault("/accelerometer_m_per_s2", "zero"))
    off = abs(size / options.gravity_m_per_s2 - 1.0) + float(force.std(axis=0).max()) / options.gravity_m_per_s2
    tilt_rad = START_TILT_RAD if off < 0.05 else MOVING_TILT_RAD
    q = _levelled(mean / size)
    R = Rotation.from_quat(q, scalar_first=True).as_matrix()
    P = np.zeros((layout.SIZE, layout.SIZE))
    P[:3, :3] = R.T @ np.diag([tilt_rad**2, tilt_rad**2, 0.0]) @ R
    sds = [options.gyro_bias_rad_per_s, options.speed_m_per_s if options.translation == "bounded" else 0.0, 0.0,
           options.hard_iron_uT]  # fmt: skip
    P[3:, 3:] = np.diag(np.square(np.repeat(sds, 3)))
    kept = np.zeros(layout.KEPT)
    kept[[layout.T, layout.T_GYRO, layout.T_FORCE, layout.T_MAG, layout.NORTH]] = np.nan
    kept[layout.STILL_S] = kept[layout.DISTURBANCE] = -1.0
    kept[layout.GRAVITY] = size if off < 0.05 else options.gravity_m_per_s2
    return AttitudeState(q, np.zeros(layout.SIZE - 3), P, kept)


def _levelled(up_body: Array) -> Array:
    """(4,) the attitude in which a unit vector of the body points up, its x axis in the building's x-z plane."""
    x_body = np.eye(3)[np.argmin(np.abs(up_body))] if abs(up_body[0]) > 0.99 else np.array([1.0, 0.0, 0.0])
    y = np.cross(up_body, x_body)
    y /= np.linalg.norm(y)
    rows = np.stack([np.cross(y, up_body), y, up_body])
    return np.asarray(Rotation.from_matrix(rows).as_quat(scalar_first=True))


def follow_attitude(
    state: AttitudeState,
    samples: InertialSamples,
    reference: MagneticReference | None,
    options: AttitudeOptions | None = None,
) -> tuple[AttitudeState, AttitudeRun]:
    """Read samples, later than those before, and say what is known after each. The state given is left as it is.

    Cut into chunks the samples give the same numbers to the last bit. Raises InvalidInput where the first sample is not
    later than the last of the state, or the reference's shape does not fit.
    """
    tuning = tuning_of(options or AttitudeOptions())
    n = len(samples)
    if n and samples.t_s[0] <= state.kept[layout.T]:
        message = f"the first sample is at {samples.t_s[0]} s, the state at {state.kept[layout.T]} s: send later ones"
        raise InvalidInput(message, Fault("/t_s/0", "not later than the state"))
    rows, variance = (np.zeros((1, 3)), np.zeros((1, 3, 3))) if reference is None else reference.rows(n)
    arrays = tuple(each.copy() for each in (state.q_body_to_building, state.mean, state.joint_covariance, state.kept))
    out = (np.empty((n, 4)), np.empty((n, 3, 3)), np.empty((n, 3)), np.zeros((n, 3), dtype=np.bool_))
    learned = reference is not None and reference.B_uT is None
    streams = (samples.t_s, samples.gyro_rad_per_s, samples.accelerometer_m_per_s2, samples.magnetometer_uT)
    t, gyro, force, field = (np.ascontiguousarray(each, dtype=np.float64) for each in streams)
    q, mean, P, kept = arrays
    run(q, mean, P, kept, t, gyro, force, field, rows, variance, reference is not None, learned, tuning, out)
    used, disturbed, accelerometer = out[3].T
    return AttitudeState(q, mean, P, kept), AttitudeRun(out[0], out[1], out[2], used, disturbed, accelerometer)
