"""One yaw offset per walk: the shape of the yaw is the gyroscope's, its origin is inferred.

Two witnesses say where the gyroscope's zero points in the building, each with errors of its own:

* the rotation vector's yaw, dragged by the local field: a common error over the walk and one that changes from
  stretch to stretch. Averaged over a walk it is the better witness;
* the directions of the legs between waypoints, which show where the surveyor walked: the device is not held exactly
  along the way, and that offset is constant over a walk.

Both, with a slow drift of the gyroscope, are one small linear Gaussian model, solved exactly.
"""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array, wrap_angle_rad

__all__ = ["HOLDING_SD_RAD", "Legs", "YawOffset", "heading_prior", "infer_yaw_offset"]

ROTATION_VECTOR_COMMON_SD_RAD = np.deg2rad(5.0)
ROTATION_VECTOR_STRETCH_SD_RAD = np.deg2rad(8.0)
STRETCH_S = 8.0
HOLDING_SD_RAD = np.deg2rad(8.0)
LEG_DIRECTION_SD_RAD = np.deg2rad(6.0)
LABEL_SD_M = 0.7
DRIFT_SD_RAD_PER_S = np.deg2rad(0.03)
SHORTEST_LEG_M = 2.0
DISAGREEMENT_SD = 3.0


@dataclass(frozen=True, slots=True, eq=False)
class Legs:
    """Legs between waypoints: time of the middle (k,), label vector (k, 2) m in the building frame, and dead-reckoned
    vector (k, 2) m in the frame in which the gyroscope's yaw is zero."""

    t_s: Array
    label_m: Array
    reckoned_m: Array

    def long_enough(self) -> Array:
        """(k,) legs whose direction can be compared."""
        shortest = np.minimum(np.linalg.norm(self.label_m, axis=1), np.linalg.norm(self.reckoned_m, axis=1))
        return np.asarray(shortest > SHORTEST_LEG_M)

    def turn_rad(self) -> Array:
        """(k,) angle from the reckoned to the label vector."""
        label, reckoned = np.arctan2(*self.label_m.T[::-1]), np.arctan2(*self.reckoned_m.T[::-1])
        return wrap_angle_rad(label - reckoned)


@dataclass(frozen=True, slots=True)
class YawOffset:
    """offset_rad + drift_rad_per_s * t is added to the gyroscope's yaw to give the yaw in the building frame.

    holding_rad is the walking direction less the device's own direction (None: no leg to tell), agree says whether
    the two witnesses did; the legs are not used for the device's yaw when they did not.
    """

    offset_rad: float
    sd_rad: float
    drift_rad_per_s: float
    holding_rad: float | None
    agree: bool


def infer_yaw_offset(t_s: Array, magnetic_less_gyro_rad: Array | None, legs: Legs) -> YawOffset:
    """The offset from both witnesses; t_s (n,) counts from the first sample.

    magnetic_less_gyro_rad (n,): the rotation vector's yaw less the gyroscope's, None without a rotation vector.
    """
    usable = legs.long_enough()
    turn = legs.turn_rad()[usable]
    length = np.linalg.norm(legs.label_m[usable], axis=1)
    sd_turn = np.hypot(LEG_DIRECTION_SD_RAD, np.sqrt(2.0) * LABEL_SD_M / length)
    stretches = _stretches(t_s, magnetic_less_gyro_rad)
    if len(turn) == 0 and len(stretches) == 0:
        return YawOffset(0.0, np.pi / np.sqrt(3.0), 0.0, None, True)
    centre = _circular_mean(stretches[:, 1] if len(stretches) else turn, None if len(stretches) else sd_turn**-2)
    walked = _circular_mean(turn, sd_turn**-2) if len(turn) else centre
    apart = abs(float(wrap_angle_rad(walked - centre)))
    agree = apart <= DISAGREEMENT_SD * np.hypot(HOLDING_SD_RAD, ROTATION_VECTOR_COMMON_SD_RAD)
    # Unknowns: offset, holding, common error of the rotation vector, drift (about the middle of the walk).
    middle = 0.5 * (t_s[0] + t_s[-1])
    rows = [np.array([1.0, 0.0, 1.0, t - middle]) for t in stretches[:, 0]]
    rows += [np.array([1.0, 1.0, 0.0, t - middle]) for t in legs.t_s[usable]]
    design = np.array(rows)
    seen = np.concatenate([wrap_angle_rad(stretches[:, 1] - centre), wrap_angle_rad(turn - centre)])
    weight = np.concatenate([np.full(len(stretches), ROTATION_VECTOR_STRETCH_SD_RAD**-2.0), sd_turn**-2])
    holding_sd = HOLDING_SD_RAD if agree else np.pi
    prior = np.array([1e-6, holding_sd**-2, ROTATION_VECTOR_COMMON_SD_RAD**-2, DRIFT_SD_RAD_PER_S**-2])
    covariance = np.linalg.inv(design.T @ (weight[:, None] * design) + np.diag(prior))
    offset, holding, _, drift = covariance @ (design.T @ (weight * seen))
    return YawOffset(
        offset_rad=float(wrap_angle_rad(centre + offset - drift * middle)),
        sd_rad=float(np.sqrt(covariance[0, 0])),
        drift_rad_per_s=float(drift),
        holding_rad=float(holding) if len(turn) else None,
        agree=bool(agree),
    )


def heading_prior(t_s: Array, magnetic_less_gyro_rad: Array) -> tuple[Array, Array]:
    """What the device believes without waypoints, at each sample from that and earlier samples only.

    (n,) offset to add to the gyroscope's yaw and (n,) its standard deviation, which includes how the device is held
    against the walking direction.
    """
    running = np.cumsum(np.exp(1j * magnetic_less_gyro_rad))
    stretches = 1.0 + (t_s - t_s[0]) / STRETCH_S
    sd = np.sqrt(ROTATION_VECTOR_COMMON_SD_RAD**2 + ROTATION_VECTOR_STRETCH_SD_RAD**2 / stretches + HOLDING_SD_RAD**2)
    return np.unwrap(np.angle(running)), sd


def _stretches(t_s: Array, difference_rad: Array | None) -> Array:
    """(m, 2) time and circular mean of the difference over stretches whose errors are taken to be independent."""
    if difference_rad is None:
        return np.empty((0, 2))
    index = ((t_s - t_s[0]) / STRETCH_S).astype(np.int64)
    count = np.bincount(index)
    sums = np.bincount(index, np.cos(difference_rad)) + 1j * np.bincount(index, np.sin(difference_rad))
    times = np.bincount(index, t_s)
    full = count > 0
    return np.stack([times[full] / count[full], np.angle(sums[full])], axis=1)


def _circular_mean(angle_rad: Array, weight: Array | None) -> float:
    return float(np.angle(np.sum(np.exp(1j * angle_rad) * (1.0 if weight is None else weight))))
