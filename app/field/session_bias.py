"""Hard iron that a phone's own calibration left behind, one offset per calibration session.

Walks that share a session share an offset in the body frame. Where two walks pass the same place the field is the same,
so what differs is their offsets, each turned by its own attitude:

    B_i - B_j = R_i b_s(i) - R_j b_s(j) + error.

One equation per meeting of two stretches, since errors along a walk are one error over metres; outliers are
down-weighted (Huber), and offsets are shrunk towards zero by a Student prior, so that a session nothing ties stays as
the phone left it and one that is off by 40 uT is found. An offset common to all sessions along the vertical cannot be
told from the field; the map then holds it, which is harmless to a phone that has it too.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from app.field.samples import Samples
from app.geometry import Array, rotate_by_quaternion

__all__ = ["SessionBias", "estimate_session_biases", "remove_session_biases"]

STRETCH_M = 0.6
MEETING_M = 2.0
"""Places this near have the same field, compared with the errors of labels: 2-4 uT, flat out to 2 m."""
PATCH_M = 4.0
"""Errors of one walk are one error over about this distance."""
RETURN_M = 10.0
MEETING_SD_UT = 5.5
PRIOR_SCALE_UT, PRIOR_FREEDOM = 5.0, 3.0
_ITERATIONS = 20


@dataclass(frozen=True, slots=True, eq=False)
class SessionBias:
    """bias_body_uT (3,) left in the samples of a session, and its standard deviation (3,)."""

    bias_body_uT: Array
    sd_uT: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Stretches:
    """Means over short stretches of all walks: place (n, 2), field (n, 3), body to building (n, 3, 3), labels (n,)."""

    position_m: Array
    field_uT: Array
    rotation: Array
    path_m: Array
    walk: NDArray[np.int64]
    session: NDArray[np.int64]


def estimate_session_biases(walks: Mapping[str, Samples]) -> dict[str, SessionBias]:
    """The offset of every session among walks of one floor that know their attitude and their session."""
    known = {name: walks[name] for name in sorted(walks) if _usable(walks[name])}
    sessions = sorted({str(samples.session) for samples in known.values()})
    if not sessions:
        return {}
    stretches = _stretches(known, sessions)
    design, difference_uT = _meetings(stretches, len(sessions))
    bias_uT, covariance = _solve(design, difference_uT, len(sessions))
    sd_uT = np.sqrt(np.diag(covariance)).reshape(-1, 3)
    return {name: SessionBias(b, s) for name, b, s in zip(sessions, bias_uT.reshape(-1, 3), sd_uT, strict=True)}


def remove_session_biases(walks: Mapping[str, Samples], biases: Mapping[str, SessionBias]) -> dict[str, Samples]:
    """The walks with the offset of their session taken out, where one is known."""
    return {
        name: _without(samples, biases[str(samples.session)]) if samples.session in biases else samples
        for name, samples in walks.items()
    }


def _without(samples: Samples, bias: SessionBias) -> Samples:
    if samples.q_body_to_building is None or samples.frame != "building":
        return samples
    offset_uT = np.broadcast_to(bias.bias_body_uT, (len(samples), 3))
    return replace(samples, B_uT=samples.B_uT - rotate_by_quaternion(samples.q_body_to_building, offset_uT))


def _usable(samples: Samples) -> bool:
    return samples.session is not None and samples.q_body_to_building is not None and samples.frame == "building"


def _stretches(walks: Mapping[str, Samples], sessions: list[str]) -> _Stretches:
    parts: list[tuple[Array, ...]] = []
    for number, samples in enumerate(walks.values()):
        assert samples.q_body_to_building is not None
        path_m = samples.path_length_m()
        _, start, count = np.unique(np.floor(path_m / STRETCH_M), return_index=True, return_counts=True)
        rotation = Rotation.from_quat(samples.q_body_to_building, scalar_first=True).as_matrix()
        means = [
            np.add.reduceat(values, start, axis=0) / count.reshape(-1, *[1] * (values.ndim - 1))
            for values in (samples.p_building_m[:, :2], samples.B_uT, rotation, path_m)
        ]
        labels = np.full((2, len(start)), [[number], [sessions.index(str(samples.session))]])
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


def _solve(design: Array, difference_uT: Array, sessions: int) -> tuple[Array, Array]:
    """Robust posterior mean (3 sessions,) and covariance by iteratively reweighted least squares."""
    bias = np.zeros(3 * sessions)
    for _ in range(_ITERATIONS):
        left_uT = np.linalg.norm(difference_uT - design @ bias, axis=1)
        weight = MEETING_SD_UT**-2 / np.maximum(1.0, left_uT / (2.0 * MEETING_SD_UT))
        size = np.sum(np.square(bias.reshape(-1, 3)), axis=1) / PRIOR_SCALE_UT**2
        prior = np.repeat((PRIOR_FREEDOM + 3.0) / (PRIOR_FREEDOM + size), 3) / PRIOR_SCALE_UT**2
        precision = np.einsum("mka,m,mkb->ab", design, weight, design, optimize=True) + np.diag(prior)
        covariance = np.linalg.inv(precision)
        bias = covariance @ np.einsum("mka,m,mk->a", design, weight, difference_uT, optimize=True)
    return bias, covariance
