"""Steps gathered into readings: samples nearer to each other than a cell of the map tell nothing new."""

from dataclasses import replace

import numpy as np

from app.tracking.recent import Reading
from app.tracking.step import Step
from app.tracking.track_state import Tracker, TrackState

__all__ = ["gathered", "moved_on"]

COURSE_M, COURSE_KEPT = 0.7, 0.3  # the course is taken over this distance, and from this part of it on anew
RISE_M = 0.5  # risen or sunk: a reading of its own


def moved_on(tracker: Tracker, state: TrackState, step: Step) -> TrackState:
    """Path and course up to this step."""
    before, place = state.step, state.place_m
    if before is None or place is None:
        here = np.zeros(3) if step.displacement_m is None else np.asarray(step.displacement_m, dtype=np.float64)
        return replace(state, place_m=here, course_from_m=here)
    if step.displacement_m is None:
        unseen_m = tracker.options.speed_m_s * (step.t_s - before.t_s)
        return replace(state, path_m=state.path_m + unseen_m, unseen_m=state.unseen_m + unseen_m)
    here = np.asarray(step.displacement_m, dtype=np.float64)
    path_m = state.path_m + float(np.hypot(*(here - place)[:2]))
    assert state.course_from_m is not None
    way, start = here - state.course_from_m, state.course_from_m
    first, now = state.course_rad
    if np.hypot(way[0], way[1]) > COURSE_M:
        now = float(np.arctan2(way[1], way[0]))
        first = now if np.isnan(first) else first
        start = start + COURSE_KEPT * way
    return replace(
        state, path_m=path_m, place_m=here, course_rad=(first, now), course_from_m=start,
        tells_height=state.tells_height or bool(here[2] != place[2]),
    )  # fmt: skip


def gathered(tracker: Tracker, state: TrackState, step: Step) -> tuple[Reading | None, TrackState]:
    """The samples since the last reading as a new one, once the device is far enough from it."""
    if step.B_uT is None:
        return None, state
    place = state.place_m
    assert place is not None
    told = np.concatenate([place, [step.t_s], step.B_uT])
    total = told if state.gathered is None else state.gathered + told
    count = state.samples + 1
    first, now = state.course_rad
    yaw_rad = step.yaw_rad if step.yaw_rad is not None else (0.0 if np.isnan(now) else now - first)
    if state.recent.readings:
        last = state.recent.readings[-1]
        risen = abs(place[2] - last.displacement_m[2])
        near = state.path_m - state.recent.path_m[-1] < tracker.spacing_m and risen < RISE_M
        turned = abs(np.angle(np.exp(1j * (yaw_rad - last.yaw_rad))))
        if near and turned < tracker.options.update_rad:
            return None, replace(state, samples=count, gathered=total)
    mean = total / count
    reading = Reading(
        step.number, float(mean[3]), mean[4:], count, mean[:3], float(yaw_rad), step.device_to_frame, state.unseen_m
    )
    return reading, replace(state, samples=0, gathered=None, unseen_m=0.0)
