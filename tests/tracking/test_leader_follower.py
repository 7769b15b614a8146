"""The controller's step response, the path's geometry, Appendix A, maps of a leader's swath, and small convoys."""

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from app.synthetic.convoy import follow, lead
from app.synthetic.corridor import inside, make_corridor, surveyed_cells
from app.tracking.cross_track import (
    STORMS_GAINS,
    PidGains,
    PidMemory,
    cross_track,
    pid_step,
    place_on_true_path,
    polyline,
    signed_offset,
)
from app.tracking.kalman import constant_velocity
from app.tracking.leader_follower import (
    Follower,
    LeaderLog,
    lateral_offsets_m,
    leader_map,
    outcome_of,
    sensor_places_m,
    turn_command_m_s2,
)
from app.tracking.ml_kalman import MlKalman, start_belief
from app.tracking.position_fix import FixSettings

LITERAL = FixSettings(noise_sd_uT=0.1, map_variance=False)
COORDINATE = st.floats(-5.0, 5.0)
POINT = st.tuples(COORDINATE, COORDINATE).map(np.array)


def step_response(gains, dt_s):
    model, state, memory = constant_velocity(dt_s, 0.0), np.zeros(4), PidMemory()
    y = []
    for _ in range(round(10.0 / dt_s)):
        command, memory = pid_step(gains, memory, 1.0 - state[1], state[3], dt_s)
        state = model.transition @ state + model.control @ np.array([0.0, command])
        y.append(state[1])
    return np.array(y)


def test_step_response_with_the_derivative_on_the_measurement():
    """12.6 % overshoot, 1.0 first crossed at 0.82 s, within 2 % after 1.86 s; 15.3 % when sampled every 0.1 s."""
    y = step_response(STORMS_GAINS, 0.001)
    assert y.max() - 1.0 == pytest.approx(0.126, abs=0.002)
    assert 0.001 * (np.argmax(y >= 1.0) + 1) == pytest.approx(0.82, abs=0.01)
    assert 0.001 * np.flatnonzero(np.abs(y - 1.0) > 0.02)[-1] == pytest.approx(1.86, abs=0.02)
    coarse = step_response(STORMS_GAINS, 0.1)
    assert coarse.max() - 1.0 == pytest.approx(0.153, abs=0.002)
    assert 0.1 * (np.argmax(coarse >= 0.9) + 1) == pytest.approx(0.7)


def test_step_response_with_the_derivative_on_the_error():
    """27 % overshoot when the derivative sees the step: a kick of velocity Kd at once."""
    gains = PidGains(10.0, 0.05, 3.5, derivative_on="error")
    dt = 0.0005
    model, state, memory = constant_velocity(dt, 0.0), np.zeros(4), PidMemory(0.0, 0.0)
    y = []
    for _ in range(round(6.0 / dt)):
        command, memory = pid_step(gains, memory, 1.0 - state[1], state[3], dt)
        state = model.transition @ state + model.control @ np.array([0.0, command])
        y.append(state[1])
    assert max(y) - 1.0 == pytest.approx(0.27, abs=0.01)


def test_a_limited_command_stops_the_integral():
    gains = PidGains(10.0, 1.0, 0.0, limit_m_s2=2.0)
    command, memory = pid_step(gains, PidMemory(), 5.0, 0.0, 0.1)
    assert command == 2.0
    assert memory.integral_m_s == 0.0
    assert pid_step(gains, PidMemory(), -5.0, 0.0, 0.1)[0] == -2.0


def nearest_by_hand(path, point):
    best = (np.inf, None)
    for a, b in pairwise(path):
        share = min(1.0, max(0.0, float((point - a) @ (b - a) / ((b - a) @ (b - a)))))
        place = a + share * (b - a)
        best = min(best, (float(np.hypot(*(place - point))), tuple(place)))
    return best


@given(st.integers(0, 10_000))
def test_cross_track_as_by_hand(seed):
    rng = np.random.default_rng(seed)
    path, point = rng.normal(0.0, 3.0, (7, 2)), rng.normal(0.0, 3.0, 2)
    found = cross_track(path, point)
    distance, place = nearest_by_hand(path, point)
    assert abs(found.error_m) == pytest.approx(distance)
    np.testing.assert_allclose(found.closest_m, place, atol=1e-9)
    assert np.hypot(*found.tangent) == pytest.approx(1.0)
    mirrored = cross_track(path * [1, -1], point * [1, -1])
    assert mirrored.error_m == pytest.approx(-found.error_m)


def test_signs_and_lengths_along_a_corner():
    path = np.array([[0.0, 0.0], [10.0, 0.0], [10.0, -5.0]])
    right = cross_track(path, np.array([4.0, -0.3]))
    assert right.error_m == pytest.approx(0.3)  # the path is to the left: steer left
    np.testing.assert_allclose(right.left, [0.0, 1.0])
    assert right.along_m == pytest.approx(4.0)
    side = cross_track(path, np.array([10.2, -3.0]))
    assert side.error_m == pytest.approx(-0.2)
    assert side.along_m == pytest.approx(13.0)
    assert signed_offset(path, np.array([4.0, -0.3])) == pytest.approx(-0.3)
    beyond = cross_track(path, np.array([10.0, -9.0]))
    np.testing.assert_allclose(beyond.closest_m, [10.0, -5.0])


def test_repeated_points_make_no_segment():
    np.testing.assert_array_equal(polyline(np.array([[0, 0], [0, 0], [1, 0], [1, 0.0]])), [[0, 0], [1, 0]])
    with pytest.raises(AssertionError):
        polyline(np.zeros((3, 2)))


@given(POINT, POINT, POINT, POINT)
def test_appendix_a_is_the_intersection(point, closest, a, b):
    u, d = closest - point, b - a
    cross = u[0] * d[1] - u[1] * d[0]
    assume(np.hypot(*u) > 0.1 and np.hypot(*d) > 0.1 and abs(cross) > 0.05 * np.hypot(*u) * np.hypot(*d))
    moved = place_on_true_path(point, closest, a, b)
    t, s = np.linalg.solve(np.column_stack([u, -d]), a - closest)
    np.testing.assert_allclose(moved - point, t * u, atol=1e-7)
    np.testing.assert_allclose(closest + (moved - point), a + s * d, atol=1e-7)


def test_appendix_a_law_of_sines_where_it_holds():
    """The source's own construction, B' on the forward side of a (Storms, L903-916)."""
    point, closest = np.array([0.0, 0.0]), np.array([0.1, 0.5])
    a, b = np.array([-0.6, 1.1]), np.array([0.9, 1.3])
    u = (closest - point) / np.hypot(*(closest - point))
    A = a - closest
    delta = np.arccos(A @ u / np.hypot(*A))
    direction = (a - b) / np.hypot(*(a - b))
    alpha = np.pi - np.arccos(u @ direction)
    D = np.hypot(*A) * np.sin(delta) / np.sin(alpha)
    meeting = a - D * direction
    np.testing.assert_allclose(place_on_true_path(point, closest, a, b), point + np.hypot(*(closest - meeting)) * u)


def test_appendix_a_has_no_answer_on_the_path_or_for_parallels():
    p, a, b = np.array([1.0, 1.0]), np.zeros(2), np.array([1.0, 0.0])
    assert place_on_true_path(p, p, a, b) is None
    assert place_on_true_path(p, p + b, a, b) is None


def test_places_of_a_row_of_sensors():
    np.testing.assert_allclose(lateral_offsets_m(3), [-0.381, 0.0, 0.381])
    np.testing.assert_allclose(lateral_offsets_m(4), [-0.5715, -0.1905, 0.1905, 0.5715])
    places = sensor_places_m(np.array([[1.0, 2.0], [1.0, 2.0]]), np.array([0.0, -np.pi / 2]), np.array([0.5]))
    np.testing.assert_allclose(places[:, 0], [[1.0, 2.5], [1.5, 2.0]], atol=1e-12)


def l_shaped_log(sensors=3):
    main = np.column_stack([np.arange(0, 8.1, 0.25), np.full(33, 0.0)])
    side = np.column_stack([np.full(24, 8.0), -np.arange(0.25, 6.1, 0.25)])
    position = np.concatenate([main, side])
    heading = np.concatenate([np.zeros(33), np.full(24, -np.pi / 2)])
    offsets = lateral_offsets_m(sensors)
    places = sensor_places_m(position, heading, offsets)
    reading = np.stack([places[..., 0], 2.0 * places[..., 1], places[..., 0] - places[..., 1]], axis=-1)
    return LeaderLog(0.5 * np.arange(57), position, heading, reading, offsets)


def test_leader_map_is_linear_inside_and_unknown_outside():
    cells = leader_map(l_shaped_log(), 0.05, longest_edge_m=1.0)
    inside, outside, corner = np.array([[3.3, 0.2]]), np.array([[3.3, 0.5]]), np.array([[5.0, -2.0]])
    np.testing.assert_allclose(cells.at(inside)[0], [3.3, 0.4, 3.1], atol=1e-9)
    assert np.isnan(cells.at(outside)).all()
    assert np.isnan(cells.at(corner)).all()
    assert np.isfinite(leader_map(l_shaped_log(), 0.05).at(corner)).all()  # the hull of an L holds unseen ground


def test_leader_map_moves_with_its_positions():
    log = l_shaped_log()
    moved = log.corrected(log.position_m + np.array([0.1, 0.0]))
    ours, shifted = leader_map(log, 0.05, longest_edge_m=1.0), leader_map(moved, 0.05, longest_edge_m=1.0)
    np.testing.assert_allclose(shifted.at(np.array([[3.4, 0.1]])), ours.at(np.array([[3.3, 0.1]])), atol=1e-9)


def test_turn_command_turns_the_velocity_in_a_step():
    belief = start_belief(np.zeros(2), np.array([0.5, 0.1]), 0.1, 0.1)
    u = turn_command_m_s2(belief, -np.pi / 2, 0.1)
    np.testing.assert_allclose(belief.mean[2:] + 0.1 * u, [0.1, -0.5], atol=1e-12)


def test_steering_is_sideways_only():
    path = np.array([[0.0, 0.0], [1.0, 0.3], [2.0, 0.0], [9.0, 0.0]])  # a kink
    follower = Follower(MlKalman(leader_map(l_shaped_log(), 0.1), LITERAL, 0.01), path)
    steering = follower.steer(start_belief(np.array([1.5, 0.0]), np.array([0.5, 0.0]), 0.1, 0.1), PidMemory(), 0.0, 0.1)
    assert steering.control_m_s2[0] == 0.0
    assert steering.control_m_s2[1] > 0.0


def test_outcomes():
    assert [outcome_of(m) for m in (None, 3.0, 10.0, 16.0)] == ["no turn", "past turn", "successful", "complete"]


@pytest.fixture(scope="module")
def convoy():
    rng = np.random.default_rng(4)
    corridor = make_corridor(rng)
    cells = surveyed_cells(corridor, rng)
    leader = lead(corridor, MlKalman(cells, LITERAL, 0.02**2), rng, 4)
    return corridor, leader


def test_leader_knows_its_way(convoy):
    _, leader = convoy
    filtered, later = (np.sqrt(np.mean(np.sum((p - leader.true_m) ** 2, axis=1)))
                       for p in (leader.log.position_m, leader.smoothed_m))  # fmt: skip
    assert later < filtered < 0.3


def followed(convoy, turn=True, seed=0):
    corridor, leader = convoy
    log = leader.log.corrected(leader.smoothed_m)
    cells = leader_map(log, 0.0762, longest_edge_m=1.0)
    follower = Follower(MlKalman(cells, LITERAL, 0.02**2), polyline(log.position_m))
    place = log.position_m[leader.turn_sample] if turn else None
    return follow(corridor, follower, leader, place, np.random.default_rng(seed), reset=True)


def test_followers_come_around_the_corner(convoy):
    _, leader = convoy
    runs = [followed(convoy, seed=seed) for seed in range(4)]
    assert sum(run.outcome in ("complete", "successful") for run in runs) >= 2
    across = [np.median([abs(cross_track(leader.true_m, p).error_m) for p in run.true_m[::10]]) for run in runs]
    assert np.median(across) < 0.4
    assert all(inside(run.true_m, 1e-6).all() for run in runs)  # who left was put back


def test_followers_do_not_without_the_turn_command(convoy):
    assert followed(convoy, turn=False).outcome not in ("complete",)
