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

from app.errors import Fault, InvalidInput
from app.geometry import Array
from app.positioning.features import common_components
from app.positioning.floors import SearchableFloor, reduce_floor, shared_noise_sd_uT
from app.positioning.window import WindowFrame
from app.tracking.estimate import Estimate, State, carried_on, describe, kld_sample_size, occupied_bins
from app.tracking.ground import Barriers, barriers_of
from app.tracking.moves import Moves, move_between, offset_variance_uT2, window_moves
from app.tracking.no_map import NoMap, predict_without_map, without_map
from app.tracking.options import StartPrior, TrackOptions
from app.tracking.particles import DRAWS, Particles, advance, effective_sample_size, log_evidence, resample, weights
from app.tracking.places import Places, make_places
from app.tracking.recent import Reading, Recent
from app.tracking.smoother import Lag, Node, Smoothed, along, empty_lag, inherit, remember, settle
from app.tracking.start import Found, find, particles_around
from app.tracking.step import Step

__all__ = ["Followed", "Tracker", "TrackState", "begin", "follow", "make_tracker"]

SEARCH_FROM_M, SEARCH_EVERY_M, SEARCH_AGAIN_M = 4.0, 2.0, 5.0
ENOUGH_BINS = 400  # places of the belief, in bins: fewer, and particles can take over
MOST_ODDS = 12.0  # nats: evidence is not hoarded, so that a device that leaves the map is noticed
MOVED_PRIOR = 0.02  # that a track has gone wrong, when it looks as if
RESAMPLE_BELOW = 0.75  # of the particles (Kuevor, L1565)


@dataclass(frozen=True, slots=True, eq=False)
class Tracker:
    """What stays the same along a track: maps, what is known of the device, and the seed."""

    floors: tuple[SearchableFloor, ...]
    places: Places
    barriers: Barriers
    frame: WindowFrame
    options: TrackOptions
    seed: int
    prior: StartPrior | None = None

    @property
    def spacing_m(self) -> float:
        """Of readings: nearer ones meet the same cell of the map."""
        return max(self.options.update_m, float(self.places.resolution_m.min()))


@dataclass(frozen=True, slots=True, eq=False)
class TrackState:
    """Everything that changes.

    step            the last one followed; `samples` since the last reading: how many, and in `gathered` the sums of their
                    place, time and field
    course_rad      (2,) direction of the path at its start and now, in the track's frame; NaN: not known yet
    particles       None while they are searched for
    log_odds        how much better the particles predict the readings than no map does, kept to MOST_ODDS
    gains           (k, 2) distance walked and log odds gained, of the readings in `recent`
    searched_m      path at the last search
    """

    step: Step | None = None
    samples: int = 0
    gathered: Array | None = None
    path_m: float = 0.0
    course_rad: tuple[float, float] = (np.nan, np.nan)
    course_from_m: Array | None = None
    recent: Recent = Recent()
    particles: Particles | None = None
    lag: Lag | None = None
    no_map: NoMap | None = None
    log_odds: float = 0.0
    gains: tuple[tuple[float, float], ...] = ()
    searched_m: float = 0.0
    state: State = "searching"
    estimate: Estimate | None = None
    converged_at_m: float | None = None


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
    """Raises InvalidInput without floors, IncompatibleFrames where a map cannot answer the frame."""
    if not floors:
        reason = "none of the floors has a map to be followed on; upload surveys and build one"
        raise InvalidInput(reason, Fault("/floor_ids", reason))
    shared = common_components(frame, {floor.floor_id: floor.components for floor in floors})
    noise_sd_uT = shared_noise_sd_uT([floor.grid for floor in floors])
    ready = tuple(reduce_floor(floor, shared, noise_sd_uT) for floor in floors)
    walls = {} if options.ground is None else options.ground.walls
    return Tracker(
        ready, make_places(ready), barriers_of(walls, [floor.floor_id for floor in ready]), frame, options, seed, prior
    )


def begin() -> TrackState:
    return TrackState()


def follow(tracker: Tracker, state: TrackState, step: Step) -> Followed:
    """One step on. Raises InvalidInput for a step that is not after the last one."""
    _check(state, step)
    rng = np.random.Generator(np.random.Philox(key=[tracker.seed, step.number]))
    state = _moved(state, step)
    reading, state = _reading(tracker, state, step)
    if reading is None:
        return _followed(replace(state, step=step), ())
    before = state.recent.readings[-1] if state.recent.readings else None
    keep_m = tracker.options.window_m
    state = replace(state, step=step, recent=state.recent.with_reading(reading, state.path_m, keep_m))
    state = _predict_nothing(tracker, state, before, reading)
    if state.particles is None:
        if before is None and tracker.prior is not None:
            state = _start_around(tracker, state, step, rng)
            settled: tuple[Smoothed, ...] = ()
            state, settled = _weigh(tracker, state, None, reading, rng)
        else:
            state, settled = _search(tracker, state, rng), ()
    else:
        state, settled = _weigh(tracker, state, before, reading, rng)
        if _doubtful(tracker, state):
            state = _search_again(tracker, state, rng)
    return _followed(_judged(tracker, state), settled)


def _followed(state: TrackState, settled: tuple[Smoothed, ...]) -> Followed:
    """The belief, carried on to where the device is by now from where it was last compared with the map."""
    estimate, step = state.estimate, state.step
    if estimate is not None and step is not None and step.displacement_m is not None:
        estimate = carried_on(estimate, step.displacement_m - state.recent.readings[-1].displacement_m)
    return Followed(state, estimate, _sure(state), settled)


def _sure(state: TrackState) -> float:
    """Probability that the particles follow the device."""
    return 0.0 if state.particles is None else float(1.0 / (1.0 + np.exp(-state.log_odds)))


def _check(state: TrackState, step: Step) -> None:
    if state.step is not None and (step.number <= state.step.number or step.t_s < state.step.t_s):
        raise InvalidInput(
            f"step {step.number} at {step.t_s:g} s does not come after step {state.step.number} at {state.step.t_s:g} s"
        )


def _moved(state: TrackState, step: Step) -> TrackState:
    """Path and course up to this step."""
    here = np.zeros(3) if step.displacement_m is None else np.asarray(step.displacement_m, dtype=np.float64)
    if state.step is None or state.step.displacement_m is None:
        return replace(state, course_from_m=here)
    path_m = state.path_m + float(np.hypot(*(here - state.step.displacement_m)[:2]))
    assert state.course_from_m is not None
    way = here - state.course_from_m
    first, now = state.course_rad
    start = state.course_from_m
    if np.hypot(way[0], way[1]) > 0.7:
        now = float(np.arctan2(way[1], way[0]))
        first = now if np.isnan(first) else first
        start = state.course_from_m + 0.3 * way  # the course over the last half metre
    return replace(state, path_m=path_m, course_rad=(first, now), course_from_m=start)


def _reading(tracker: Tracker, state: TrackState, step: Step) -> tuple[Reading | None, TrackState]:
    """The samples since the last reading as a new one, once the device is far enough from it."""
    if step.B_uT is None:
        return None, state
    place = np.zeros(3) if step.displacement_m is None else step.displacement_m
    told = np.concatenate([place, [step.t_s], step.B_uT])
    total = told if state.gathered is None else state.gathered + told
    count = state.samples + 1
    first, now = state.course_rad
    yaw_rad = step.yaw_rad if step.yaw_rad is not None else (0.0 if np.isnan(now) else now - first)
    if state.recent.readings:
        last = state.recent.readings[-1]
        near = state.path_m - state.recent.path_m[-1] < tracker.spacing_m
        turned = abs(np.angle(np.exp(1j * (yaw_rad - last.yaw_rad))))
        if near and turned < tracker.options.update_rad:
            return None, replace(state, samples=count, gathered=total)
    mean = total / count
    reading = Reading(step.number, float(mean[3]), mean[4:], count, mean[:3], float(yaw_rad), step.device_to_frame)
    return reading, replace(state, samples=0, gathered=None)


def _predict_nothing(tracker: Tracker, state: TrackState, before: Reading | None, reading: Reading) -> TrackState:
    places, options = tracker.places, tracker.options
    nothing = state.no_map or without_map(places, offset_variance_uT2(places, options))
    move = move_between(before, reading, tracker.frame, places, options)
    assert move.features_uT is not None
    nothing, log_density = predict_without_map(nothing, move.features_uT, move.distance_m, move.noise_uT2, places)
    kept = tuple(gain for gain in state.gains if gain[0] >= state.path_m - options.window_m)
    return replace(state, no_map=nothing, gains=(*kept, (state.path_m, -log_density)))


def _start_around(tracker: Tracker, state: TrackState, step: Step, rng: np.random.Generator) -> TrackState:
    assert tracker.prior is not None
    particles = particles_around(
        tracker.prior, tracker.places, step.heading_rad, step.heading_sd_rad,
        offset_variance_uT2(tracker.places, tracker.options), tracker.options, tracker.frame, rng,
    )  # fmt: skip
    return replace(state, particles=particles, lag=empty_lag(len(particles)), log_odds=MOST_ODDS / 2)


def _weigh(
    tracker: Tracker, state: TrackState, before: Reading | None, reading: Reading, rng: np.random.Generator
) -> tuple[TrackState, tuple[Smoothed, ...]]:
    """Particles moved to the reading, weighed by it, and resampled when few of them count."""
    assert state.particles is not None
    assert state.lag is not None
    options = tracker.options
    move = move_between(before, reading, tracker.frame, tracker.places, options)
    noise = rng.standard_normal((len(state.particles), DRAWS), dtype=np.float32)
    evidence = log_evidence(state.particles)
    particles = advance(state.particles, move, tracker.places, tracker.barriers, noise)
    gained = log_evidence(particles) - evidence
    walked, lost = state.gains[-1]
    gains = (*state.gains[:-1], (walked, lost + gained))
    log_odds = min(state.log_odds + lost + gained, MOST_ODDS)
    lag = remember(state.lag, Node(reading.number, reading.t_s, state.path_m), particles)
    weight = weights(particles)
    lag, settled = settle(lag, weight, state.path_m - options.lag_m)
    if effective_sample_size(weight) < RESAMPLE_BELOW * len(particles):
        count = _enough(particles, weight, options)
        particles, chosen = resample(particles, weight, count, float(rng.uniform()))
        lag = inherit(lag, chosen)
    return replace(state, particles=particles, lag=lag, gains=gains, log_odds=log_odds), settled


def _enough(particles: Particles, weight: Array, options: TrackOptions) -> int:
    """How many particles the belief needs (KLD)."""
    heavy = weight > 0.01 / len(weight)
    bins = occupied_bins(Particles(particles.rows[heavy], particles.floor[heavy], particles.log_weight[heavy]))
    return int(np.clip(kld_sample_size(bins), options.least_particles, options.particles))


def _search(tracker: Tracker, state: TrackState, rng: np.random.Generator) -> TrackState:
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
        estimate = describe(found.particles, weight, tracker.places.count, tracker.places.structure.position_sd_m**2)
        return replace(state, estimate=estimate)
    return _taken(tracker, state, found, rng)


def _found(tracker: Tracker, state: TrackState, rng: np.random.Generator) -> Found:
    options, step = tracker.options, state.step
    assert step is not None
    window = state.recent.window(tracker.frame, options.noise_uT, step.heading_rad, step.heading_sd_rad)
    moves: Moves = window_moves(state.recent.readings, tracker.frame, tracker.places, options)
    return find(moves, window, tracker.floors, tracker.places, tracker.barriers, options, None, options.particles, rng)


def _taken(tracker: Tracker, state: TrackState, found: Found, rng: np.random.Generator) -> TrackState:
    """Particles where they were found."""
    weight = weights(found.particles)
    count = _enough(found.particles, weight, tracker.options)
    particles, chosen = resample(found.particles, weight, count, float(rng.uniform()))
    nodes = tuple(
        Node(reading.number, reading.t_s, path_m)
        for reading, path_m in zip(state.recent.readings, state.recent.path_m, strict=True)
    )
    return replace(state, particles=particles, lag=along(nodes, found.history_m[:, chosen], particles))


def _doubtful(tracker: Tracker, state: TrackState) -> bool:
    """Whether it is time to look elsewhere."""
    walked = state.path_m - state.searched_m
    return walked >= SEARCH_AGAIN_M and state.recent.length_m > 0.6 * tracker.options.window_m and _sure(state) < 0.9


def _search_again(tracker: Tracker, state: TrackState, rng: np.random.Generator) -> TrackState:
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
    if elsewhere > 0.95:
        return _taken(tracker, state, found, rng)
    taken = _taken(tracker, state, found, rng)
    assert taken.particles is not None
    assert taken.lag is not None
    return _mixed(state, taken, elsewhere)


def _mixed(state: TrackState, taken: TrackState, elsewhere: float) -> TrackState:
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
    return replace(state, particles=particles, lag=lag)


def _judged(tracker: Tracker, state: TrackState) -> TrackState:
    """The belief in words."""
    if state.particles is None:
        return state
    options, structure = tracker.options, tracker.places.structure
    weight = weights(state.particles)
    estimate = describe(state.particles, weight, tracker.places.count, structure.position_sd_m**2)
    sure = _sure(state) * estimate.concentration
    own_radius_m = float(np.sqrt(max(estimate.radius_95_m**2 - (2.45 * structure.position_sd_m) ** 2, 0.0)))
    state = replace(state, estimate=estimate)
    if sure >= options.converged_probability and own_radius_m <= options.converged_radius_m:
        at_m = state.path_m if state.converged_at_m is None else state.converged_at_m
        return replace(state, state="converged", converged_at_m=at_m)
    if (
        state.state == "converged"
        and sure >= options.lost_probability
        and own_radius_m <= 2 * options.converged_radius_m
    ):
        return state
    return replace(state, state="searching" if state.converged_at_m is None else "lost")
