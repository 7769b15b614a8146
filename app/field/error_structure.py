"""How errors of a walk against a map hang together along it: a constant, an Ornstein-Uhlenbeck process, white noise.

A window is a short walk, so its errors have the structure that surveys showed; what a window is worth as independent
samples follows from it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from app.geometry import Array

__all__ = [
    "LABELS_ERR_SHARE",
    "LABELS_ERR_UT",
    "LABELS_SD_M",
    "POSE_LEAVES_M",
    "UNKNOWN_STRUCTURE",
    "ErrorStructure",
    "as_a_pose_leaves_it",
    "labels_err",
    "strictest",
]

LABELS_ERR_SHARE, LABELS_ERR_UT = 0.15, 2.0
"""Share of the field's variance that errors are, and their sd: what is more than both is labels that err, since offset,
attitude and noise of a calibrated sensor do not come to two microtesla."""
POSE_LEAVES_M = 0.5
"""Length over which errors of labels stay alike at the pose that fits a window best."""
LABELS_SD_M = 2.5
"""Sd per axis of the place a window is given on such a map: chosen so that radii hold what they state on windows of the
mapping walks of a mall, told a prior position (docs/evaluation.md)."""


@dataclass(frozen=True, slots=True)
class ErrorStructure:
    """Shares of the variance a map states for one further measurement (its own and its noise's together).

    The covariance of two errors a distance d walked apart is `constant_share + walk_share exp(-d / walk_length_m)`
    times that variance, and `white_share` more at d = 0. They need not sum to one: a map states what covers errors,
    tails and all, and means over a quarter of a metre err less than single readings.

    position_sd_m    per axis, by which places of the map err against where one is; no match can tell
    """

    constant_share: float
    walk_share: float
    white_share: float
    walk_length_m: float
    position_sd_m: float = 0.0

    def __post_init__(self) -> None:
        assert self.constant_share >= 0.0, self
        assert self.walk_share >= 0.0, self
        assert self.white_share > 0.0, self
        assert self.walk_length_m > 0.0, self
        assert self.position_sd_m >= 0.0, self


UNKNOWN_STRUCTURE = ErrorStructure(0.2, 0.5, 0.3, 2.0)
"""What errors are taken to be where no survey can be judged by another."""


def strictest(structures: Sequence[ErrorStructure]) -> ErrorStructure:
    """One structure for floors that are compared: the largest share of every kind, and the longest length."""
    return ErrorStructure(
        max(each.constant_share for each in structures),
        max(each.walk_share for each in structures),
        max(each.white_share for each in structures),
        max(each.walk_length_m for each in structures),
        max(each.position_sd_m for each in structures),
    )


def labels_err(noise_sd_uT: Array, prior_sd_uT: Array) -> bool:
    """Whether errors of sds (c,) about a field of prior sds (c,) are mostly those of the labels of its surveys."""
    error_uT2, field_uT2 = float(np.mean(np.square(noise_sd_uT))), float(np.mean(np.square(prior_sd_uT)))
    return error_uT2 > max(LABELS_ERR_SHARE * field_uT2, LABELS_ERR_UT**2)


def as_a_pose_leaves_it(structure: ErrorStructure) -> ErrorStructure:
    """The structure where it is the labels that err.

    Against its labels a walk errs alike over metres, as its labels do. A window has no labels: its pose is shifted,
    turned and stretched until it fits, which takes what is slow in such errors; what is left changes within half a
    metre. An offset of the sensor no pose takes. Poses are found more often so (docs/evaluation.md). What the pose took
    is then in its place.
    """
    return replace(structure, walk_length_m=min(structure.walk_length_m, POSE_LEAVES_M), position_sd_m=LABELS_SD_M)
