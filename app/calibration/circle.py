"""What the methods that turn a device about the vertical share: an ellipse of two axes, and the third's offset.

x and y lie level; `vertical_uT` is the field's component along the sensor's own +z as it is held (negative, over the
northern half of the Earth, where z points up). Whatever tilt lets of the vertical into x and y is a constant, which
the hard iron takes up: it is right on ground as level as where it was found.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.calibration.conic import fit_conic, symmetric_root
from app.calibration.norm_fit import fit_norms, symmetric_parameters, symmetric_start
from app.calibration.readings import check_readings, near_the_others
from app.calibration.sensor_model import SensorModel
from app.geometry import Array

__all__ = ["CIRCLE_PARAMETERS", "LEAST_SAMPLES", "Ellipse", "circle_model", "fit_ellipse", "vertical_offset_uT"]

LEAST_SAMPLES = 36
CIRCLE_PARAMETERS = ("hard_iron_x_ut", "hard_iron_y_ut", "correction_xx", "correction_yy", "correction_xy")


class Ellipse(NamedTuple):
    """Of readings in x and y: correction (2, 2), hard_iron_uT (2,), covariance (5, 5) of CIRCLE_PARAMETERS."""

    correction: Array
    hard_iron_uT: Array
    covariance: Array
    outlier: NDArray[np.bool_]
    noise_uT: float
    condition: float
    B_uT: Array


def fit_ellipse(B_uT: Array, horizontal_uT: float) -> Ellipse:
    """Homogeneous conic, then distances (see `norm_fit`). Readings (n, 3). InvalidInput where no ellipse fits."""
    B = check_readings(B_uT, horizontal_uT, LEAST_SAMPLES, axes=2)
    near = near_the_others(B[:, :2])
    conic = fit_conic(B[near, :2], horizontal_uT)
    advice = ("turn the device level through at least one whole circle",)
    start = symmetric_start(symmetric_root(conic.Q, advice), conic.hard_iron_uT)
    fitted = fit_norms(B[:, :2], horizontal_uT, start, symmetric_parameters(2))
    found = symmetric_parameters(2)(fitted.theta)
    symmetric_root(found.correction @ found.correction, advice)
    return Ellipse(
        found.correction, found.hard_iron_uT, fitted.covariance, fitted.outlier, fitted.noise_uT, fitted.condition, B
    )


def vertical_offset_uT(ellipse: Ellipse, vertical_uT: float) -> tuple[float, float]:
    """The third axis's offset from its median, with its sd; its scale is taken to be 1 (Shockley, Eq. 2.12, E4).

    Its noise is no less than that of the others: a sensor of coarse steps may read one and the same value throughout.
    """
    z_uT = ellipse.B_uT[:, 2]
    middle = float(np.median(z_uT))
    noise = max(1.4826 * float(np.median(np.abs(z_uT - middle))), ellipse.noise_uT)
    return middle - vertical_uT, noise * float(np.sqrt(np.pi / 2.0 / len(z_uT)))


def circle_model(correction: Array, hard_iron_uT: Array, vertical_offset: float, scale_z: float = 1.0) -> SensorModel:
    """Two axes (2, 2), (2,) and the third beside them (Shockley, Eqs. 3.5, 3.6)."""
    whole = np.diag([1.0, 1.0, scale_z])
    whole[:2, :2] = correction
    return SensorModel(np.append(hard_iron_uT, vertical_offset), whole)
