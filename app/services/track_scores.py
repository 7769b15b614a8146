"""What a filter said along a walk, against where the device was: at every whole metre walked, and at the end."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.services.followed_walks import NOWHERE, Rows, ToldWhat, WalkToFollow

__all__ = ["CHANGED_WITHIN_M", "JudgedTrack", "judge_track"]

CHANGED_WITHIN_M = 10.0
"""Walked after a change of floor, until the filter has to say so."""

LEAST_SD_M = 1e-3
"""A covariance that is smaller, or none at all, says that the place is known without error."""


@dataclass(frozen=True, slots=True)
class JudgedTrack:
    """One filter on one walk.

    error_m              at 0, 1, 2 ... metres truly walked; infinite on a wrong floor or where nothing is said
    state                there, in words
    nees                 there: squared error over its covariance, chi-square of two degrees of freedom if the filter is
                         consistent; NaN on a wrong floor and where nothing is said, infinite where no error is admitted
    converged_m, converged_s   walked and passed until the filter first said "converged"; None: never
    floor_changes, found, made   how often the device truly changed floors, how many of those the filter said
                         CHANGED_WITHIN_M later, and how many changes it said after it had converged
    cpu_ms               of processor time per step
    """

    filter: str
    told: ToldWhat
    floor_id: str
    walk: str
    covered: bool
    length_m: float
    duration_s: float
    error_m: tuple[float, ...]
    state: tuple[str, ...]
    nees: tuple[float, ...]
    end_error_m: float
    end_state: str
    converged_m: float | None
    converged_s: float | None
    floor_changes: int
    floor_changes_found: int
    floor_changes_made: int
    cpu_ms: float


def judge_track(name: str, told: ToldWhat, walk: WalkToFollow, rows: Rows, cpu_ms: float) -> JudgedTrack:
    """Judge what a filter said after each step of a walk."""
    error_m, nees = _errors(walk, rows)
    at = np.searchsorted(walk.walked_m, np.arange(0.0, walk.walked_m[-1] + 1e-9))
    sure = np.flatnonzero(np.array(rows.state) == "converged")
    first = int(sure[0]) if len(sure) else None
    changes, found, made = _floor_changes(walk, rows.floor, first)
    return JudgedTrack(
        filter=name,
        told=told,
        floor_id=walk.floor_id,
        walk=walk.name,
        covered=walk.covered,
        length_m=float(walk.walked_m[-1]),
        duration_s=float(rows.t_s[-1] - rows.t_s[0]),
        error_m=tuple(error_m[at].tolist()),
        state=tuple(rows.state[k] for k in at),
        nees=tuple(nees[at].tolist()),
        end_error_m=float(error_m[-1]),
        end_state=rows.state[-1],
        converged_m=None if first is None else float(walk.walked_m[first]),
        converged_s=None if first is None else float(rows.t_s[first] - rows.t_s[0]),
        floor_changes=changes,
        floor_changes_found=found,
        floor_changes_made=made,
        cpu_ms=cpu_ms,
    )


def _errors(walk: WalkToFollow, rows: Rows) -> tuple[Array, Array]:
    """Error (n,) and NEES (n,) after each step."""
    off_m = rows.position_m - walk.truth_m
    right = (rows.floor == walk.truth_floor) & np.isfinite(off_m).all(axis=1)
    error_m, nees = np.full(len(right), np.inf), np.full(len(right), np.nan)
    error_m[right] = np.linalg.norm(off_m[right], axis=1)
    known = right & np.isfinite(rows.covariance_m2).all(axis=(1, 2))
    sure = known.copy()
    sure[known] = np.linalg.eigvalsh(rows.covariance_m2[known])[:, 0] < LEAST_SD_M**2
    nees[sure], known = np.inf, known & ~sure
    whitened = np.linalg.solve(rows.covariance_m2[known], off_m[known][..., None])[..., 0]
    nees[known] = np.sum(off_m[known] * whitened, axis=1)
    return error_m, nees


def _floor_changes(walk: WalkToFollow, said: NDArray[np.int64], converged: int | None) -> tuple[int, int, int]:
    """Changes of floor: true ones, those of them that are said in time, and those said after it had converged."""
    changed = np.flatnonzero(np.diff(walk.truth_floor)) + 1
    by = np.minimum(np.searchsorted(walk.walked_m, walk.walked_m[changed] + CHANGED_WITHIN_M), len(said) - 1)
    found = int(np.sum(said[by] == walk.truth_floor[changed]))
    if converged is None:
        return len(changed), found, 0
    after = said[converged:]
    return len(changed), found, int(np.count_nonzero(np.diff(after[after != NOWHERE])))
