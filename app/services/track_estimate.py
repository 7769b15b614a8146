"""What a track says after a step, in the words of the contract: plain values, stored and answered as they are."""

from typing import Any

import numpy as np

from app.attitude.euler import euler_zyx_rad, euler_zyx_variance_rad2
from app.tracking.attitude import Attitude
from app.tracking.estimate import Estimate
from app.tracking.particles import weights
from app.tracking.smoother import Smoothed, settle
from app.tracking.step import Step
from app.tracking.track import Followed
from app.tracking.track_state import Tracker, TrackState

__all__ = ["PATH_NAMES", "SEARCHING", "Told", "path_row", "settled_row", "tell", "unsettled_rows"]

Told = dict[str, Any]

PATH_NAMES = (
    "step", "t_s", "state", "floor_id", "x_m", "y_m", "z_m", "xx_m2", "xy_m2", "yx_m2", "yy_m2", "heading_rad",
    "radius_68_m", "radius_95_m", "probability",
)  # fmt: skip
"""Columns of a path's row; floors by their index, and nothing after `state` where nothing was found yet."""

SEARCHING: Told = {
    "state": "searching",
    "reason": "no step was followed yet; send steps from number 0 on",
    "step": None,
    "t_s": None,
    "probability": 0.0,
    **dict.fromkeys((
        "floor_id", "position_m", "covariance_m2", "heading_rad", "heading_sd_rad", "radius_68_m", "radius_95_m",
        "floor_probability", "measured", "step_scale", "particles", "effective_sample_size",
    )),
    "modes": [],
    "disturbed": False,
    "attitude": None,
}  # fmt: skip
"""The estimate of a track before its first step."""

_UNMAPPED = 0.5
"""Where less of the last metres was measured, they are said to be off the map."""


def tell(tracker: Tracker, followed: Followed) -> Told:
    """The estimate after a step."""
    state, estimate = followed.state, followed.estimate
    assert state.step is not None
    told = {
        **SEARCHING,
        "state": state.state,
        "reason": _reason(state, estimate),
        "step": state.step.number,
        "t_s": state.step.t_s,
        "probability": followed.probability,
        "disturbed": state.disturbed,
        "attitude": None if state.turned is None else _attitude(tracker, state, state.turned),
    }
    return told if estimate is None else told | _place(tracker, estimate)


def _place(tracker: Tracker, estimate: Estimate) -> Told:
    ids = [floor.floor_id for floor in tracker.floors]
    return {
        "floor_id": ids[estimate.floor],
        "position_m": list(estimate.position_m),
        "covariance_m2": estimate.covariance_m2.tolist(),
        "heading_rad": float(estimate.heading_rad),
        "heading_sd_rad": float(estimate.heading_sd_rad),
        "radius_68_m": float(estimate.radius_68_m),
        "radius_95_m": float(estimate.radius_95_m),
        "floor_probability": {
            floor_id: _share(p) for floor_id, p in zip(ids, estimate.floor_probability.tolist(), strict=True)
        },
        "measured": _share(estimate.measured),
        "step_scale": float(estimate.step_scale),
        "particles": int(estimate.particles),
        "effective_sample_size": float(estimate.effective_sample_size),
        "modes": [
            {"floor_id": ids[spot.floor], "position_m": list(spot.position_m), "heading_rad": float(spot.heading_rad),
             "probability": _share(spot.probability)}
            for spot in estimate.spots
        ],
    }  # fmt: skip


def _attitude(tracker: Tracker, state: TrackState, attitude: Attitude) -> Told:
    q, covariance = attitude.q_body_to_frame[None], attitude.covariance_rad2[None]
    assert tracker.attitude is not None
    return {
        "frame": "relative" if tracker.attitude.kind == "none" else "building",
        "orientation": attitude.q_body_to_frame.tolist(),
        **{name: float(angle[0]) for name, angle in euler_zyx_rad(q)._asdict().items()},
        **{
            name.replace("_rad2", "_sd_rad"): float(np.sqrt(variance[0]))
            for name, variance in euler_zyx_variance_rad2(q, covariance)._asdict().items()
        },
        "disturbed": attitude.disturbed,
    }


def _share(p: float) -> float:
    """Sums of weights pass one by a rounding."""
    return min(float(p), 1.0)


def _reason(state: TrackState, estimate: Estimate | None) -> str | None:
    """Why it is not converged, and what would help."""
    if state.state == "converged":
        return None
    if estimate is not None and estimate.measured < _UNMAPPED:
        return "what is walked here is not on the map: walk back to where it was surveyed, or survey this place"
    if state.state == "lost":
        return "the readings no longer fit the place that was followed; walk on, it is searched for again"
    if estimate is not None:
        spread_m = 2.0 * estimate.radius_95_m
        return f"several places fit so far, within {spread_m:.1f} m or elsewhere; walk on, best around a corner"
    return _nothing_found(state)


def _nothing_found(state: TrackState) -> str:
    if not state.recent.readings:
        return "nothing was measured yet; send steps with b_ut"
    return f"{state.path_m:.1f} m were walked so far; walk on: a few metres are searched for at a time"


def path_row(step: Step, followed: Followed) -> list[Any]:
    """A step's row of the path (PATH_NAMES)."""
    row: list[Any] = [step.number, step.t_s, followed.state.state]
    estimate = followed.estimate
    if estimate is None:
        return row
    c = estimate.covariance_m2
    return [
        *row, estimate.floor, *estimate.position_m, *c.ravel().tolist(),
        float(estimate.heading_rad), float(estimate.radius_68_m), float(estimate.radius_95_m), followed.probability,
    ]  # fmt: skip


def settled_row(place: Smoothed) -> list[Any]:
    """A smoothed place: step, time, index of the floor, x, y, z, and its covariance row by row."""
    c = place.covariance_m2
    return [place.node.number, place.node.t_s, place.floor, *place.position_m, *c.ravel().tolist()]


def unsettled_rows(state: TrackState) -> list[list[Any]]:
    """Smoothed places of what is not settled yet, in the light of all steps so far."""
    if state.lag is None or state.particles is None:
        return []
    return [settled_row(place) for place in settle(state.lag, weights(state.particles), np.inf)[1]]
