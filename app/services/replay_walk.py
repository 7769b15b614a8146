"""Replay a walk whose places are known: window after window as it would have been asked, beside the truth.

Nothing is stored: the walk is read, cut, located and forgotten.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import hypot

import numpy as np
from numpy.typing import NDArray

from app.errors import Fault, InvalidInput
from app.field.samples import Samples
from app.geometry import Array, yaw_matrix
from app.positioning.fix import Fix, LocateOptions
from app.positioning.locate import SearchableFloor, locate
from app.positioning.window import Window
from app.services.judge_windows import PHONE, cut_windows
from app.survey.walk import DeadReckoning, Walk

__all__ = ["MOST_WINDOWS", "Replay", "ReplayedFix", "ask_along", "replay_walk"]

MOST_WINDOWS = 400
_SPACING_M = 0.05  # of samples, at least: finer than any map, and what is nearer was taken standing still
_MOST_SAMPLES = 500  # of a window


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedFix:
    """A window's answer. `t_s`, `truth_m` (3,): of its last sample; error_m: of the posterior's position, along the
    floor; None where nothing was said."""

    t_s: float
    truth_m: Array
    fix: Fix
    error_m: float | None


@dataclass(frozen=True, slots=True, eq=False)
class Replay:
    """A walk and its windows to come: how many, and the path (n, 3) walked, building metres."""

    path_m: Array
    windows: int
    fixes: Iterator[ReplayedFix]


def replay_walk(walk: Walk, floors: list[SearchableFloor], length_m: float, every_m: float) -> Replay:
    """Cut windows of `length_m` metres, one every `every_m` (farther apart when there were more than MOST_WINDOWS).

    They are cut now, and located one by one as `fixes` is read. Raises InvalidInput for a walk that is shorter than a
    window.
    """
    samples, reckoned = ask_along(walk, max(_SPACING_M, length_m / _MOST_SAMPLES))
    walked_m = float(np.linalg.norm(np.diff(reckoned.displacement_m, axis=0), axis=1).sum())
    every_m = max(every_m, (walked_m - length_m) / (MOST_WINDOWS - 1))
    magnitudes = samples.frame != "building" or any(floor.components == "norm" for floor in floors)
    windows = [
        (part.stop - 1, _magnitudes(window) if magnitudes else window)
        for part, window in cut_windows(reckoned, length_m, every_m)
    ]
    if not windows:
        by = "by the device's own steps the walk" if walk.dead_reckoning else "the walk"
        reason = f"{by} is {walked_m:.1f} m long, and a window {length_m:g} m; choose shorter windows or walk farther"
        raise InvalidInput(reason, Fault("/query/window_m", reason))
    options = PHONE if walk.dead_reckoning else LocateOptions()
    fixes = (_answer(samples, last, window, floors, options) for last, window in windows)
    return Replay(samples.p_building_m, len(windows), fixes)


def ask_along(walk: Walk, spacing_m: float) -> tuple[Samples, DeadReckoning]:
    """Samples at least `spacing_m` apart, and what a device would know of itself along them.

    A trace says that itself. Along a table of positions a device is taken that knows its displacements and kept its
    attitude, and does not know which way it faces; where b has no yaw, x of its field is the magnitude.
    """
    reckoned = walk.dead_reckoning or _as_if_reckoned(walk.samples)
    kept = _apart(reckoned.displacement_m, spacing_m)
    heading, sd = reckoned.heading_rad, reckoned.heading_sd_rad
    samples = walk.samples
    return Samples(samples.t_s[kept], samples.p_building_m[kept], samples.B_uT[kept], samples.frame), replace(
        reckoned,
        displacement_m=reckoned.displacement_m[kept],
        yaw_rad=reckoned.yaw_rad[kept],
        B_level_uT=reckoned.B_level_uT[kept],
        q_body_to_level=reckoned.q_body_to_level[kept],
        heading_rad=None if heading is None else heading[kept],
        heading_sd_rad=None if sd is None else sd[kept],
    )


def _apart(displacement_m: Array, spacing_m: float) -> NDArray[np.intp]:
    """The first sample, and each one that is `spacing_m` from the last of these, along the floor."""
    x, y = displacement_m[:, 0].tolist(), displacement_m[:, 1].tolist()
    kept = [0]
    for k in range(1, len(x)):
        if hypot(x[k] - x[kept[-1]], y[k] - y[kept[-1]]) >= spacing_m:
            kept.append(k)
    return np.array(kept)


def _as_if_reckoned(samples: Samples) -> DeadReckoning:
    n = len(samples)
    away_m = (samples.p_building_m - samples.p_building_m[0]) * [1.0, 1.0, 0.0]
    far = int(np.argmax(np.hypot(away_m[:, 0], away_m[:, 1]) > 1.0))
    turn = yaw_matrix(-float(np.arctan2(away_m[far, 1], away_m[far, 0])))
    B_uT = samples.B_uT @ turn.T if samples.frame == "building" else samples.features("norm") * [1.0, 0.0, 0.0]
    nothing = np.zeros(0)
    return DeadReckoning(
        displacement_m=away_m @ turn.T, yaw_rad=np.zeros(n), B_level_uT=B_uT,
        q_body_to_level=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), step_t_s=nothing, step_length_m=nothing,
        heading_rad=None, heading_sd_rad=None, bias_sd_uT=0.0,
    )  # fmt: skip


def _magnitudes(window: Window) -> Window:
    return replace(window, frame="norm", B_uT=np.linalg.norm(window.B_uT, axis=1, keepdims=True))


def _answer(
    samples: Samples, last: int, window: Window, floors: list[SearchableFloor], options: LocateOptions
) -> ReplayedFix:
    fix = locate(window, floors, composition="raw", techniques=(), options=options)
    truth_m = samples.p_building_m[last]
    error_m = None
    if fix.posterior is not None:
        error_m = float(np.linalg.norm(np.array(fix.posterior.position_m[:2]) - truth_m[:2]))
    return ReplayedFix(float(samples.t_s[last]), truth_m, fix, error_m)
