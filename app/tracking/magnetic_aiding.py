"""The loop that carries a drone through an outage of GPS: EKF, GPS while it lasts, then the map (Cuenca, L1049)."""

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from app.geometry import Array
from app.tracking.contour_matching import (
    WINDOW_SETTINGS,
    ContourFix,
    GmaHistory,
    gan_fix,
    gma_fix,
    square_offsets_m,
    window_fix,
)
from app.tracking.inertial_ekf import (
    CUENCA_NOISE,
    InertialNoise,
    correct_position,
    correct_position_and_velocity,
    predict_inertial,
)
from app.tracking.kalman import GaussianBelief, condition_on_position, update
from app.tracking.map_cells import MapCells
from app.tracking.position_fix import FixSettings

__all__ = ["AidedTrack", "Aiding", "GpsReadings", "navigate"]

Method = Literal["none", "gma", "gan", "window"]


@dataclass(frozen=True, slots=True, eq=False)
class Aiding:
    """method: what corrects when GPS gives no position; "window" is ours
    feed: "measurement" of variance `fix_variance_m2`, or "state": the place overwrites the position, without a filter
    always: match while GPS gives positions too (the source's GMA and GAN rows under "position")
    sigma_uT, tolerance_uT: noise of the magnitude; NEDP's tolerance (None: from the map's slope)
    batches: match only when the history is full, and forget it then. Else, as in the source, an offset is applied with
        each reading that the history keeps showing after it was applied: one error is corrected many times over
    every: steps from one magnetometer reading to the next; history: readings that GMA remembers
    """

    method: Method = "none"
    feed: Literal["measurement", "state"] = "measurement"
    always: bool = False
    batches: bool = False
    fix_variance_m2: float = 0.25
    sigma_uT: float = 0.0707
    tolerance_uT: float | None = None
    every: int = 2
    history: int = 50
    noise: InertialNoise = CUENCA_NOISE
    window: FixSettings = WINDOW_SETTINGS
    offset_m: Array = field(default_factory=square_offsets_m)


class GpsReadings(NamedTuple):
    """Positions and velocities (n, 3) of every step, NaN where there is none; their variances per axis."""

    position_m: Array
    velocity_m_s: Array
    position_variance_m2: float = 0.01
    velocity_variance_m2_s2: float = 0.0025


class AidedTrack(NamedTuple):
    """State (n, 9) and sd of the position (n, 2) at every step; what the match is off the belief (n, 2), NaN if none;
    how many window fixes were refused."""

    state: Array
    sd_m: Array
    match_offset_m: Array
    refused: int


def navigate(
    start: GaussianBelief,
    force_m_s2: Array,
    rate_rad_s: Array,
    norm_uT: Array,
    gps: GpsReadings,
    cells: MapCells,
    aiding: Aiding,
    dt_s: float,
) -> AidedTrack:
    """Beliefs at each of n steps from IMU readings (n, 3), magnitudes (n,) and GPS on a map of the magnitude.

    Reading k carries step k to k + 1. The map is asked only while GPS gives no position, unless `always`; its history
    is kept up all the time (Cuenca, L1016).
    """
    n, Q = len(force_m_s2), aiding.noise.covariance
    state, sd_m, off_m = np.empty((n, 9)), np.empty((n, 2)), np.full((n, 2), np.nan)
    belief, history, refused = start, GmaHistory(aiding.offset_m, aiding.history), 0
    outage = _without_position(gps.position_m, round(0.5 / dt_s))
    for k in range(n):
        state[k], sd_m[k] = belief.mean, np.sqrt(np.diag(belief.covariance)[:2])
        belief = _with_gps(belief, gps, k)
        if k % aiding.every == 0 and aiding.method != "none":
            used = bool(outage[k]) or aiding.always
            if aiding.method == "window":
                before = belief
                belief = _with_window(belief, cells, norm_uT[k], aiding) if used else belief
                refused += used and belief is before
            else:
                history = history.push(cells, belief.position_m, norm_uT[k])
                match = _match(history, cells, belief.position_m, norm_uT[k], aiding)
                if match is not None:
                    off_m[k] = match.position_m - belief.position_m
                    if used and (not aiding.batches or history.full):
                        belief = _with_match(belief, match, aiding)
                        history = history.forgotten() if aiding.batches else history
        belief = predict_inertial(belief, force_m_s2[k], rate_rad_s[k], dt_s, Q)
    return AidedTrack(state, sd_m, off_m, refused)


def _with_gps(belief: GaussianBelief, gps: GpsReadings, k: int) -> GaussianBelief:
    position, velocity = gps.position_m[k], gps.velocity_m_s[k]
    here, moving = bool(np.isfinite(position[0])), bool(np.isfinite(velocity[0]))
    if here and moving:
        R = np.diag(np.repeat([gps.position_variance_m2, gps.velocity_variance_m2_s2], 3))
        return correct_position_and_velocity(belief, position, velocity, R).belief
    if here:
        return correct_position(belief, position, gps.position_variance_m2 * np.eye(3)).belief
    if moving:
        return update(belief, velocity, np.eye(3, 9, k=3), gps.velocity_variance_m2_s2 * np.eye(3)).belief
    return belief


def _match(history: GmaHistory, cells: MapCells, centre_m: Array, norm_uT: float, aiding: Aiding) -> ContourFix | None:
    if aiding.method == "gma":
        return gma_fix(history, centre_m)
    return gan_fix(history, cells, centre_m, norm_uT, aiding.sigma_uT, tolerance_uT=aiding.tolerance_uT)


def _with_match(belief: GaussianBelief, match: ContourFix, aiding: Aiding) -> GaussianBelief:
    if aiding.feed == "measurement":
        return correct_position(belief, match.position_m, aiding.fix_variance_m2 * np.eye(2)).belief
    return GaussianBelief(np.concatenate([match.position_m, belief.mean[2:]]), belief.covariance)


def _with_window(belief: GaussianBelief, cells: MapCells, norm_uT: float, aiding: Aiding) -> GaussianBelief:
    fix = window_fix(cells, np.array([norm_uT]), belief.position_m, belief.position_covariance_m2, aiding.sigma_uT,
                     aiding.window)  # fmt: skip
    if fix is None or fix.refused is not None:
        return belief
    return condition_on_position(belief, fix.position_m, fix.covariance_m2)


def _without_position(position_m: Array, patience: int) -> NDArray[np.bool_]:
    """(n,) whether no position came within the last `patience` steps."""
    step = np.arange(len(position_m))
    last = np.maximum.accumulate(np.where(np.isfinite(position_m[:, 0]), step, -patience - 1))
    return np.asarray(step - last > patience)
