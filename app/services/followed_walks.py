"""A walk to be followed step by step, and what a filter made of it."""

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from app.geometry import Array, rotate_by_quaternion
from app.services.judge_windows import COVERED_SHARE, COVERED_WITHIN_M
from app.survey.walk import Walk
from app.tracking.step import Step

__all__ = [
    "NOWHERE", "Filter", "Rows", "Start", "ToldWhat", "WalkToFollow", "covered", "real_walk", "rows_of", "steps_of",
]  # fmt: skip

NOWHERE = -1
"""The floor of a filter that says none."""

ToldWhat = Literal["nothing", "start, heading"]


class Start(NamedTuple):
    """What filters that cannot find themselves are told: floor, position (2,) and yaw of the track's frame."""

    floor: int
    position_m: tuple[float, float]
    heading_rad: float


@dataclass(frozen=True, slots=True, eq=False)
class WalkToFollow:
    """A held-out walk: what the device sends, and where it truly was, which only judges.

    truth_m (n, 2), truth_floor (n,) number of the floor among those that are searched, walked_m (n,) true distance.
    """

    floor_id: str
    name: str
    covered: bool
    steps: tuple[Step, ...]
    truth_m: Array
    truth_floor: NDArray[np.int64]
    walked_m: Array
    start: Start


class Rows(NamedTuple):
    """What a filter says after each step: floor (n,) or NOWHERE, position (n, 2) and covariance (n, 2, 2), NaN where it

    says nothing, and its state in words (n,): searching, converged or lost."""

    t_s: Array
    floor: NDArray[np.int64]
    position_m: Array
    covariance_m2: Array
    state: tuple[str, ...]


class Filter(Protocol):
    """A technique under comparison: pure, the same rows for the same walk."""

    @property
    def name(self) -> str: ...

    @property
    def told(self) -> ToldWhat: ...

    def follow_walk(self, steps: tuple[Step, ...], start: Start) -> Rows:
        """`start` is the truth, for those who are told."""
        ...


def rows_of(steps: tuple[Step, ...], floor: list[int], position_m: list[Array], covariance_m2: list[Array],
            state: list[str]) -> Rows:  # fmt: skip
    """Rows from lists that grew step by step."""
    t_s = np.array([step.t_s for step in steps])
    return Rows(t_s, np.array(floor, dtype=np.int64), np.array(position_m).reshape(-1, 2),
                np.array(covariance_m2).reshape(-1, 2, 2), tuple(state))  # fmt: skip


def covered(p_m: Array, mapped_m: Array) -> bool:
    """Whether most of a walk (n, 2) lies near walks of the map (m, 2)."""
    distance_m, _ = cKDTree(mapped_m).query(p_m)
    return bool(np.mean(np.asarray(distance_m) <= COVERED_WITHIN_M) >= COVERED_SHARE)


def steps_of(walk: Walk) -> tuple[Step, ...]:
    """Steps of a phone's own reckoning, in the level frame of its first sample; labels do not enter."""
    reckoned = walk.dead_reckoning
    assert reckoned is not None
    c, s = np.cos(reckoned.yaw_rad), np.sin(reckoned.yaw_rad)
    x, y, z = reckoned.B_level_uT.T
    B_uT = np.column_stack([c * x - s * y, s * x + c * y, z])
    heading = None if reckoned.heading_rad is None else reckoned.heading_rad - reckoned.yaw_rad
    sd = reckoned.heading_sd_rad
    return tuple(
        Step(
            k, float(walk.samples.t_s[k]), B_uT[k], reckoned.displacement_m[k], yaw_rad=float(reckoned.yaw_rad[k]),
            heading_rad=None if heading is None else float(heading[k]),
            heading_sd_rad=None if sd is None else float(sd[k]),
        )
        for k in range(len(B_uT))
    )  # fmt: skip


def real_walk(floor_id: str, number: int, name: str, walk: Walk, mapped_m: Array) -> WalkToFollow:
    """A walk of a survey, followed on floor `number` of those searched."""
    p_m = walk.samples.p_building_m[:, :2]
    way_m = np.linalg.norm(np.diff(p_m, axis=0), axis=1)
    return WalkToFollow(
        floor_id=floor_id,
        name=name,
        covered=covered(p_m, mapped_m),
        steps=steps_of(walk),
        truth_m=p_m,
        truth_floor=np.full(len(p_m), number),
        walked_m=np.concatenate([[0.0], np.cumsum(way_m)]),
        start=Start(number, (float(p_m[0, 0]), float(p_m[0, 1])), _frame_yaw_rad(walk)),
    )


def _frame_yaw_rad(walk: Walk) -> float:
    """Yaw in the building of the walk's first level frame, as its labels have it."""
    q, reckoned = walk.samples.q_body_to_building, walk.dead_reckoning
    assert q is not None
    assert reckoned is not None
    inverse = reckoned.q_body_to_level[:1] * [1.0, -1.0, -1.0, -1.0]
    forward = rotate_by_quaternion(q[:1], rotate_by_quaternion(inverse, np.array([[1.0, 0.0, 0.0]])))[0]
    return float(np.arctan2(forward[1], forward[0]))
