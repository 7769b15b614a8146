"""Are two devices equivalent, so that one may use what the other mapped, or take its place?

Not whether a difference can be shown: with enough readings it always can. Equivalent is what, with 95 % confidence,
differs by less than a tolerance; different is what with that confidence does not; between the two, more readings tell.
"""

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, f

from app.calibration.drift import field_difference, precision_of, sphere_directions
from app.calibration.fit import CalibrationFit
from app.calibration.sensor_model import SensorModel
from app.errors import Fault, InvalidInput
from app.geometry import Array

__all__ = ["EquivalentCalibrations", "EquivalentRecords", "compare_calibrations", "compare_records", "pair_by_place"]

Verdict = Literal["equivalent", "different", "not known"]
CONFIDENCE_SDS = 1.645  # one-sided 95 %
DRAWS = 400
LEAST_PAIRS = 10


@dataclass(frozen=True, slots=True)
class EquivalentCalibrations:
    """Two devices by their calibrations: what one reads, corrected as if it were the other, errs by at most `worst_uT`.

    worst_95_uT: what the true worst error is below with 95 % probability, worst_5_uT above. `p_same`: of so large a
    difference of the parameters by chance, None where the methods differ.
    """

    worst_uT: float
    rms_uT: float
    worst_5_uT: float
    worst_95_uT: float
    p_same: float | None
    verdict: Verdict
    words: str


@dataclass(frozen=True, slots=True, eq=False)
class EquivalentRecords:
    """Two devices by their readings of the same places, n pairs worth `effective_pairs` independent ones.

    mean_difference_uT (3,) of second less first with its sd (3,); rms_uT of the differences per axis, rms_after_uT once
    the second is turned by `rotation` (3, 3) and shifted by `shift_uT` (3,): first = rotation second + shift.
    p_no_difference: Hotelling's test of the mean.
    """

    mean_difference_uT: Array
    mean_sd_uT: Array
    rms_uT: float
    rms_after_uT: float
    rotation: Array
    rotation_rad: float
    shift_uT: Array
    pairs: int
    effective_pairs: float
    p_no_difference: float
    verdict: Verdict
    words: str


class Pairs(NamedTuple):
    """Indices of readings of the first and of the second that belong together."""

    first: NDArray[np.int64]
    second: NDArray[np.int64]


def compare_calibrations(
    first: CalibrationFit, second: CalibrationFit, magnitude_uT: float, tolerance_uT: float, rng: np.random.Generator
) -> EquivalentCalibrations:
    """By worst error over all directions of a field of `magnitude_uT`, with what is not known of both calibrations.

    Both by one method; `rng` draws from their covariances. Raises InvalidInput.
    """
    if first.method != second.method:
        message = f"Calibrations by {first.method} and {second.method} cannot be compared: repeat one of them."
        raise InvalidInput(message, Fault("second", "another method"))
    told = field_difference(second.model, first.model, magnitude_uT)
    off = np.array(list(second.parameters.values())) - np.array(list(first.parameters.values()))
    both = first.covariance + second.covariance
    p_same = float(chi2.sf(off @ precision_of(both) @ off, len(off)))
    spread = _worst_draws(second, magnitude_uT, both, first.model, rng)
    low, high = np.quantile(spread, [0.05, 0.95])
    verdict = _verdict(float(low), float(high), tolerance_uT)
    words = (
        f"Read by one device and corrected as the other's, a field of {magnitude_uT:g} uT errs by up to "
        f"{told.worst_uT:.2f} uT ({low:.2f} to {high:.2f} with what the calibrations leave open): {_said(verdict)} "
        f"within {tolerance_uT:g} uT."
    )
    return EquivalentCalibrations(told.worst_uT, told.rms_uT, float(low), float(high), p_same, verdict, words)


def compare_records(first_uT: Array, second_uT: Array, tolerance_uT: float) -> EquivalentRecords:
    """Readings (n, 3) of two devices at the same places in the same axes, paired row by row (see `pair_by_place`).

    Rows in order of time: neighbours that err alike count for less. Raises InvalidInput.
    """
    a, b = np.asarray(first_uT, dtype=np.float64), np.asarray(second_uT, dtype=np.float64)
    if a.shape != b.shape or a.ndim != 2 or a.shape[1] != 3 or not (np.isfinite(a).all() and np.isfinite(b).all()):
        message = f"Both records must be (n, 3), finite and paired; they are {a.shape} and {b.shape}."
        raise InvalidInput(message, Fault("second_uT", "not paired"))
    if len(a) < LEAST_PAIRS:
        message = f"{len(a)} pairs are too few to compare devices: {LEAST_PAIRS} are the least. Record more places."
        raise InvalidInput(message, Fault("first_uT", "too few"))
    difference = b - a
    mean = difference.mean(axis=0)
    effective = _effective(difference - mean)
    covariance = np.cov(difference.T) / effective
    sd = np.sqrt(np.diag(covariance))
    turned, _ = Rotation.align_vectors(a - a.mean(axis=0), b - b.mean(axis=0))
    shift = a.mean(axis=0) - turned.apply(b.mean(axis=0))
    after = turned.apply(b) + shift - a
    p = _hotelling(mean, covariance, effective)
    size, along = float(np.linalg.norm(mean)), mean / max(float(np.linalg.norm(mean)), 1e-12)
    slack = CONFIDENCE_SDS * float(np.sqrt(along @ covariance @ along))
    verdict = _verdict(size - slack, size + slack, tolerance_uT)
    rms, rms_after = (float(np.sqrt(np.mean(each**2))) for each in (difference, after))
    sd_uT, degrees = slack / CONFIDENCE_SDS, np.rad2deg(turned.magnitude())
    words = (
        f"The second reads {size:.2f} ± {sd_uT:.2f} uT apart from the first on average: {_said(verdict)} within "
        f"{tolerance_uT:g} uT. Turned by {degrees:.1f} degrees and shifted it agrees to {rms_after:.2f} uT rms, as it "
        f"is to {rms:.2f}."
    )
    return EquivalentRecords(
        mean, sd, rms, rms_after, turned.as_matrix(), float(turned.magnitude()), shift, len(a), effective, p, verdict,
        words,
    )  # fmt: skip


def pair_by_place(first_m: Array, second_m: Array, within_m: float) -> Pairs:
    """Pairs of readings taken at the same places at other times: for each of the first (n, 2 or 3), the nearest of the
    second (m, 2 or 3) within that distance, if it has one."""
    distance, nearest = cKDTree(second_m).query(first_m, distance_upper_bound=within_m)
    paired = np.isfinite(distance)
    return Pairs(np.flatnonzero(paired), np.asarray(nearest, dtype=np.int64)[paired])


def _worst_draws(
    fit: CalibrationFit, magnitude_uT: float, covariance: Array, other: SensorModel, rng: np.random.Generator
) -> Array:
    """(DRAWS,) worst errors over all directions, with what is not known of both models put upon one, to first order."""
    names = list(fit.parameters)
    draws = rng.multivariate_normal(np.zeros(len(names)), covariance, DRAWS, method="eigh")
    field = magnitude_uT * sphere_directions(300)
    reading = fit.model.distort(field)
    base = other.apply(reading) - field
    worst = np.empty(DRAWS)
    for k, draw in enumerate(draws):
        h, A = _moved(other, dict(zip(names, draw, strict=True)))
        worst[k] = np.linalg.norm(base + (reading - other.hard_iron_uT) @ A.T - h @ other.correction.T, axis=1).max()
    return worst


def _moved(model: SensorModel, by: dict[str, float]) -> tuple[Array, Array]:
    """What changes of a method's parameters do to hard iron (3,) and correction (3, 3), to first order.

    Scales and angles about a sensor that is nearly ideal.
    """
    h = np.array([by.get(f"hard_iron_{axis}_ut", 0.0) for axis in "xyz"])
    distorted, corrected = np.zeros((3, 3)), np.zeros((3, 3))
    for i, row in enumerate("xyz"):
        distorted[i, i] += by.get(f"scale_{row}", 0.0)
        for j, column in enumerate("xyz"):
            distorted[i, j] += by.get(f"distortion_{row}{column}", 0.0)
            named = by.get(f"correction_{row}{column}", by.get(f"correction_{column}{row}", 0.0))
            corrected[i, j] += named
    distorted[1, 0] += by.get("rho_rad", 0.0)
    distorted[2, 0] += by.get("lambda_rad", 0.0)
    distorted[2, 1] += by.get("phi_rad", 0.0)
    return h, corrected - model.correction @ distorted @ model.correction


def _effective(difference: Array) -> float:
    """How many independent pairs n in a row are worth, from how alike neighbours are."""
    r = float(np.sum(difference[1:] * difference[:-1]) / max(float(np.sum(difference**2)), 1e-300))
    n = len(difference)
    r = r if r > 2.0 / np.sqrt(n) else 0.0
    return max(4.0, n * (1.0 - r) / (1.0 + r))


def _hotelling(mean: Array, covariance: Array, effective: float) -> float:
    if np.linalg.matrix_rank(covariance, hermitian=True) < 3:
        return 1.0 if np.allclose(mean, 0.0) else 0.0
    t2 = float(mean @ np.linalg.solve(covariance, mean))
    return float(f.sf(t2 * (effective - 3.0) / (3.0 * (effective - 1.0)), 3, effective - 3.0))


def _verdict(low: float, high: float, tolerance: float) -> Verdict:
    if high <= tolerance:
        return "equivalent"
    return "different" if low > tolerance else "not known"


def _said(verdict: Verdict) -> str:
    return {
        "equivalent": "they are equivalent", "different": "they are not equivalent",
        "not known": "these readings do not tell whether they are equivalent",
    }[verdict]  # fmt: skip
