"""The field as three components: the baseline that the spherical form is compared with (Brommer, L87-91, L133-173)."""

from typing import NamedTuple

import numpy as np

from app.attitude.spherical_field import skew
from app.geometry import Array

__all__ = ["CartesianPrediction", "norm_variance", "predict_cartesian"]


class CartesianPrediction(NamedTuple):
    """What a magnetometer should read (3,), uT, and its derivatives (3, 3) with the errors of attitude and extrinsic

    rotation and with the field in the building frame.
    """

    reading: Array
    by_attitude: Array
    by_extrinsic: Array
    by_field: Array


def predict_cartesian(R_body_to_building: Array, R_sensor_to_body: Array, B_building_uT: Array) -> CartesianPrediction:
    """The reading of a field (3,) of the building, and H, worked out from the model (Brommer, L87-91, Eqs. 2-4)."""
    B_body = R_body_to_building.T @ B_building_uT
    B_sensor = R_sensor_to_body.T @ B_body
    return CartesianPrediction(
        B_sensor, R_sensor_to_body.T @ skew(B_body), skew(B_sensor), R_sensor_to_body.T @ R_body_to_building.T
    )


def norm_variance(B_uT: Array, covariance_uT2: Array) -> Array:
    """F P F^T: variance of the norm of vectors (..., 3) with covariance (..., 3, 3), uT^2 (Brommer, L133-173).

    Of a state it is Eq. 10; of a predicted reading, with the innovation's covariance S, Eq. 14.
    """
    B = np.asarray(B_uT, dtype=np.float64)
    F = B / np.linalg.norm(B, axis=-1, keepdims=True)
    return np.asarray(np.einsum("...i,...ij,...j->...", F, covariance_uT2, F))
