"""A track: steps in, a belief out, from an unknown start to the end of the walk.

`searching`   the last metres are searched for on all floors (`start`), until particles can take over; then they are
              carried, weighed and resampled step after step, until the belief is in one place
`converged`   it is, and the readings bear it out
`lost`        it was, and they no longer do: what the map predicts is no better than what no map would (`no_map`); the
              last metres are searched for again, and particles found elsewhere take over by the odds of the two

Pure and deterministic: a state is never changed, draws depend on the seed and the step's number alone, so that the same
steps give the same track, bit for bit.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from app.errors import Fault, InvalidInput
from app.positioning.features import common_components
from app.positioning.floors import SearchableFloor, reduce_floor, shared_noise_sd_uT
from app.positioning.window import WindowFrame
from app.tracking.attitude import oriented
from app.tracking.disturbance import PATIENCE_M, RECOVERS, is_disturbed, softened
from app.tracking.estimate import Estimate, carried_on
from app.tracking.gather import gathered, moved_on
from app.tracking.ground import barriers_of
from app.tracking.moves import move_between, offset_variance_uT2
from app.tracking.no_map import predict_without_map, without_map
from app.tracking.options import StartPrior, TrackOptions
from app.tracking.particle_filter import needs_resampling, normalise
from app.tracking.particles import DRAWS, Advance, Particles, advance, resample
from app.tracking.places import make_places
from app.tracking.recent import Reading, Recent
from app.tracking.relocalise import doubtful, search, search_again
from app.tracking.resampling import enough
from app.tracking.smoother import Node, Smoothed, empty_lag, inherit, remember, settle
from app.tracking.start import spread, walkable_cells
from app.tracking.step import Step
from app.tracking.storeys import settle_heights, share_between_floors, through_connectors
from app.tracking.track_state import MOST_ODDS, Tracker, TrackState

__all__ = ["Followed", "TrackState", "Tracker", "begin", "follow", "make_tracker"]

MAPPED = 0.5  # of the last metres, for a claim
STOREY_M = 1.5  # risen or sunk: another floor


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """After a step: the state to go on from, the belief (None: nothing was found yet), how probable it is that it is on

    the map at all, and places settled for good."""

    state: TrackState
    estimate: Estimate | None
    probability: float
    settled: tuple[Smoothed, ...]


def make_tracker(
    floors: Sequence[SearchableFloor],
    frame: WindowFrame,
    options: TrackOptions,
    seed: int,
    prior: StartPrior | None = None,
) -> Tracker:
    """Raises InvalidInput without floors or where no cell of theirs can be walked on, IncompatibleFrames where a map
    cannot answer the frame."""
    if not floors:
        reason = "none of the floors has a map to be followed on; upload surveys and build one"
        raise InvalidInput(reason, Fault("/floor_ids", reason))
    shared = common_components(frame, {floor.floor_id: floor.components for floor in floors})
    noise_sd_uT = shared_noise_sd_uT([floor.grid for floor in floors])
    ready = tuple(reduce_floor(floor, shared, noise_sd_uT) for floor in floors)
    walls = {} if options.ground is None else options.ground.walls
    _check_walkable(ready, options)
    return Tracker(
        ready, make_places(ready), barriers_of(walls, [floor.floor_id for floor in ready]), frame, options, seed, prior
    )


def _check_walkable(floors: Sequence[SearchableFloor], options: TrackOptions) -> None:
    walkable = walkable_cells(options.ground)
    if walkable is None:
        return
    for floor in floors:
        for plane in floor.planes:
            ny, nx = plane.shape
            x, y = (np.asarray(plane.origin_m[k] + plane.resolution_m * np.arange(n)) for k, n in ((0, nx), (1, ny)))
            if walkable(floor.floor_id, x, y).any():
                return
    reason = "no cell of the maps lies in the walkable area: check its coordinates, metres in the building frame"
    raise InvalidInput(reason, Fault("/options/walkable", reason))


def begin() -> TrackState:
    return TrackState()


def follow(tracker: Tracker, state: TrackState, step: Step) -> Followed:
    """One step on. Raises InvalidInput for a step that is not after the last one."""
    _check(state, step)
    if step.inertial is not None:
        step, state = oriented(tracker, state, step, _carried(state))
    state = moved_on(tracker, state, step)
    reading, state = gathered(tracker, state, step)
    if reading is None:
        return _followed(replace(state, step=step), ())
    rng = np.random.Generator(np.random.Philox(key=[tracker.seed, step.number]))
    said, recent = state.estimate, state.recent
    before = recent.readings[-1] if recent.readings else None
    if before is not None and abs(reading.displacement_m[2] - recent.readings[0].displacement_m[2]) > STOREY_M:
        recent = Recent()  # a window is walked on one floor
    recent = recent.with_reading(reading, state.path_m, tracker.options.window_m)
    state = replace(state, step=step, recent=recent)
    move = move_between(before, reading, tracker.frame, tracker.places, tracker.options)
    if state.particles is None:
        settled: tuple[Smoothed, ...] = ()
        if before is None and (tracker.prior is not None or step.displacement_m is None):
            state = _start_around(tracker, state, step, rng)
            state, settled = _weigh(tracker, state, move, before, reading, rng)
        else:
            state = search(tracker, _predict_nothing(tracker, state, move), rng)
    else:
        state, settled = _weigh(tracker, state, move, before, reading, rng)
        if doubtful(tracker, state):
            state = search_again(tracker, state, rng)
    if state.estimate is not said:
        state = replace(state, estimate_from_m=reading.displacement_m)
    return _followed(_judged(tracker, state), settled)


def _followed(state: TrackState, settled: tuple[Smoothed, ...]) -> Followed:
    return Followed(state, _carried(state), state.probability, settled)


def _carried(state: TrackState) -> Estimate | None:
    """The belief, carried on to where the device is by now from where it was last compared with the map."""
    estimate = state.estimate
    if estimate is not None and state.place_m is not None and state.estimate_from_m is not None:
        return carried_on(estimate, state.place_m - state.estimate_from_m)
    return estimate


def _check(state: TrackState, step: Step) -> None:
    if state.step is not None and (step.number <= state.step.number or step.t_s < state.step.t_s):
        raise InvalidInput(
            f"step {step.number} at {step.t_s:g} s does not come after step {state.step.number} at {state.step.t_s:g} s"
        )


def _predict_nothing(tracker: Tracker, state: TrackState, move: Advance) -> TrackState:
    places, options = tracker.places, tracker.options
    nothing = state.no_map or without_map(places, offset_variance_uT2(places, options))
    assert move.features_uT is not None
    nothing, log_density = predict_without_map(nothing, move.features_uT, move.distance_m, move.noise_uT2, places)
    kept = tuple(gain for gain in state.gains if gain[0] >= state.path_m - options.window_m)
    return replace(state, no_map=nothing, gains=(*kept, (state.path_m, -log_density)))


def _start_around(tracker: Tracker, state: TrackState, step: Step, rng: np.random.Generator) -> TrackState:
    """Particles about the place that was told, or everywhere."""
    particles = spread(
        tracker.floors, tracker.places, tracker.prior, step, tracker.frame, tracker.options,
        offset_variance_uT2(tracker.places, tracker.options), rng,
    )  # fmt: skip
    return replace(state, particles=particles, lag=empty_lag(len(particles)), log_odds=0.5 * MOST_ODDS)


def _weigh(
    tracker: Tracker, state: TrackState, move: Advance, before: Reading | None, reading: Reading,
    rng: np.random.Generator,
) -> tuple[TrackState, tuple[Smoothed, ...]]:  # fmt: skip
    """Particles moved to the reading, weighed by it, and resampled when few of them count."""
    assert state.particles is not None
    options = tracker.options
    noise = rng.standard_normal((len(state.particles), DRAWS), dtype=np.float32)
    particles, move, state = _advanced(tracker, state, state.particles, move, noise)
    state = _predict_nothing(tracker, state, move)
    assert state.lag is not None
    weight, gained, _ = normalise(particles.log_weight)
    particles = replace(particles, log_weight=particles.log_weight - gained)
    particles = _on_floors(tracker, state, particles, before, reading, move, rng)
    walked, lost = state.gains[-1]
    if state.disturbed or share_between_floors(particles, weight, tracker.places) > 0.5:
        gained = -lost  # on stairs, and beside a magnet, neither the map nor its absence tells anything
    gains = (*state.gains[:-1], (walked, lost + gained))
    log_odds = min(state.log_odds + lost + gained, MOST_ODDS)
    lag = remember(state.lag, Node(reading.number, reading.t_s, state.path_m), particles)
    lag, settled = settle(lag, weight, state.path_m - options.lag_m)
    estimate = tracker.describe(particles, weight)
    if needs_resampling(weight):
        count = enough(particles, weight, options)
        particles, chosen = resample(particles, weight, count, float(rng.uniform()))
        lag = inherit(lag, chosen)
    return replace(state, particles=particles, lag=lag, gains=gains, log_odds=log_odds, estimate=estimate), settled


def _advanced(
    tracker: Tracker, state: TrackState, particles: Particles, move: Advance, noise: NDArray[np.float32]
) -> tuple[Particles, Advance, TrackState]:
    """Particles at the reading, which counts for little if it is disturbed: the move then, and the state, say so."""
    innovation, components = np.zeros((len(particles), 2)), len(tracker.places.scale)
    moved = advance(particles, move, tracker.places, tracker.barriers, noise, innovation)
    if state.state != "converged" or not is_disturbed(innovation, particles.log_weight, components):
        patience_m = min(state.patience_m + RECOVERS * move.distance_m, PATIENCE_M)
        return moved, move, replace(state, disturbed=False, patience_m=patience_m)
    if state.patience_m <= 0.0:
        return moved, move, replace(state, disturbed=False)
    move = softened(move, innovation, components)
    moved = advance(particles, move, tracker.places, tracker.barriers, noise)
    recent = state.recent.with_last_disturbed()
    left_m = state.patience_m - move.distance_m
    return moved, move, replace(state, recent=recent, disturbed=True, patience_m=left_m)


def _on_floors(
    tracker: Tracker, state: TrackState, particles: Particles, before: Reading | None, reading: Reading, move: Advance,
    rng: np.random.Generator,
) -> Particles:  # fmt: skip
    """Particles that came to another floor."""
    ground = tracker.options.ground
    particles = settle_heights(particles, tracker.places, move.distance_m, move.risen_m)
    if ground is None or not ground.connectors or state.tells_height or before is None:
        return particles
    floor_ids = tuple(floor.floor_id for floor in tracker.floors)
    elapsed_s = reading.t_s - before.t_s
    return through_connectors(particles, tracker.places, floor_ids, ground.connectors, move.distance_m, elapsed_s, rng)


def _judged(tracker: Tracker, state: TrackState) -> TrackState:
    """The belief in words."""
    options, estimate = tracker.options, state.estimate
    if state.particles is None or estimate is None:
        return state
    sure = state.probability * estimate.concentration
    map_m = 2.45 * tracker.places.structure.position_sd_m  # what the radius owes to the map's own places
    radius_m = float(np.sqrt(max(estimate.radius_95_m**2 - map_m**2, 0.0)))
    mapped = estimate.measured >= MAPPED
    if sure >= options.converged_probability and radius_m <= options.converged_radius_m and mapped:
        at_m = state.path_m if state.converged_at_m is None else state.converged_at_m
        return replace(state, state="converged", converged_at_m=at_m)
    if state.state == "converged" and sure >= options.lost_probability and radius_m <= 2.0 * options.converged_radius_m:
        return state
    return replace(state, state="searching" if state.converged_at_m is None else "lost")
