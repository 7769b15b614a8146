"""Log likelihood of a magnetic reading at particles: Gaussian, of one to three components.

R is the sensor's variance plus the map's at each particle, so the log determinant differs between particles and is
kept; only `literal` is the source's, with a constant R (Kuevor, eq. 4.8). Readings come in the building frame, in the
level frame with a heading per particle (`turned`), or as norms (`norm_of` makes a norm map of a vector map).

Cells that nobody measured tell nothing (`neutral`): each particle there gets the mean likelihood of the mapped ones
under their weights, so that all of them together keep exactly the share of the weight they had. The alternative,
`look_up`'s prior density as it stands, is right for one reading of a field drawn from the prior; but readings in one
unmapped cell are of one unknown value, and taking each for a new surprise costs a true particle log(prior sd / noise)
per component and reading, until any mapped one that fits roughly has won.
"""

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.tracking.field_lookup import Looked

__all__ = ["literal", "log_likelihood", "neutral", "norm_of", "turned"]

_LOG_2_PI = float(np.log(2.0 * np.pi))
_LEAST_NORM_UT = 1e-6


def log_likelihood(looked: Looked, reading_uT: Array, sensor_variance_uT2: Array | float) -> Array:
    """(n,) log density of a reading (c,) or (n, c) under the map and the sensor; variance (c,) or one for all.

    NaN components were not read and are left out.
    """
    variance = looked.variance_uT2 + sensor_variance_uT2
    off = reading_uT - looked.mean_uT
    terms = np.square(off) / variance + np.log(variance) + _LOG_2_PI
    return np.asarray(-0.5 * np.sum(np.where(np.isnan(off), 0.0, terms), axis=1))


def literal(looked: Looked, reading_uT: Array, R_mag_uT2: Array | float) -> Array:
    """(n,) exponent of the source, with a constant covariance: a variance for all, (c,) or (c, c) (Kuevor, eq. 4.8)."""
    off = reading_uT - looked.mean_uT
    if np.ndim(R_mag_uT2) == 2:
        return np.asarray(-0.5 * np.sum(off.T * np.linalg.solve(R_mag_uT2, off.T), axis=0))
    return np.asarray(-0.5 * np.sum(np.square(off) / R_mag_uT2, axis=1))


def turned(reading_level_uT: Array, heading_rad: Array) -> Array:
    """(n, 3) a level reading (3,) in the building frame, as each particle's heading (n,) has it."""
    c, s = np.cos(heading_rad), np.sin(heading_rad)
    x, y, z = reading_level_uT
    return np.stack([c * x - s * y, s * x + c * y, np.full(len(c), z)], axis=1)


def norm_of(looked: Looked) -> Looked:
    """The norm of a vector map, its variance to first order: no map of norms is needed (Kuevor, L892-L894)."""
    norm = np.linalg.norm(looked.mean_uT, axis=1, keepdims=True)
    along = looked.mean_uT / np.maximum(norm, _LEAST_NORM_UT)
    return Looked(norm, np.sum(np.square(along) * looked.variance_uT2, axis=1, keepdims=True), looked.measured)


def neutral(log_l: Array, measured: NDArray[np.bool_], log_weight: Array) -> Array:
    """Log likelihoods (n,), those of unmeasured places replaced by the mapped particles' mean under log weights (n,).

    Zeros where no particle of any weight is mapped.
    """
    if measured.all():
        return log_l
    known = measured & (log_weight > -np.inf)
    if not known.any():
        return np.zeros_like(log_l)
    both, weight = log_l[known] + log_weight[known], log_weight[known]
    mean = np.logaddexp.reduce(both) - np.logaddexp.reduce(weight)
    return np.where(measured, log_l, mean)
