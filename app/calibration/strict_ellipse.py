"""The strict two-dimensional ellipse: the source's least squares with k = 0, uncorrected (Shockley, L611-L636).

It is here to compare with: its scale is too large by 1 / sqrt(1 - rho), rho = b^T Q b / H^2. Use the modified
ellipsoid.
"""

from app.calibration.circle import CIRCLE_PARAMETERS, circle_model, fit_ellipse, vertical_offset_uT
from app.calibration.conic import fit_without_constant, symmetric_root
from app.calibration.fit import CalibrationFit, conclude_circle, named
from app.calibration.modified_ellipsoid import alpha_of
from app.calibration.norm_fit import symmetric_start
from app.geometry import Array

__all__ = ["strict_ellipse"]


def strict_ellipse(B_uT: Array, horizontal_uT: float, vertical_uT: float) -> CalibrationFit:
    """As `modified_ellipsoid`, from the same readings, but too large; its covariance is about that wrong answer.

    Raises InvalidInput where the hard iron is stronger than the field: Q is negative then (E6).
    """
    ellipse = fit_ellipse(B_uT, horizontal_uT)
    conic = fit_without_constant(ellipse.B_uT[~ellipse.outlier, :2], horizontal_uT)
    correction = symmetric_root(conic.Q, ("use the modified ellipsoid: the hard iron is stronger than the field",))
    offset_uT, offset_sd_uT = vertical_offset_uT(ellipse, vertical_uT)
    inflated = 1.0 / alpha_of(conic.Q, conic.hard_iron_uT, horizontal_uT)
    covariance = ellipse.covariance.copy()
    covariance[2:] *= inflated**0.5
    covariance[:, 2:] *= inflated**0.5
    return conclude_circle(
        "strict_ellipse", named(CIRCLE_PARAMETERS, symmetric_start(correction, conic.hard_iron_uT)), covariance,
        circle_model(correction, conic.hard_iron_uT, offset_uT), ellipse.B_uT, ellipse.outlier, ellipse.condition,
        horizontal_uT, offset_sd_uT, must_fit=False,
    )  # fmt: skip
