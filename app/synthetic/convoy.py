"""A leader and its follower in Storms' corridor: true vehicles, what they read, how one fares (Storms 1.14-1.18)."""

from dataclasses import dataclass

import numpy as np

from app.geometry import Array
from app.synthetic.corridor import CORNER_M, WIDTH_M, Corridor, inside, walk_corridor
from app.tracking.cross_track import PidMemory
from app.tracking.kalman import GaussianBelief, constant_velocity, predict, smooth
from app.tracking.leader_follower import (
    COMPLETE_M,
    Follower,
    LeaderLog,
    lateral_offsets_m,
    outcome_of,
    sensor_places_m,
    turn_command_m_s2,
)
from app.tracking.ml_kalman import MlKalman, start_belief

__all__ = ["FollowerRun", "LeaderRun", "follow", "lead"]

TURN_RAD = -np.pi / 2.0
_STEP_S, _SAMPLE_STEPS, _FIX_STEPS = 0.1, 5, 15  # Storms, L589, L819


@dataclass(frozen=True, slots=True, eq=False)
class LeaderRun:
    """What a leader shared, its true positions (n, 2) at the same times, those smoothed later (n, 2), and the sample

    at which it turned.
    """

    log: LeaderLog
    true_m: Array
    smoothed_m: Array
    turn_sample: int


@dataclass(frozen=True, slots=True, eq=False)
class FollowerRun:
    """True and estimated positions (n, 2) every 0.1 s; how far past the corner it came (None: not around it); whether

    it left the hallways for good, and how often it was put back.
    """

    true_m: Array
    estimated_m: Array
    past_corner_m: float | None
    left: bool
    resets: int

    @property
    def outcome(self) -> str:
        return outcome_of(self.past_corner_m)


def lead(
    corridor: Corridor,
    tracker: MlKalman,
    rng: np.random.Generator,
    sensors: int,
    *,
    noise_uT: float = 0.1,
    sigma_a: float = 0.02,
    start_sd_m: float = 0.1,
) -> LeaderRun:
    """A walk along both hallways, its own estimate on a map it has, and its row of sensors read every 0.5 s.

    It knows its start to `start_sd_m`, its turn, and corrects itself with its middle every 1.5 s. It walks as far as a
    follower has to for a complete run.
    """
    state, turn = _whole_walk(rng, sigma_a)
    belief = start_belief(state[0, :2] + start_sd_m * rng.normal(size=2), np.array([0.5, 0.0]), start_sd_m, 0.05)
    filtered, predicted, transitions = [belief], [], []
    for k in range(1, len(state)):
        turns = TURN_RAD if (k - 1) * _SAMPLE_STEPS <= turn < k * _SAMPLE_STEPS else 0.0
        belief = tracker.advance(belief, _SAMPLE_STEPS * _STEP_S, turn_rad=turns)
        predicted.append(belief)
        transitions.append(tracker.transition(_SAMPLE_STEPS * _STEP_S, turns))
        if k * _SAMPLE_STEPS % _FIX_STEPS == 0:
            reading = corridor.field_uT(state[k : k + 1, :2])[0] + noise_uT * rng.normal(size=3)
            belief = tracker.correct(belief, reading).belief
        filtered.append(belief)
    later = smooth(filtered, predicted, transitions)
    heading = np.where(np.arange(len(state)) * _SAMPLE_STEPS > turn, TURN_RAD, 0.0)
    offsets = lateral_offsets_m(sensors)
    places = sensor_places_m(state[:, :2], heading, offsets)
    reading = corridor.field_uT(places.reshape(-1, 2)).reshape(places.shape[0], sensors, 3)
    reading += noise_uT * rng.normal(size=reading.shape)
    estimated = np.array([each.position_m for each in filtered])
    t_s = np.asarray(np.arange(len(state)) * (_SAMPLE_STEPS * _STEP_S))
    log = LeaderLog(t_s, estimated, heading, reading, offsets)
    return LeaderRun(log, state[:, :2], np.array([each.position_m for each in later]), round(turn / _SAMPLE_STEPS))


def follow(
    corridor: Corridor,
    follower: Follower,
    leader: LeaderRun,
    turn_place_m: Array | None,
    rng: np.random.Generator,
    *,
    reset: bool,
    noise_uT: float = 0.1,
    sigma_a: float = 0.02,
    start_sd_m: float = 0.1,
    duration_s: float = 180.0,
    reset_m: float = 0.3,
) -> FollowerRun:
    """Drive one follower until it has come 16 m along the side hallway, is out of the hallways, or out of time.

    The leader's turn is carried out where the follower thinks it passes `turn_place_m` (2,), the leader's estimate of
    it; None: it was not shared. `reset` puts a vehicle that leaves the hallways `reset_m` beyond the centre line
    (Storms, L791); the filter is not told.
    """
    path_m = follower.path_m
    true = np.concatenate([leader.true_m[0], [0.5, 0.0]])
    belief = start_belief(path_m[0] + start_sd_m * rng.normal(size=2), np.array([0.5, 0.0]), start_sd_m, 0.05)
    memory, turned, resets = PidMemory(), False, 0
    model = constant_velocity(_STEP_S, sigma_a**2)
    root = np.linalg.cholesky(model.process_noise)
    places, estimates, left = [true[:2]], [belief.position_m], False
    for k in range(1, round(duration_s / _STEP_S) + 1):
        steering = follower.steer(belief, memory, TURN_RAD if turned else 0.0, _STEP_S)
        control, memory = steering.control_m_s2, steering.memory
        if turn_place_m is not None and not turned:
            turned = bool(belief.position_m[0] >= turn_place_m[0])
            if turned:  # the turn takes one step, in which nothing else is steered
                control = turn_command_m_s2(belief, TURN_RAD, _STEP_S)
        true = model.transition @ true + model.control @ control + root @ rng.normal(size=4)
        belief = predict(belief, constant_velocity(_STEP_S, follower.tracker.acceleration_psd_m2_s3), control)
        if not inside(true[:2]):
            left = left or not reset
            if not reset:
                break
            true, resets = _put_back(true, reset_m), resets + 1
        if k % _FIX_STEPS == 0:
            belief = _corrected(corridor, follower, belief, true, noise_uT, rng)
        places.append(true[:2])
        estimates.append(belief.position_m)
        if _past_corner_m(true) >= COMPLETE_M:
            break
    reached = max(_past_corner_m(place) for place in places)
    return FollowerRun(np.array(places), np.array(estimates), reached if reached > 0.0 else None, left, resets)


def _whole_walk(rng: np.random.Generator, sigma_a: float) -> tuple[Array, int]:
    """True states (n, 4) every 0.5 s of a walk as long as a complete run, and the step it turned before."""
    while True:
        walks = walk_corridor(rng, 16, sigma_a)
        whole = np.flatnonzero(-walks.state[:, -1, 1] - WIDTH_M >= COMPLETE_M)
        if len(whole):
            return walks.state[whole[0], ::_SAMPLE_STEPS], int(walks.turn_step[whole[0]])


def _corrected(
    corridor: Corridor,
    follower: Follower,
    belief: GaussianBelief,
    true: Array,
    noise_uT: float,
    rng: np.random.Generator,
) -> GaussianBelief:
    reading = corridor.field_uT(true[None, :2])[0] + noise_uT * rng.normal(size=3)
    return follower.tracker.correct(belief, reading).belief


def _past_corner_m(true: Array) -> float:
    """How far into the side hallway a vehicle is, from where it leaves the main one."""
    return float(-true[1] - WIDTH_M)


def _put_back(true: Array, reset_m: float) -> Array:
    """On the other side of the centre line of the hallway it left; its velocity stays."""
    out = true.copy()
    axis = 0 if true[1] < -WIDTH_M and true[0] > CORNER_M[0] - WIDTH_M else 1
    out[axis] = CORNER_M[axis] - np.sign(true[axis] - CORNER_M[axis]) * reset_m
    if not inside(out[:2]):  # past the corner's outer wall, or the end of a hallway
        out[0] = min(max(out[0], 0.0), CORNER_M[0] - np.sign(out[0] - CORNER_M[0]) * reset_m)
    return out
