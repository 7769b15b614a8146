"""Where is it? The last metres of a track searched for on all floors: to begin with, and when the track is in doubt."""

from dataclasses import replace

import numpy as np

from app.tracking.estimate import occupied_bins
from app.tracking.moves import window_moves
from app.tracking.particles import Particles, log_evidence, resample, weights
from app.tracking.resampling import enough
from app.tracking.smoother import Lag, Node, along
from app.tracking.start import Found, find
from app.tracking.track_state import MOST_ODDS, Tracker, TrackState

__all__ = ["doubtful", "search", "search_again"]

SEARCH_FROM_M, SEARCH_EVERY_M, SEARCH_AGAIN_M = 4.0, 2.0, 5.0
ENOUGH_BINS = 400  # of place and heading that the belief is in: fewer, and particles can take over
DOUBT = 0.9  # of the probability to be right, below which one looks elsewhere
LONG_ENOUGH = 0.6  # of a whole window, to look elsewhere
MOVED_PRIOR = 0.02  # that a track has gone wrong, when it looks as if


def search(tracker: Tracker, state: TrackState, rng: np.random.Generator) -> TrackState:
    """Look for the last metres everywhere, now and then, and take what is found when it is few places."""
    options = tracker.options
    if state.path_m < SEARCH_FROM_M or state.path_m < state.searched_m + SEARCH_EVERY_M:
        return state
    found = _found(tracker, state, rng)
    state = replace(state, searched_m=state.path_m, log_odds=min(found.log_ratio, MOST_ODDS))
    weight = weights(found.particles)
    if occupied_bins(resample(found.particles, weight, len(weight), 0.5)[0]) > ENOUGH_BINS and (
        state.path_m < options.window_m
    ):
        return replace(state, estimate=tracker.describe(found.particles, weight))
    return _taken(tracker, state, found, rng)


def _found(tracker: Tracker, state: TrackState, rng: np.random.Generator) -> Found:
    options, step = tracker.options, state.step
    assert step is not None
    recent = state.recent.undisturbed()
    window = recent.window(tracker.frame, options.noise_uT, step.heading_rad, step.heading_sd_rad)
    moves = window_moves(recent.readings, tracker.frame, tracker.places, options)
    return find(moves, window, tracker.floors, tracker.places, tracker.barriers, options, None, options.particles, rng)


def _taken(tracker: Tracker, state: TrackState, found: Found, rng: np.random.Generator) -> TrackState:
    """Particles where they were found."""
    weight = weights(found.particles)
    count = enough(found.particles, weight, tracker.options)
    particles, chosen = resample(found.particles, weight, count, float(rng.uniform()))
    recent = state.recent.undisturbed()
    nodes = tuple(
        Node(reading.number, reading.t_s, path_m)
        for reading, path_m in zip(recent.readings, recent.path_m, strict=True)
    )
    lag = along(nodes, found.history_m[:, chosen], particles)
    estimate = tracker.describe(found.particles, weight)
    gains = ((state.path_m, found.log_ratio),)
    return replace(state, particles=particles, lag=lag, gains=gains, estimate=estimate)


def doubtful(tracker: Tracker, state: TrackState) -> bool:
    """Whether it is time to look elsewhere. A window needs to know how it was walked."""
    walked = state.path_m - state.searched_m
    return (
        state.probability < DOUBT
        and walked >= SEARCH_AGAIN_M
        and state.recent.length_m > LONG_ENOUGH * tracker.options.window_m
        and not any(reading.unseen_m for reading in state.recent.readings)
    )


def search_again(tracker: Tracker, state: TrackState, rng: np.random.Generator) -> TrackState:
    """Particles here and elsewhere, each by the odds that they follow the device."""
    assert state.particles is not None
    assert state.lag is not None
    found = _found(tracker, state, rng)
    here = sum(gain for _, gain in state.gains)
    log_odds = np.array([np.log1p(-MOVED_PRIOR) + here, np.log(0.5 * MOVED_PRIOR) + found.log_ratio])
    nowhere = np.log(0.5 * MOVED_PRIOR)
    mapped = np.logaddexp(*log_odds)
    state = replace(state, searched_m=state.path_m, log_odds=float(min(mapped - nowhere, MOST_ODDS)))
    elsewhere = float(np.exp(log_odds[1] - mapped))
    if rng.uniform() >= elsewhere and elsewhere < 0.05:
        return state
    taken = _taken(tracker, state, found, rng)
    if elsewhere > 0.95:
        return taken
    assert taken.particles is not None
    assert taken.lag is not None
    return _mixed(tracker, state, taken, elsewhere)


def _mixed(tracker: Tracker, state: TrackState, taken: TrackState, elsewhere: float) -> TrackState:
    """Both sets of particles, weighing as likely as they are."""
    assert state.particles is not None
    assert taken.particles is not None
    assert state.lag is not None
    assert taken.lag is not None
    old, new = state.particles, taken.particles
    log_weight = np.concatenate([
        old.log_weight - log_evidence(old) + np.log(1.0 - elsewhere),
        new.log_weight - log_evidence(new) + np.log(elsewhere),
    ])  # fmt: skip
    particles = Particles(np.concatenate([old.rows, new.rows]), np.concatenate([old.floor, new.floor]), log_weight)
    nodes = [node for node in state.lag.nodes if node.number in {each.number for each in taken.lag.nodes}]
    mine, theirs = ([k for k, node in enumerate(lag.nodes) if node in nodes] for lag in (state.lag, taken.lag))
    lag = Lag(
        tuple(nodes),
        np.concatenate([state.lag.position_m[mine], taken.lag.position_m[theirs]], axis=1),
        np.concatenate([state.lag.floor[mine], taken.lag.floor[theirs]], axis=1),
    )
    estimate = tracker.describe(particles, weights(particles))
    return replace(state, particles=particles, lag=lag, estimate=estimate)
