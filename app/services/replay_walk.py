"""Replay a walk whose places are known: window after window as it would have been asked, beside the truth.

Nothing is stored: the walk is read, cut, located and forgotten.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from app.errors import InvalidInput
from app.field.samples import Samples
from app.geometry import Array, yaw_matrix
from app.positioning.fix import Fix, LocateOptions
from app.positioning.locate import SearchableFloor, locate
from app.positioning.window import Window
from app.services.judge_windows import PHONE, SENSOR_NOISE_UT, cut_windows
from app.survey.walk import DeadReckoning, Walk

__all__ = ["MOST_WINDOWS", "Replay", "ReplayedFix", "replay_walk"]

MOST_WINDOWS = 400
_MOST_SAMPLES = 100  # of a window: at a walking pace one every decimetre, and finer than any map


@dataclass(frozen=True, slots=True, eq=False)
class ReplayedFix:
    """A window's answer. `t_s`, `truth_m` (3,): of its last sample; error_m: of the posterior's position, in the plane;
    None where nothing was said, or on another floor."""

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
    """Cut windows of `length_m` metres, one every `every_m` (more when there were more than MOST_WINDOWS).

    A trace is asked by its own dead reckoning; a table of positions by its displacements, heading unknown, in the
    frame it has: level windows from the building frame, else magnitudes. Raises InvalidInput for a walk that is
    shorter than a window.
    """
    samples = walk.samples
    walked_m = float(samples.path_length_m()[-1])
    if walked_m <= length_m:
        raise InvalidInput(f"the walk is {walked_m:.1f} m long; a window needs {length_m:g} m: choose shorter windows")
    every_m = max(every_m, (walked_m - length_m) / (MOST_WINDOWS - 1))
    walk = _thinned(walk, int(len(samples) * length_m / walked_m / _MOST_SAMPLES) + 1)
    samples = walk.samples
    windows = list(_windows(walk, length_m, every_m))
    options = PHONE if walk.dead_reckoning is not None else LocateOptions()
    fixes = (_answer(samples, last, window, floors, options) for last, window in windows)
    return Replay(samples.p_building_m, len(windows), fixes)


def _thinned(walk: Walk, stride: int) -> Walk:
    """Every stride-th sample of a walk, and of what the device knew along it."""
    kept = slice(None, None, stride)
    samples, reckoned = walk.samples, walk.dead_reckoning
    fewer = Samples(samples.t_s[kept], samples.p_building_m[kept], samples.B_uT[kept], samples.frame)
    if reckoned is None:
        return Walk(fewer, walk.report)
    heading, sd = reckoned.heading_rad, reckoned.heading_sd_rad
    return Walk(fewer, walk.report, replace(
        reckoned,
        displacement_m=reckoned.displacement_m[kept],
        yaw_rad=reckoned.yaw_rad[kept],
        B_level_uT=reckoned.B_level_uT[kept],
        q_body_to_level=reckoned.q_body_to_level[kept],
        heading_rad=None if heading is None else heading[kept],
        heading_sd_rad=None if sd is None else sd[kept],
    ))  # fmt: skip


def _windows(walk: Walk, length_m: float, every_m: float) -> Iterator[tuple[int, Window]]:
    """Index of the last sample, and the window that ends there."""
    samples = walk.samples
    reckoned = walk.dead_reckoning
    if reckoned is None and samples.frame == "building":
        reckoned = _as_if_reckoned(samples)
    if reckoned is not None:
        for part, window in cut_windows(reckoned, length_m, every_m):
            yield part.stop - 1, window
        return
    magnitude_uT = samples.features("norm")
    path_m = samples.path_length_m()
    for start_m in np.arange(0.0, path_m[-1] - length_m, every_m):
        first, last = (int(k) for k in np.searchsorted(path_m, [start_m, start_m + length_m]))
        p_m = samples.p_building_m[first : last + 1]
        yield last, Window("norm", magnitude_uT[first : last + 1], p_m - p_m[0], SENSOR_NOISE_UT)


def _as_if_reckoned(samples: Samples) -> DeadReckoning:
    """What a device would know that kept its attitude along the walk, and does not know which way it faces."""
    n = len(samples)
    away_m = samples.p_building_m - samples.p_building_m[0]
    far = int(np.argmax(np.hypot(away_m[:, 0], away_m[:, 1]) > 1.0))
    turn = yaw_matrix(-float(np.arctan2(away_m[far, 1], away_m[far, 0])))
    nothing = np.zeros(0)
    return DeadReckoning(
        displacement_m=away_m @ turn.T, yaw_rad=np.zeros(n), B_level_uT=samples.B_uT @ turn.T,
        q_body_to_level=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)), step_t_s=nothing, step_length_m=nothing,
        heading_rad=None, heading_sd_rad=None, bias_sd_uT=0.0,
    )  # fmt: skip


def _answer(
    samples: Samples, last: int, window: Window, floors: list[SearchableFloor], options: LocateOptions
) -> ReplayedFix:
    fix = locate(window, floors, composition="raw", techniques=(), options=options)
    truth_m = samples.p_building_m[last]
    error_m = None
    if fix.posterior is not None:
        error_m = float(np.linalg.norm(np.array(fix.posterior.position_m[:2]) - truth_m[:2]))
    return ReplayedFix(float(samples.t_s[last]), truth_m, fix, error_m)
