"""One device calibrated again and again: is it still the same sensor, how fast does it drift, and what does that cost?

Calibrations are compared as what they are, estimates with covariances: a weighted mean, a chi-square test of their
scatter about it, and a straight line through time. What a difference means is told as an error of the field.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.stats import chi2

from app.calibration.fit import CalibrationFit, named
from app.calibration.sensor_model import SensorModel
from app.errors import Fault, InvalidInput
from app.geometry import Array

__all__ = ["Drift", "FieldDifference", "field_difference", "fit_drift", "precision_of", "sphere_directions"]

CHANCE = 0.01
"""Below this probability scatter, or a slope, is no longer put down to chance."""
DIRECTIONS = 2000


class FieldDifference(NamedTuple):
    """Of a field of one strength over all directions: the largest error, uT, its root mean square, and where (3,)."""

    worst_uT: float
    rms_uT: float
    worst_direction: Array


@dataclass(frozen=True, slots=True)
class Drift:
    """mean, and rate_per_day with its sd, by parameter; rates are None of a single time.

    chi2 of `degrees` tests that all calibrations are one and the same; `p_same` is the probability of as much scatter
    by chance. `p_line`: of what scatter is left about the straight line, None with fewer than three. `drifting`: names
    whose rates chance does not explain.
    """

    mean: Mapping[str, float]
    mean_sd: Mapping[str, float]
    rate_per_day: Mapping[str, float] | None
    rate_sd_per_day: Mapping[str, float] | None
    chi2: float
    degrees: int
    p_same: float
    p_line: float | None
    drifting: tuple[str, ...]
    words: str

    @property
    def same(self) -> bool:
        """Whether chance explains how the calibrations differ."""
        return self.p_same >= CHANCE


class _Solved(NamedTuple):
    value: Array
    covariance: Array
    chi2: float


def fit_drift(t_day: Sequence[float], fits: Sequence[CalibrationFit]) -> Drift:
    """From calibrations by one method at times, days from any origin. Raises InvalidInput for fewer than two."""
    if len(fits) < 2 or len(fits) != len(t_day):
        message = f"To tell a drift takes at least two calibrations, each with its time; {len(fits)} came."
        raise InvalidInput(message, Fault("fits", "fewer than two"))
    names = tuple(fits[0].parameters)
    for k, fit in enumerate(fits):
        if tuple(fit.parameters) != names or fit.method != fits[0].method:
            message = f"Calibration {k} is by {fit.method}, the first by {fits[0].method}: compare those of one method."
            raise InvalidInput(message, Fault(f"fits/{k}", "another method"))
    value = np.array([list(fit.parameters.values()) for fit in fits])
    precision = np.array([precision_of(fit.covariance) for fit in fits])
    t = np.asarray(t_day, dtype=np.float64)
    t = t - t.mean()
    p = len(names)
    constant = _solve(np.ones((len(t), 1)), value, precision)
    degrees = p * (len(t) - 1)
    p_same = float(chi2.sf(constant.chi2, degrees))
    mean, mean_sd = named(names, constant.value), named(names, np.sqrt(np.diag(constant.covariance)))
    if np.ptp(t) == 0.0:
        words = _words(p_same, (), {}, {}, None)
        return Drift(mean, mean_sd, None, None, constant.chi2, degrees, p_same, None, (), words)
    line = _solve(np.column_stack([np.ones(len(t)), t]), value, precision)
    rate, rate_sd = line.value[p:], np.sqrt(np.diag(line.covariance)[p:])
    p_line = float(chi2.sf(line.chi2, p * (len(t) - 2))) if len(t) > 2 else None
    beyond = chi2.sf((rate / rate_sd) ** 2, 1) < CHANCE / p  # many parameters, so many chances
    drifting = tuple(np.array(names)[beyond].tolist())
    rates, sds = named(names, rate), named(names, rate_sd)
    return Drift(
        mean, mean_sd, rates, sds, constant.chi2, degrees, p_same, p_line, drifting,
        _words(p_same, drifting, rates, sds, p_line),
    )  # fmt: skip


def field_difference(true: SensorModel, assumed: SensorModel, magnitude_uT: float) -> FieldDifference:
    """The error of a field of `magnitude_uT`, any direction, when the sensor is `true` and corrected as `assumed`."""
    direction = sphere_directions(DIRECTIONS)
    field = magnitude_uT * direction
    error = np.linalg.norm(assumed.apply(true.distort(field)) - field, axis=1)
    worst = int(np.argmax(error))
    return FieldDifference(float(error[worst]), float(np.sqrt(np.mean(error**2))), direction[worst])


def sphere_directions(n: int) -> Array:
    """(n, 3) unit vectors evenly over the sphere, along a spiral of the golden angle."""
    z = 1.0 - (2.0 * np.arange(n) + 1.0) / n
    angle = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(n)
    across = np.sqrt(1.0 - z**2)
    return np.column_stack([across * np.cos(angle), across * np.sin(angle), z])


def precision_of(covariance: Array) -> Array:
    """The inverse. Raises InvalidInput where something is said to be known for certain, of exact readings."""
    try:
        return np.asarray(np.linalg.inv(covariance))
    except np.linalg.LinAlgError:
        message = "A calibration without any uncertainty cannot be compared: calibrate from readings of a sensor."
        raise InvalidInput(message, Fault("fits", "a singular covariance")) from None


def _solve(basis: Array, value: Array, precision: Array) -> _Solved:
    """Generalised least squares: value_k = sum_j basis[k, j] x_j, for values (k, p), precisions (k, p, p)."""
    p = value.shape[1]
    design = np.stack([np.kron(row, np.eye(p)) for row in basis])
    normal = np.einsum("kab,kac,kcd->bd", design, precision, design, optimize=True)
    right = np.einsum("kab,kac,kc->b", design, precision, value, optimize=True)
    covariance = np.linalg.inv(normal)
    x = covariance @ right
    off = value - design @ x
    return _Solved(x, covariance, float(np.einsum("ka,kab,kb->", off, precision, off)))


def _words(
    p_same: float, drifting: Sequence[str], rate: Mapping[str, float], sd: Mapping[str, float], p_line: float | None
) -> str:
    if p_same >= CHANCE and not drifting:
        return "The calibrations agree within their uncertainties: one will do for all of them."
    if not drifting:
        return "The calibrations differ by more than their uncertainties, without a trend: calibrate before every use."
    trends = ", ".join(f"{name} by {rate[name]:+.3g} ± {sd[name]:.1g} a day" for name in drifting)
    rest = "; they scatter about that trend too" if p_line is not None and p_line < CHANCE else ""
    return f"The sensor drifts: {trends}{rest}. Calibrate again when that comes to what matters."
