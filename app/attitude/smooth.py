"""Attitude with all samples before and after: two filters, one from each end, joined (Fraser and Potter's smoother).

For a whole log. The filter from the end reads the samples backwards, gyro negated; it is begun on its own, so that the
two share nothing but the samples, each of which only one of them has read at any time. Their mean weighs them by their
covariances.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from app.attitude.mekf import AttitudeRun, begin, follow_attitude
from app.attitude.options import AttitudeOptions, InertialSamples
from app.attitude.reference import MagneticReference
from app.geometry import Array

__all__ = ["smooth_attitude"]


def smooth_attitude(
    samples: InertialSamples, reference: MagneticReference | None, options: AttitudeOptions | None = None
) -> AttitudeRun:
    """What is known of the attitude at every sample with the whole log; flags say that both passes believed a sensor.

    `disturbed`: to either. Raises InvalidInput as `begin` and `follow_attitude` do.
    """
    options = options or AttitudeOptions()
    undelayed = replace(options, gyro_delay_s=0.0)
    _, ahead = follow_attitude(begin(samples, reference, undelayed), samples, reference, undelayed)
    mirrored, mirrored_reference = _backwards(samples), _reference_backwards(reference, len(samples))
    _, back = follow_attitude(begin(mirrored, mirrored_reference, undelayed), mirrored, mirrored_reference, undelayed)
    first = Rotation.from_quat(ahead.q_body_to_building, scalar_first=True)
    second = Rotation.from_quat(back.q_body_to_building[::-1], scalar_first=True)
    P, Q = ahead.covariance_rad2, back.covariance_rad2[::-1]
    share = P @ np.linalg.inv(P + Q)
    joined = first * Rotation.from_rotvec(np.einsum("nij,nj->ni", share, (first.inv() * second).as_rotvec()))
    read = np.linspace(0.0, 1.0, len(samples))[:, None]  # a bias counts by how much of the log its filter has read
    bias = read * ahead.gyro_bias_rad_per_s - (1.0 - read) * back.gyro_bias_rad_per_s[::-1]
    lead = options.gyro_delay_s * np.nan_to_num(samples.gyro_rad_per_s - bias)
    q = (joined * Rotation.from_rotvec(lead)).as_quat(scalar_first=True)
    both = [getattr(ahead, name) & getattr(back, name)[::-1] for name in ("magnetometer_used", "accelerometer_used")]
    covariance = P - share @ P
    covariance = 0.5 * (covariance + covariance.transpose(0, 2, 1))
    return AttitudeRun(q, covariance, bias, both[0], ahead.disturbed | back.disturbed[::-1], both[1])


def _backwards(samples: InertialSamples) -> InertialSamples:
    """The samples of a clock that runs the other way. A gyro reading is the mean since the one before: now after."""
    gyro = -np.concatenate([samples.gyro_rad_per_s[1:], samples.gyro_rad_per_s[-1:]])
    arrays = (-samples.t_s, gyro, samples.accelerometer_m_per_s2, samples.magnetometer_uT)
    return InertialSamples(*(np.ascontiguousarray(each[::-1]) for each in arrays))


def _reference_backwards(reference: MagneticReference | None, n: int) -> MagneticReference | None:
    if reference is None or reference.B_uT is None:
        return reference
    B, variance = reference.rows(n)
    return MagneticReference(_flipped(B), _flipped(variance))


def _flipped(rows: Array) -> Array:
    return rows[::-1] if len(rows) > 1 else rows[0]
