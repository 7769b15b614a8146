"""What a device carried along a synthetic walk would have recorded: surveys and windows, with honest errors."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from app.field.samples import Samples
from app.geometry import Array, rotate_by_quaternion, wrap_angle_rad, yaw_matrix
from app.positioning.window import Window, WindowFrame
from app.synthetic.building import SyntheticBuilding
from app.synthetic.noise import ornstein_uhlenbeck
from app.synthetic.walks import SyntheticWalk

__all__ = ["Magnetometer", "Pose", "survey", "survey_csv", "window"]


@dataclass(frozen=True, slots=True)
class Magnetometer:
    """A magnetometer and the device that carries it. Angles and labels err as Ornstein-Uhlenbeck processes.

    noise_uT                     sd of white noise, per axis
    hard_iron_uT                 constant offset in the body frame
    distortion                   what turns the true field into the read one before that: scales, soft iron, a rotation
    tilt_sd_rad, yaw_sd_rad      error of the attitude the device believes: roll and pitch, and yaw
    attitude_correlation_s       correlation time of those errors
    position_sd_m                error of a survey's position labels, per axis
    position_correlation_m       length along the path over which that error persists
    step_scale_sd, step_noise_m  a window's displacement: scale error of the whole, white noise per square root of metre
    """

    noise_uT: float = 0.4
    hard_iron_uT: tuple[float, float, float] = (0.0, 0.0, 0.0)
    distortion: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    tilt_sd_rad: float = 0.0
    yaw_sd_rad: float = 0.0
    attitude_correlation_s: float = 10.0
    position_sd_m: float = 0.0
    position_correlation_m: float = 5.0
    step_scale_sd: float = 0.0
    step_noise_m: float = 0.0


class Pose(NamedTuple):
    """Where a device truly is: `position_m` (3,) in the building frame and `heading_rad`, on floor number `floor`."""

    floor: int
    position_m: Array
    heading_rad: float


def survey(building: SyntheticBuilding, walk: SyntheticWalk, sensor: Magnetometer, rng: np.random.Generator) -> Samples:
    """The survey of a walk as the device believes it: positions, attitude and field in the building frame."""
    B_body = _measured_body_uT(building, walk.p_building_m, walk.heading_rad, sensor, rng)
    q = _believed_attitude(walk.heading_rad, _attitude_error_rad(walk.t_s, sensor, rng))
    labels = walk.p_building_m.copy()
    labels[:, :2] += ornstein_uhlenbeck(
        rng, walk.path_length_m(), sensor.position_sd_m, sensor.position_correlation_m, 2
    )
    return Samples(walk.t_s, labels, rotate_by_quaternion(q, B_body), "building", q_body_to_building=q)


def survey_csv(samples: Samples, *, body: bool = False) -> bytes:
    """The canonical CSV of a survey in the building frame; with `body`, the field in the body frame and quaternions."""
    header = "t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut"
    columns = [samples.t_s[:, None], samples.p_building_m, samples.B_uT]
    if body:
        assert samples.q_body_to_building is not None
        q = samples.q_body_to_building
        columns = [*columns[:2], rotate_by_quaternion(q * [1.0, -1.0, -1.0, -1.0], samples.B_uT), q]
        header += ",qw,qx,qy,qz"
    rows = (",".join(f"{value:.9g}" for value in row) for row in np.hstack(columns))
    return ("\n".join([header, *rows]) + "\n").encode()


def window(
    building: SyntheticBuilding,
    walk: SyntheticWalk,
    sensor: Magnetometer,
    rng: np.random.Generator,
    *,
    length_m: float,
    samples: int,
    frame: WindowFrame = "level",
) -> tuple[Window, Pose]:
    """A window of `samples` equally spaced over `length_m` of the walk, ending anywhere, and where it truly ends.

    In the level and norm frames the heading is unknown; in the building frame the believed attitude is used. Sampled
    from the true path by interpolation. `length_m` must not exceed the walk's.
    """
    t, p, heading = _stretch(walk, rng, length_m, samples)
    B_body = _measured_body_uT(building, p, heading, sensor, rng)
    error = _attitude_error_rad(t, sensor, rng)
    if frame != "building":  # the first sample's yaw defines the frame: only what is gathered since then is in error
        error[:, 2] -= error[0, 2] + heading[0]
    believed_yaw = np.unwrap(heading + error[:, 2])
    moved = _dead_reckoned_m(p, error[:, 2], sensor, rng)
    B = rotate_by_quaternion(_believed_attitude(heading, error), B_body)
    estimate = Window(
        frame=frame,
        B_uT=np.linalg.norm(B, axis=1, keepdims=True) if frame == "norm" else B,
        displacement_m=moved,
        noise_uT=sensor.noise_uT,
        t_s=t - t[0],
        yaw_rad=believed_yaw - believed_yaw[0],
    )
    return estimate, Pose(walk.floor, p[-1], float(wrap_angle_rad(heading[-1])))


def _stretch(
    walk: SyntheticWalk, rng: np.random.Generator, length_m: float, samples: int
) -> tuple[Array, Array, Array]:
    """Times, positions and continuous headings at equal spacing over a random stretch of the walk."""
    s = walk.path_length_m()
    assert samples >= 1, samples
    assert 0.0 <= length_m <= s[-1], (length_m, s[-1])
    end = rng.uniform(length_m, s[-1])
    at = np.linspace(end - length_m, end, samples) if samples > 1 else np.array([end])
    p = np.stack([np.interp(at, s, walk.p_building_m[:, axis]) for axis in range(3)], axis=1)
    return np.interp(at, s, walk.t_s), p, np.interp(at, s, np.unwrap(walk.heading_rad))


def _measured_body_uT(
    building: SyntheticBuilding, p: Array, heading_rad: Array, sensor: Magnetometer, rng: np.random.Generator
) -> Array:
    """What the sensor reads, (n, 3) in its own axes: the true field turned by the true heading, offset and noise."""
    half = -0.5 * heading_rad
    zero = np.zeros_like(half)
    building_to_body = np.stack([np.cos(half), zero, zero, np.sin(half)], axis=1)
    B = rotate_by_quaternion(building_to_body, building.field_uT(p))
    read = B @ np.array(sensor.distortion).T + sensor.hard_iron_uT
    return np.asarray(read + sensor.noise_uT * rng.normal(size=B.shape))


def _attitude_error_rad(t_s: Array, sensor: Magnetometer, rng: np.random.Generator) -> Array:
    """(n, 3) error of the believed roll, pitch and yaw."""
    sd = np.array([sensor.tilt_sd_rad, sensor.tilt_sd_rad, sensor.yaw_sd_rad])
    return ornstein_uhlenbeck(rng, t_s, sd, sensor.attitude_correlation_s, 3)


def _believed_attitude(heading_rad: Array, error_rad: Array) -> Array:
    """(n, 4) quaternions: yaw by the believed heading, then the believed roll and pitch about the device's axes."""
    yaw = 0.5 * (heading_rad + error_rad[:, 2])
    tilt = 0.5 * error_rad[:, :2]
    tilt_angle = np.linalg.norm(tilt, axis=1)
    c, s = np.cos(tilt_angle), np.sinc(tilt_angle / np.pi)
    x, y = s * tilt[:, 0], s * tilt[:, 1]
    cy, sy = np.cos(yaw), np.sin(yaw)
    return np.stack([cy * c, cy * x - sy * y, cy * y + sy * x, sy * c], axis=1)


def _dead_reckoned_m(p: Array, yaw_error_rad: Array, sensor: Magnetometer, rng: np.random.Generator) -> Array:
    """(n, 3) displacement from the first sample as steps and the believed yaw give it."""
    steps = np.diff(p, axis=0)
    steps[:, 2] = 0.0
    between = 0.5 * (yaw_error_rad[1:] + yaw_error_rad[:-1])
    turned = np.stack([yaw_matrix(a) @ step for a, step in zip(between, steps, strict=True)]) if len(steps) else steps
    length = np.linalg.norm(steps[:, :2], axis=1, keepdims=True)
    noise = sensor.step_noise_m * np.sqrt(length) * rng.normal(size=(len(steps), 2))
    moved = turned * (1.0 + sensor.step_scale_sd * rng.normal())
    moved[:, :2] += noise
    return np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
