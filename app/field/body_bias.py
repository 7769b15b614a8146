"""Hard iron of a survey that knows its attitude but shares its calibration with no other: from the survey alone.

Turning the sensor turns its offset `b` against the building, and a field that varies smoothly along the path does not
follow. One Gaussian process per component on common hyper-parameters, observed through labels in error:

    B(p) = ambient + f(p) + R b + error,        f ~ s^2 Matern 3/2(length),

is linear in `b` and the ambient field, so both are generalised least squares (Rasmussen & Williams 2006, 2.7), with s^2
concentrated out and the length chosen among a few by marginal likelihood. A label that errs by d metres along each axis
makes an error of variance `6 d^2 / length^2` of the signal's (the slope of f), correlated along the walk. The part of
the offset along the mean vertical of the walk cannot be told from the ambient field and is left in, as by
`session_bias`: tilt by hand is too small, and too much in error, to say it. The covariance takes the attitude as true:
with attitudes in error by 3 degrees for metres the actual error is about twice the stated sd.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from app.field.kernels import covariance
from app.field.samples import Samples
from app.geometry import Array, rotate_by_quaternion

__all__ = [
    "BodyBias", "Stretches", "estimate_body_bias", "mean_over_stretches", "remove_body_bias", "without_body_biases",
]  # fmt: skip

STRETCH_M = 0.3
MAX_STRETCHES = 400
FEWEST_STRETCHES = 20
LENGTHS_M = (1.0, 2.0, 4.0, 8.0)
LABEL_SD_M, LABEL_CORRELATION_M = 0.3, 5.0
WHITE_RATIO = 1e-3
PRIOR_SD_UT = 10.0
PRIOR_VERTICAL_SD_UT = 2.6
"""Along the vertical nothing is learned: what is left there is as expected of a session (`session_bias`)."""
_ITERATIONS = 4


@dataclass(frozen=True, slots=True, eq=False)
class BodyBias:
    """bias_body_uT (3,) that a sensor left in samples, and its covariance (3, 3) uT^2."""

    bias_body_uT: Array
    covariance_uT2: Array

    @property
    def sd_uT(self) -> Array:
        """(3,) standard deviations."""
        return np.asarray(np.sqrt(np.maximum(np.diagonal(self.covariance_uT2), 0.0)))


class Stretches(NamedTuple):
    """Means over stretches: place (n, 2), field (n, 3), body to building (n, 3, 3), distance walked (n,)."""

    position_m: Array
    field_uT: Array
    rotation: Array
    path_m: Array


class _Fit(NamedTuple):
    """Negative log marginal likelihood, s^2, mean (2,) and covariance (2, 2) of the offset across the vertical."""

    nats: float
    signal_variance_uT2: float
    mean_uT: Array
    covariance_uT2: Array


def estimate_body_bias(samples: Samples) -> BodyBias | None:
    """The offset of one walk across its mean vertical; None without attitude, or when it is too short to say."""
    if samples.q_body_to_building is None or samples.frame != "building":
        return None
    stretch_m = max(STRETCH_M, float(samples.path_length_m()[-1]) / MAX_STRETCHES)
    walk = mean_over_stretches(samples, samples.q_body_to_building, stretch_m)
    if len(walk.path_m) < FEWEST_STRETCHES:
        return None
    across = _across_vertical(walk.rotation)
    best = min((_fit(walk, across, length_m) for length_m in LENGTHS_M), key=lambda fit: fit.nats)
    along = np.cross(across[:, 0], across[:, 1])
    unseen_uT2 = PRIOR_VERTICAL_SD_UT**2 * np.outer(along, along)
    return BodyBias(across @ best.mean_uT, across @ best.covariance_uT2 @ across.T + unseen_uT2)


def remove_body_bias(samples: Samples, bias: BodyBias) -> Samples:
    """The samples with the offset taken out. They must know their attitude."""
    assert samples.q_body_to_building is not None
    offset_uT = np.broadcast_to(bias.bias_body_uT, (len(samples), 3))
    return replace(samples, B_uT=samples.B_uT - rotate_by_quaternion(samples.q_body_to_building, offset_uT))


def without_body_biases(walks: Mapping[str, Samples]) -> tuple[dict[str, Samples], dict[str, BodyBias]]:
    """The walks, those of no session without the offset found in them; and these offsets by survey id."""
    found = {name: estimate_body_bias(samples) for name, samples in walks.items() if samples.session is None}
    biases = {name: bias for name, bias in found.items() if bias is not None}
    corrected = {name: remove_body_bias(walks[name], bias) for name, bias in biases.items()}
    return {**walks, **corrected}, biases


def mean_over_stretches(samples: Samples, q_body_to_building: Array, stretch_m: float) -> Stretches:
    """The walk as means over stretches of this length."""
    path_m = samples.path_length_m()
    _, start, count = np.unique(np.floor(path_m / stretch_m), return_index=True, return_counts=True)
    rotation = Rotation.from_quat(q_body_to_building, scalar_first=True).as_matrix()
    return Stretches(
        *(
            np.add.reduceat(values, start, axis=0) / count.reshape(-1, *[1] * (values.ndim - 1))
            for values in (samples.p_building_m[:, :2], samples.B_uT, rotation, path_m)
        )
    )


def _across_vertical(rotation: Array) -> Array:
    """(3, 2) an orthonormal basis of the body frame's directions across the walk's mean vertical."""
    up_body = rotation[:, 2].mean(axis=0)
    return np.asarray(np.linalg.svd(up_body[None])[2][1:].T)


def _fit(walk: Stretches, across: Array, length_m: float) -> _Fit:
    """Generalised least squares at one length: the ambient field (3,) has a flat prior, the offset a Gaussian one."""
    n = len(walk.path_m)
    label_ratio = 6.0 * (LABEL_SD_M / length_m) ** 2
    gram = covariance("matern32", cdist(walk.position_m, walk.position_m), length_m)
    gram += label_ratio * np.exp(-np.abs(walk.path_m[:, None] - walk.path_m) / LABEL_CORRELATION_M)
    gram[np.diag_indices(n)] += WHITE_RATIO
    factor = np.linalg.cholesky(gram)
    columns = np.hstack([np.ones((n, 1)), walk.field_uT, (walk.rotation @ across).reshape(n, 6)])
    white = solve_triangular(factor, columns, lower=True)
    target = white[:, 1:4].T.ravel()
    design = np.zeros((3 * n, 5))
    for component in range(3):
        rows = slice(component * n, (component + 1) * n)
        design[rows, component] = white[:, 0]
        design[rows, 3:] = white[:, 4 + 2 * component : 6 + 2 * component]
    return _least_squares(design, target, 3.0 * float(np.sum(np.log(np.diagonal(factor)))))


def _least_squares(design: Array, target: Array, half_log_det: float) -> _Fit:
    """Whitened observations (m,) on ambient field and offset (m, 5); the signal variance is found on the way."""
    gram, right, energy = design.T @ design, design.T @ target, float(target @ target)
    degrees = len(target) - 3
    variance_uT2 = energy / degrees
    for _ in range(_ITERATIONS):
        precision = gram + np.diag([0.0, 0.0, 0.0, *[variance_uT2 / PRIOR_SD_UT**2] * 2])
        solution = np.linalg.solve(precision, right)
        variance_uT2 = max((energy - float(right @ solution)) / degrees, 1e-6)
    log_det = np.linalg.slogdet(precision)[1] + 2.0 * np.log(PRIOR_SD_UT**2 / variance_uT2)
    nats = 0.5 * degrees * np.log(variance_uT2) + half_log_det + 0.5 * log_det
    covariance_uT2 = variance_uT2 * np.linalg.inv(precision)
    return _Fit(float(nats), variance_uT2, np.asarray(solution[3:]), np.asarray(covariance_uT2[3:, 3:]))
