"""The modified ellipsoid calibration: a device that can turn about the vertical alone (Shockley, L808-L850).

As printed, alpha is a ratio of squares that multiplies A_h (Eqs. 3.2, 3.7): wrong by a square root (E1). It belongs on
Q_h, which also works where the hard iron is stronger than the field and Q_h comes out negative. What alpha corrects is
the constant the least squares drops (E2); the homogeneous conic drops none, and needs no alpha.
"""

from typing import Literal

import numpy as np

from app.calibration.circle import CIRCLE_PARAMETERS, circle_model, fit_ellipse, vertical_offset_uT
from app.calibration.conic import fit_without_constant, symmetric_root
from app.calibration.fit import CalibrationFit, conclude_circle, named
from app.calibration.norm_fit import symmetric_start
from app.geometry import Array

__all__ = ["alpha_of", "modified_ellipsoid"]


def modified_ellipsoid(
    B_uT: Array,
    horizontal_uT: float,
    vertical_uT: float,
    *,
    fit: Literal["conic", "shockley"] = "conic",
    alpha: Literal["corrected", "printed"] = "corrected",
) -> CalibrationFit:
    """From readings (n, 3), uT, while the device turned level through whole circles; x and y lie level.

    horizontal_uT and vertical_uT: the field there, its vertical part along the sensor's +z. `fit="shockley"` is the
    source's least squares with k = 0, where `alpha` chooses its correction; its covariance is that of the good fit, and
    too small where rho = b^T Q b / H^2 is near 1. Raises InvalidInput with advice.
    """
    ellipse = fit_ellipse(B_uT, horizontal_uT)
    offset_uT, offset_sd_uT = vertical_offset_uT(ellipse, vertical_uT)
    correction, hard_iron_uT = ellipse.correction, ellipse.hard_iron_uT
    if fit == "shockley":
        conic = fit_without_constant(ellipse.B_uT[~ellipse.outlier, :2], horizontal_uT)
        hard_iron_uT = conic.hard_iron_uT
        ratio = alpha_of(conic.Q, hard_iron_uT, horizontal_uT)
        correction = (
            symmetric_root(ratio * conic.Q) if alpha == "corrected" else ratio * symmetric_root(conic.Q)
        )  # fmt: skip
    return conclude_circle(
        "modified_ellipsoid", named(CIRCLE_PARAMETERS, symmetric_start(correction, hard_iron_uT)), ellipse.covariance,
        circle_model(correction, hard_iron_uT, offset_uT), ellipse.B_uT, ellipse.outlier, ellipse.condition,
        horizontal_uT, offset_sd_uT, must_fit=alpha == "corrected",
    )  # fmt: skip


def alpha_of(Q: Array, hard_iron_uT: Array, reference_uT: float) -> float:
    """alpha = R^2 / (R^2 + b^T Q_ls b) = 1 - rho, in closed form (Shockley, Eqs. 3.1, 3.2; E2); negative if rho > 1."""
    return float(reference_uT**2 / (reference_uT**2 + np.asarray(hard_iron_uT) @ Q @ hard_iron_uT))
