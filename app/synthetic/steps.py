"""What a device carried along a synthetic walk would send, step after step, to be followed."""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array, rotate_by_quaternion
from app.synthetic.building import SyntheticBuilding
from app.synthetic.noise import ornstein_uhlenbeck
from app.synthetic.sensors import Magnetometer
from app.synthetic.walks import SyntheticWalk
from app.tracking.step import Step

__all__ = ["Carried", "DeadReckoned", "carry"]


@dataclass(frozen=True, slots=True)
class DeadReckoned:
    """Errors of a device's own reckoning: step-and-heading of a phone, or the wheels and gyroscope of a robot.

    scale_sd                  of all its lengths, over a walk
    noise_m                   of a length, per square root of metre, along the way and across it
    drift_sd_rad_per_m        of the rate at which its heading drifts, over a walk
    heading_walk_rad          of its heading's random walk, per square root of metre
    """

    scale_sd: float = 0.05
    noise_m: float = 0.05
    drift_sd_rad_per_m: float = 0.003
    heading_walk_rad: float = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """Steps, where the device truly was at each (n, 3), and on which floor (n,)."""

    steps: tuple[Step, ...]
    truth_m: Array
    floor: Array


def carry(
    building: SyntheticBuilding,
    walk: SyntheticWalk,
    sensor: Magnetometer,
    reckoned: DeadReckoned,
    rng: np.random.Generator,
) -> Carried:
    """A device that does not know where it starts, nor which way it faces: level, held forward."""
    yaw = np.unwrap(walk.heading_rad)
    path = walk.path_length_m()
    length = np.diff(path, prepend=0.0)
    drift = reckoned.drift_sd_rad_per_m * rng.normal()
    wander = np.cumsum(reckoned.heading_walk_rad * np.sqrt(length) * rng.normal(size=len(length)))
    yaw_error = drift * path + wander
    believed = yaw - yaw[0] + yaw_error
    turn = yaw_error - yaw[0]
    way = np.diff(walk.p_building_m, axis=0, prepend=walk.p_building_m[:1])
    scale = 1.0 + reckoned.scale_sd * rng.normal()
    c, s = np.cos(turn), np.sin(turn)
    told = scale * np.stack([c * way[:, 0] - s * way[:, 1], s * way[:, 0] + c * way[:, 1]], axis=1)
    told += reckoned.noise_m * np.sqrt(length)[:, None] * rng.normal(size=told.shape)
    moved = np.column_stack([np.cumsum(told, axis=0), np.zeros(len(told))])
    return Carried(
        _steps(building, walk, sensor, believed, moved, rng), walk.p_building_m, np.full(len(walk), walk.floor)
    )


def _steps(
    building: SyntheticBuilding, walk: SyntheticWalk, sensor: Magnetometer, yaw_rad: Array, moved_m: Array,
    rng: np.random.Generator,
) -> tuple[Step, ...]:  # fmt: skip
    n = len(walk)
    B_body = _turned(-walk.heading_rad, building.field_uT(walk.p_building_m))
    tilt = ornstein_uhlenbeck(rng, walk.t_s, sensor.tilt_sd_rad, sensor.attitude_correlation_s, 2)
    half = 0.5 * np.column_stack([tilt, np.zeros(n)])
    q = np.column_stack([np.cos(np.linalg.norm(half, axis=1)), half])
    read = B_body @ np.array(sensor.distortion).T + sensor.hard_iron_uT
    B_level = rotate_by_quaternion(q, read + sensor.noise_uT * rng.normal(size=(n, 3)))
    B = _turned(yaw_rad, B_level)
    return tuple(Step(k, float(walk.t_s[k]), B[k], moved_m[k], yaw_rad=float(yaw_rad[k])) for k in range(n))


def _turned(angle_rad: Array, v: Array) -> Array:
    c, s = np.cos(angle_rad), np.sin(angle_rad)
    return np.column_stack([c * v[:, 0] - s * v[:, 1], s * v[:, 0] + c * v[:, 1], v[:, 2]])
