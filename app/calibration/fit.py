"""What a calibration method hands back, and what all methods check before they do."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from app.calibration.coverage import OrientationCoverage, circle_coverage, refusal, require_circle, require_sphere
from app.calibration.norm_fit import NormFit
from app.calibration.sensor_model import SensorModel
from app.geometry import Array

__all__ = ["LARGEST_RESIDUAL", "CalibrationFit", "conclude_circle", "conclude_sphere", "named"]

LARGEST_RESIDUAL = 0.1
"""Of the field: readings that scatter more were not taken in one field."""
WORTH_SAYING = 0.03
MANY_OUTLIERS = 0.05

NOT_CONSTANT = "the field around was not constant: move away from steel, cars, cables and loudspeakers, and try again"
HEIGHT_ONLY = (
    "turning level says nothing of the vertical axis's scale: to find it, tilt the device through all directions"
)


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationFit:
    """A sensor's calibration, how well it is known, and what would make it better.

    parameters           the method's own, by name; what has a unit says so: hard_iron_x_ut, rho_rad
    parameter_sd         their sds; a method that has no prior names only what the readings tell
    covariance           (p, p) of the parameters, in their order
    residual_rms_uT      of |corrected| minus the reference field, without outliers; residual_max_uT likewise; on a map,
                         per axis, of corrected minus map
    outliers             readings that were left out of account
    determined, undetermined    names of parameters; `undetermined` also of those the method holds fixed
    advice               what rotation is missing, or what else to do, in plain words
    """

    method: str
    model: SensorModel
    parameters: Mapping[str, float]
    parameter_sd: Mapping[str, float]
    covariance: Array
    residual_rms_uT: float
    residual_max_uT: float
    samples: int
    outliers: int
    coverage: OrientationCoverage
    determined: tuple[str, ...]
    undetermined: tuple[str, ...]
    advice: tuple[str, ...]


def named(names: Sequence[str], values: Array) -> dict[str, float]:
    """Numbers by name."""
    return {name: float(value) for name, value in zip(names, values, strict=True)}


def conclude_sphere(
    method: str,
    names: Sequence[str],
    fitted: NormFit,
    model: SensorModel,
    coverage: OrientationCoverage,
    reference_uT: float,
) -> CalibrationFit:
    """The result of a fit in three axes. Raises InvalidInput where the readings do not determine it."""
    require_sphere(coverage)
    return _conclude(
        method, names, fitted.theta, fitted.covariance, model, coverage, fitted.residual_uT, fitted.outlier,
        reference_uT, (), (),
    )  # fmt: skip


def conclude_circle(
    method: Literal["swinging", "strict_ellipse", "modified_ellipsoid"],
    horizontal: Mapping[str, float],
    covariance_horizontal: Array,
    model: SensorModel,
    B_uT: Array,
    outlier: NDArray[np.bool_],
    condition: float,
    horizontal_uT: float,
    vertical_sd_uT: float,
    *,
    must_fit: bool = True,
) -> CalibrationFit:
    """The result of a fit of two axes and an offset of the third. Raises InvalidInput where a heading was not seen.

    horizontal: the parameters of two axes, and their covariance; the third's offset is `model`'s, its sd given.
    `must_fit`: refuse what leaves a large residual; not where the source's misprints are to be shown.
    """
    corrected = model.apply(B_uT)[:, :2]
    norm = np.linalg.norm(corrected, axis=1)
    coverage = circle_coverage(corrected[~outlier] / norm[~outlier, None], condition)
    require_circle(coverage)
    names = [*horizontal, "hard_iron_z_ut"]
    p = len(horizontal)
    covariance = np.zeros((p + 1, p + 1))
    covariance[:p, :p], covariance[p, p] = covariance_horizontal, vertical_sd_uT**2
    values = np.array([*horizontal.values(), model.hard_iron_uT[2]])
    return _conclude(
        method, names, values, covariance, model, coverage, norm - horizontal_uT, outlier, horizontal_uT,
        ("correction_zz", "correction_xz", "correction_yz"), (HEIGHT_ONLY,), must_fit=must_fit,
    )  # fmt: skip


def _conclude(
    method: str,
    names: Sequence[str],
    values: Array,
    covariance: Array,
    model: SensorModel,
    coverage: OrientationCoverage,
    residual_uT: Array,
    outlier: NDArray[np.bool_],
    reference_uT: float,
    undetermined: tuple[str, ...],
    advice: tuple[str, ...],
    *,
    must_fit: bool = True,
) -> CalibrationFit:
    kept = residual_uT[~outlier]
    rms = float(np.sqrt(np.mean(kept**2))) if len(kept) else np.inf
    if must_fit and rms > LARGEST_RESIDUAL * reference_uT:
        raise refusal(
            f"No calibration brings the readings to {reference_uT:g} uT: {rms:.1f} uT are left", [NOT_CONSTANT]
        )
    said = [*coverage.advice, *advice]
    if rms > WORTH_SAYING * reference_uT or outlier.mean() > MANY_OUTLIERS:
        said.append(NOT_CONSTANT)
    sd = np.sqrt(np.maximum(np.diag(covariance), 0.0))
    return CalibrationFit(
        method, model, named(names, values), named(names, sd), covariance, rms, float(np.abs(kept).max()),
        len(residual_uT), int(outlier.sum()), coverage, tuple(names), undetermined, tuple(said),
    )  # fmt: skip
