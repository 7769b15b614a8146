"""The full ellipsoid, nine parameters: a device that was turned through all directions (Shockley, L545-L607).

The source drops the constant k (Eq. 2.19, E2): its fit is `fit_without_constant`, mended by alpha. Here a conic with
its constant is the start, and distances from the ellipsoid, without the bias of noise, the answer. The correction is
the symmetric root: the strength of the field tells nothing of a rotation of the whole sensor (E5), which a walk through
a mapped building does tell (`app.calibration.map_aided`).
"""

from app.calibration.conic import fit_conic, symmetric_root
from app.calibration.coverage import refuse_flat, sphere_coverage
from app.calibration.fit import CalibrationFit, conclude_sphere
from app.calibration.norm_fit import fit_norms, symmetric_parameters, symmetric_start
from app.calibration.readings import check_readings, near_the_others
from app.calibration.sensor_model import SensorModel
from app.geometry import Array

__all__ = ["ELLIPSOID_PARAMETERS", "ellipsoid"]

ELLIPSOID_PARAMETERS = (
    "hard_iron_x_ut", "hard_iron_y_ut", "hard_iron_z_ut", "correction_xx", "correction_yy", "correction_zz",
    "correction_xy", "correction_xz", "correction_yz",
)  # fmt: skip
LEAST_SAMPLES = 60
_ADVICE = ("turn the device slowly about each of its three axes, two whole turns each",)


def ellipsoid(B_uT: Array, field_uT: float) -> CalibrationFit:
    """From readings (n, 3), uT, in one field of strength `field_uT`. Raises InvalidInput with advice."""
    B = check_readings(B_uT, field_uT, LEAST_SAMPLES)
    near = B[near_the_others(B)]
    refuse_flat(near)
    conic = fit_conic(near, field_uT)
    start = symmetric_start(symmetric_root(conic.Q, _ADVICE), conic.hard_iron_uT)
    fitted = fit_norms(B, field_uT, start, symmetric_parameters(3))
    found = symmetric_parameters(3)(fitted.theta)
    coverage = sphere_coverage(fitted.directions[~fitted.outlier], fitted.condition)
    symmetric_root(found.correction @ found.correction, coverage.advice)
    model = SensorModel(found.hard_iron_uT, found.correction)
    return conclude_sphere("ellipsoid", ELLIPSOID_PARAMETERS, fitted, model, coverage, field_uT)
