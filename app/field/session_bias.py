"""Hard iron that a phone's own calibration left behind, one offset per calibration session.

Walks that share a session share an offset in the body frame. Where two walks pass the same place the field is the same,
so what differs is their offsets, each turned by its own attitude:

    B_i - B_j = R_i b_s(i) - R_j b_s(j) + error.

One equation per meeting of two stretches, since errors along a walk are one error over metres; outliers are
down-weighted (Huber), and offsets are shrunk towards zero by a Student prior, so that a session nothing ties stays as
the phone left it and one that is off by 40 uT is found. Turning the phone tells an offset across the vertical; one
along it shows only as a difference between sessions, which walked elsewhere, so it is shrunk harder. One common to all
sessions along the vertical cannot be told from the field; the map then holds it, which is harmless to a phone that has
it too. What is not known of an offset stays with its walks as variance.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from app.field.body_bias import BodyBias, mean_over_stretches, remove_body_bias
from app.field.samples import Components, Samples
from app.geometry import Array

__all__ = [
    "estimate_session_biases", "offset_variance_uT2", "remove_session_biases", "unmet_session",
]  # fmt: skip

STRETCH_M = 0.6
MEETING_M = 2.0
"""Places this near have the same field, compared with the errors of labels: 2-4 uT, flat out to 2 m."""
PATCH_M = 4.0
"""Errors of one walk are one error over about this distance."""
RETURN_M = 10.0
MEETING_SD_UT = 8.0
PRIOR_SCALE_UT, PRIOR_VERTICAL_SCALE_UT, PRIOR_FREEDOM = 3.0, 1.5, 3.0
"""Across and along a session's mean vertical; these and the meetings' sd by walks left out, whole, in a mall."""
WIDEST = (PRIOR_FREEDOM - 2.0) / PRIOR_FREEDOM
"""Precision of a Student distribution over that of its scale."""
_ITERATIONS = 20


@dataclass(frozen=True, slots=True, eq=False)
class _Stretches:
    """Means over short stretches of all walks: place (n, 2), field (n, 3), body to building (n, 3, 3), labels (n,)."""

    position_m: Array
    field_uT: Array
    rotation: Array
    path_m: Array
    walk: NDArray[np.int64]
    session: NDArray[np.int64]


def unmet_session(samples: Samples) -> BodyBias:
    """What is expected of the offset of a session that no other walk shares: none, with the prior's covariance."""
    assert samples.q_body_to_building is not None
    up = Rotation.from_quat(samples.q_body_to_building, scalar_first=True).as_matrix()[:, 2].mean(axis=0)
    return BodyBias(np.zeros(3), np.asarray(np.linalg.inv(WIDEST * _prior_precision(up))))


def offset_variance_uT2(samples: Samples, bias: BodyBias, components: Components) -> Array:
    """(n, c) variance that what is unknown of the offset puts into every sample's features, to first order."""
    assert samples.q_body_to_building is not None
    rotation = Rotation.from_quat(samples.q_body_to_building, scalar_first=True).as_matrix()
    slopes = _feature_slopes(samples.B_uT, components) @ rotation
    return np.asarray(np.einsum("nck,kl,ncl->nc", slopes, bias.covariance_uT2, slopes))


def _feature_slopes(B_uT: Array, components: Components) -> Array:
    """(n, c, 3) derivative of the features by the field: itself, (horizontal, vertical), or norm."""
    if components == "vector":
        return np.broadcast_to(np.eye(3), (len(B_uT), 3, 3))
    level = B_uT * [1.0, 1.0, 0.0] if components == "level" else B_uT
    direction = level / np.maximum(np.linalg.norm(level, axis=1, keepdims=True), 1e-9)
    if components == "norm":
        return np.asarray(direction[:, None, :])
    return np.stack([direction, np.broadcast_to([0.0, 0.0, 1.0], B_uT.shape)], axis=1)


def estimate_session_biases(walks: Mapping[str, Samples]) -> dict[str, BodyBias]:
    """The offset of every session among walks of one floor that know their attitude and their session."""
    known = {name: walks[name] for name in sorted(walks) if _usable(walks[name])}
    sessions = sorted({str(samples.session) for samples in known.values()})
    if not sessions:
        return {}
    stretches = _stretches(known, sessions)
    design, difference_uT = _meetings(stretches, len(sessions))
    bias_uT, covariance = _solve(
        design,
        difference_uT,
        [_prior_precision(stretches.rotation[stretches.session == k, 2].mean(axis=0)) for k in range(len(sessions))],
    )
    parts = [slice(3 * number, 3 * number + 3) for number in range(len(sessions))]
    return {name: BodyBias(bias_uT[p], covariance[p, p]) for name, p in zip(sessions, parts, strict=True)}


def remove_session_biases(walks: Mapping[str, Samples], biases: Mapping[str, BodyBias]) -> dict[str, Samples]:
    """The walks with the offset of their session taken out, where one is known."""
    return {
        name: _without(samples, biases[str(samples.session)]) if samples.session in biases else samples
        for name, samples in walks.items()
    }


def _without(samples: Samples, bias: BodyBias) -> Samples:
    if samples.q_body_to_building is None or samples.frame != "building":
        return samples
    return remove_body_bias(samples, bias)


def _usable(samples: Samples) -> bool:
    return samples.session is not None and samples.q_body_to_building is not None and samples.frame == "building"


def _stretches(walks: Mapping[str, Samples], sessions: list[str]) -> _Stretches:
    parts: list[tuple[Array, ...]] = []
    for number, samples in enumerate(walks.values()):
        assert samples.q_body_to_building is not None
        means = mean_over_stretches(samples, samples.q_body_to_building, STRETCH_M)
        labels = np.full((2, len(means.path_m)), [[number], [sessions.index(str(samples.session))]])
        parts.append((*means, *labels))
    position, field, rotation, path, walk, session = (np.concatenate(each) for each in zip(*parts, strict=True))
    return _Stretches(position, field, rotation, path, walk.astype(np.int64), session.astype(np.int64))


def _meetings(s: _Stretches, sessions: int) -> tuple[Array, Array]:
    """(m, 3, 3 sessions) design and (m, 3) field differences, one row for each patch in which two walks meet."""
    i, j = cKDTree(s.position_m).query_pairs(MEETING_M, output_type="ndarray").T
    kept = (s.walk[i] != s.walk[j]) | (np.abs(s.path_m[i] - s.path_m[j]) > RETURN_M)
    i, j = i[kept], j[kept]
    patch = np.floor(0.5 * (s.position_m[i] + s.position_m[j]) / PATCH_M).astype(np.int64)
    _, group, count = np.unique(
        np.column_stack([s.walk[i], s.walk[j], patch]), axis=0, return_inverse=True, return_counts=True
    )
    m = len(count)
    design, difference_uT = np.zeros((m, sessions, 3, 3)), np.zeros((m, 3))
    share = 1.0 / count[group]
    np.add.at(design, (group, s.session[i]), share[:, None, None] * s.rotation[i])
    np.add.at(design, (group, s.session[j]), -share[:, None, None] * s.rotation[j])
    np.add.at(difference_uT, group, share[:, None] * (s.field_uT[i] - s.field_uT[j]))
    return design.transpose(0, 2, 1, 3).reshape(m, 3, 3 * sessions), difference_uT


def _prior_precision(up_body: Array) -> Array:
    """(3, 3) of a Gaussian of the prior's scales: tighter along the mean vertical up_body (3,) than across."""
    along = np.outer(up_body, up_body) / (up_body @ up_body)
    return np.asarray((np.eye(3) - along) / PRIOR_SCALE_UT**2 + along / PRIOR_VERTICAL_SCALE_UT**2)


def _solve(design: Array, difference_uT: Array, priors: Sequence[Array]) -> tuple[Array, Array]:
    """Robust posterior mean (3 sessions,) and covariance by iteratively reweighted least squares.

    The mean is the mode under the Student prior; the covariance has the prior's variance where nothing ties a session,
    not the curvature at its peak.
    """
    prior = block_diag(*priors)
    bias = np.zeros(len(prior))
    for _ in range(_ITERATIONS):
        left_uT = np.linalg.norm(difference_uT - design @ bias, axis=1)
        weight = MEETING_SD_UT**-2 / np.maximum(1.0, left_uT / (2.0 * MEETING_SD_UT))
        tied = np.einsum("mka,m,mkb->ab", design, weight, design, optimize=True)
        right = np.einsum("mka,m,mk->a", design, weight, difference_uT, optimize=True)
        size = np.sum((bias * (prior @ bias)).reshape(-1, 3), axis=1)
        shrink = np.repeat((PRIOR_FREEDOM + 3.0) / (PRIOR_FREEDOM + size), 3)
        bias = np.linalg.solve(tied + shrink * prior, right)
    return bias, np.linalg.inv(tied + np.minimum(shrink, WIDEST) * prior)
