"""Calibrate on a map: a walk through a mapped building tells all twelve parameters of a sensor, given where it was.

    R_i m_i = R_i C R_i^T B_map,i + R_i h + e_i + n_i

m_i is the reading in the body's axes, R_i turns body to building, h is the hard iron and C everything else, the
rotation between magnetometer and body included, which no fit of field strengths can see (Shockley, E5; Kuevor, B6). The
map's mean is what is expected given all it knows, so its error e_i is independent of it, and regressing readings on the
map is unbiased, where regressing the map on readings would shrink. e_i goes on along the walk (an Ornstein-Uhlenbeck
process over the distance walked) and is whitened by its own Kalman filter; n_i is the sensor's white noise. The
problem is linear and the prior Gaussian: the answer is exact, iterated only so that spikes and unmapped steel weigh
little.
"""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from app.calibration.coverage import refusal, sphere_coverage
from app.calibration.fit import CalibrationFit, named
from app.calibration.sensor_model import SensorModel
from app.errors import Fault, InvalidInput
from app.geometry import Array

__all__ = ["MAP_AIDED_PARAMETERS", "map_aided"]

MAP_AIDED_PARAMETERS = (
    "hard_iron_x_ut", "hard_iron_y_ut", "hard_iron_z_ut",
    *(f"distortion_{row}{column}" for row in "xyz" for column in "xyz"),
)  # fmt: skip
LEAST_SAMPLES = 20
ROUNDS = 8
DEGREES_OF_FREEDOM = 4.0
"""Of the Student errors that spikes are judged by."""
SPIKE = 0.35
"""Readings that weigh less than this are counted as outliers."""
LEARNED = 0.5
"""A parameter whose sd is still more than this part of what was assumed is not determined."""
FAR_FROM_PRIOR = 3.0
MEDIAN_CHI2 = 2.366
"""The median of chi-square with three degrees of freedom."""


class _Walk(NamedTuple):
    """Readings in the building's axes (n, 3), their design (n, 3, 12), and the variances of both kinds of error."""

    reading_uT: Array
    design: Array
    map_variance_uT2: Array
    keep: Array


def map_aided(
    B_body_uT: Array,
    R_body_to_building: Array,
    B_map_uT: Array,
    map_variance_uT2: Array,
    *,
    path_m: Array | None = None,
    correlation_m: float = 3.0,
    noise_uT: float = 0.4,
    hard_iron_sd_uT: float = 30.0,
    soft_iron_sd: float = 0.1,
) -> CalibrationFit:
    """The twelve parameters from readings (n, 3), attitudes (n, 3, 3) and the map's field where they were taken (n, 3).

    map_variance_uT2 (n, 3): of the map's error in the building's axes, and of what an error of the position adds to it
    (J P J^T); over `correlation_m` of the way `path_m` (n,) it stays the same; no way told: every reading has another.
    noise_uT is white, of the sensor. The sds are of the prior: each component of the hard iron about
    zero, each entry of C about the identity. Where errors turn out larger than told, the covariance grows with them.
    Raises InvalidInput.
    """
    walk = _walk(B_body_uT, R_body_to_building, B_map_uT, map_variance_uT2, path_m, correlation_m)
    prior_mean = np.concatenate([np.zeros(3), np.eye(3).ravel()])
    prior_sd = np.repeat([hard_iron_sd_uT, soft_iron_sd], [3, 9])
    theta, covariance, weight = _regress(walk, prior_mean, prior_sd, noise_uT)
    h, C = theta[:3], theta[3:].reshape(3, 3)
    if np.linalg.cond(C) > 10.0:
        raise refusal(
            "No sensor distorts as these readings do: the positions or attitudes are not where it was", [], "B_map_uT"
        )
    model = SensorModel(h, np.asarray(np.linalg.inv(C)))
    corrected = model.apply(np.asarray(B_body_uT, dtype=np.float64))
    residual = np.linalg.norm(np.einsum("nij,nj->ni", R_body_to_building, corrected) - B_map_uT, axis=1) / np.sqrt(3.0)
    spike = weight < SPIKE
    sd = np.sqrt(np.diag(covariance))
    learned = sd <= LEARNED * prior_sd
    scaled = covariance / np.outer(prior_sd, prior_sd)
    condition = float(np.sqrt(np.linalg.cond(scaled)))
    coverage = sphere_coverage(corrected / np.linalg.norm(corrected, axis=1, keepdims=True), condition)
    names = np.array(MAP_AIDED_PARAMETERS)
    kept = residual[~spike] if not spike.all() else residual
    return CalibrationFit(
        "map_aided", model, named(MAP_AIDED_PARAMETERS, theta), named(MAP_AIDED_PARAMETERS, sd), covariance,
        float(np.sqrt(np.mean(kept**2))), float(kept.max()), len(residual), int(spike.sum()), coverage,
        tuple(names[learned].tolist()), tuple(names[~learned].tolist()),
        _advice(theta, learned, R_body_to_building, hard_iron_sd_uT),
    )  # fmt: skip


def _walk(
    B_body_uT: Array, R: Array, B_map_uT: Array, map_variance_uT2: Array, path_m: Array | None, correlation_m: float
) -> _Walk:
    m, B, variance = (np.asarray(each, dtype=np.float64) for each in (B_body_uT, B_map_uT, map_variance_uT2))
    n = len(m)
    shapes = {"B_body_uT": (m, (n, 3)), "R_body_to_building": (R, (n, 3, 3)), "B_map_uT": (B, (n, 3)),
              "map_variance_uT2": (variance, (n, 3))}  # fmt: skip
    for name, (array, shape) in shapes.items():
        if array.shape != shape or not np.isfinite(array).all():
            message = f"{name} must be {shape} finite numbers; it is {array.shape}. Drop readings off the map first."
            raise InvalidInput(message, Fault(name, "wrong shape or not finite"))
    if n < LEAST_SAMPLES:
        raise refusal(f"{n} readings are too few to calibrate on a map", ["walk on, with turns"])
    way = np.zeros(n) if path_m is None else np.abs(np.diff(path_m, prepend=path_m[0]))
    keep = np.zeros(n) if path_m is None or correlation_m <= 0.0 else np.exp(-way / correlation_m)
    body = np.einsum("nji,nj->ni", R, B)
    design = np.empty((n, 3, 12))
    design[:, :, :3] = R
    design[:, :, 3:] = np.einsum("nij,nk->nijk", R, body).reshape(n, 3, 9)
    return _Walk(np.einsum("nij,nj->ni", R, m), design, variance, keep)


def _regress(walk: _Walk, prior_mean: Array, prior_sd: Array, noise_uT: float) -> tuple[Array, Array, Array]:
    """theta (12,), its covariance, and the weight of every reading (n,)."""
    n = len(walk.reading_uT)
    white = np.full(n, max(noise_uT, 1e-6) ** 2)
    precision = np.diag(prior_sd**-2.0)
    inflation, theta, covariance, weight = 1.0, prior_mean, np.diag(prior_sd**2), np.ones(n)
    joined = np.concatenate([walk.design, walk.reading_uT[:, :, None]], axis=2)
    R = walk.design[:, :, :3]
    for _ in range(ROUNDS):
        turned = R @ theta[3:].reshape(3, 3) @ R.transpose(0, 2, 1)  # what the sensor makes of the map's error
        variance = np.einsum("nij,nj->ni", turned**2, walk.map_variance_uT2)
        whitened = _whiten(joined, variance, white, walk.keep)
        X, y = whitened[:, :, :12].reshape(-1, 12), whitened[:, :, 12].ravel()
        covariance = np.asarray(np.linalg.inv(X.T @ X / inflation + precision), dtype=np.float64)
        theta = covariance @ (X.T @ y / inflation + precision @ prior_mean)
        innovation = (y - X @ theta).reshape(n, 3)
        misfit = np.sum(innovation**2, axis=1)
        inflation = max(1.0, float(np.median(misfit)) / MEDIAN_CHI2)
        # a spike is white noise of a larger variance: the weight of a Student error, never more than one
        weight = np.minimum((DEGREES_OF_FREEDOM + 3.0) / (DEGREES_OF_FREEDOM + misfit / inflation), 1.0)
        white = max(noise_uT, 1e-6) ** 2 / weight
    return theta, covariance, weight


@numba.njit(cache=True, nogil=True)
def _whiten(columns: Array, variance: Array, white: Array, keep: Array) -> Array:
    """Innovations of columns (n, 3, k) over their sds, of an Ornstein-Uhlenbeck error and white noise, axis by axis.

    The error is the unit process u_i = keep_i u_(i-1) + ... times the sd of the map there. Gains are the same for all
    columns. It is the inverse Cholesky factor of the whole covariance, in linear time.
    """
    out = np.empty_like(columns)
    n, axes, k = columns.shape
    state = np.zeros(k)
    for axis in range(axes):
        state[:] = 0.0
        P = 1.0
        for i in range(n):
            P = keep[i] ** 2 * P + 1.0 - keep[i] ** 2
            sd = np.sqrt(variance[i, axis])
            S = variance[i, axis] * P + white[i]
            gain = sd * P / S
            for c in range(k):
                predicted = keep[i] * state[c]
                innovation = columns[i, axis, c] - sd * predicted
                out[i, axis, c] = innovation / np.sqrt(S)
                state[c] = predicted + gain * innovation
            P -= gain * sd * P
    return out


def _advice(theta: Array, learned: NDArray[np.bool_], R: Array, hard_iron_sd_uT: float) -> tuple[str, ...]:
    said = []
    up = R[:, 2]  # the building's vertical in the body's axes
    across = R[:, 0]
    tilt = float(np.sqrt(np.mean(np.sum((up - up.mean(axis=0)) ** 2, axis=1))))
    turned = float(np.sqrt(np.mean(np.sum((across - across.mean(axis=0)) ** 2, axis=1))))
    if not learned.all() and turned < 0.5:
        said.append("the walk hardly turned, so an offset of the sensor looks like one of the map: walk a loop")
    if not learned.all() and tilt < 0.3:
        said.append(
            "the device was never tilted: how much of the vertical is hard iron and how much is scale is not known; "
            "while held as it was, that does no harm; tilt it by 30 degrees and more, both ways, while walking"
        )
    if np.any(np.abs(theta[:3]) > FAR_FROM_PRIOR * hard_iron_sd_uT):
        said.append("the hard iron is far larger than was assumed: give a larger hard_iron_sd_uT")
    return tuple(said)
