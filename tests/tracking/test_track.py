"""Tracks: found from nowhere, followed, lost and found again; the same bits for the same steps."""

from collections.abc import Callable, Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from app.errors import IncompatibleFrames, InvalidInput
from app.field.grid import FieldGrid
from app.positioning.floors import prepare_floor, prepare_floors
from app.tracking.estimate import Estimate
from app.tracking.ground import Connector, Ground
from app.tracking.options import StartPrior, TrackOptions
from app.tracking.step import Step
from app.tracking.track import Followed, Tracker, TrackState, begin, follow, make_tracker

Array = NDArray[np.float64]
FEW = TrackOptions(particles=4000, window_m=8.0)


def walk_on(tracker: Tracker, steps: Sequence[Step], state: TrackState | None = None) -> list[Followed]:
    state = state or begin()
    out = []
    for step in steps:
        followed = follow(tracker, state, step)
        state = followed.state
        out.append(followed)
    return out


def error_m(estimate: Estimate | None, truth_m: Array) -> float:
    assert estimate is not None
    return float(np.linalg.norm(np.array(estimate.position_m[:2]) - truth_m[:2]))


@pytest.fixture(scope="module")
def grids(grid_of: Callable[..., FieldGrid]) -> dict[str, FieldGrid]:
    """Two floors, four metres apart."""
    return {
        "ground": grid_of(np.random.default_rng(11)),
        "first": grid_of(np.random.default_rng(12), height_m=5.2),
    }


def tracker_on(grids: dict[str, FieldGrid], frame: str = "level", **about: Any) -> Tracker:
    options = about.pop("options", FEW)
    return make_tracker(prepare_floors(grids), frame, options, seed=about.pop("seed", 1), **about)  # type: ignore[arg-type]


@pytest.mark.parametrize("floor", ["ground", "first"])
def test_a_device_is_found_and_followed_from_an_unknown_start(
    grids: dict[str, FieldGrid], floor: str, carried_over: Callable[..., Any], path_of: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(3)
    device = carried_over(rng, grids[floor], path_of(rng, 16.0), offset_uT=(0.4, -0.3, 0.2), scale=0.97)
    followed = walk_on(tracker_on(grids), device.steps)
    end = followed[-1]
    assert end.state.state == "converged"
    assert end.estimate is not None
    assert ("ground", "first")[end.estimate.floor] == floor
    assert error_m(end.estimate, device.truth_m[-1]) < 0.5
    assert end.estimate.heading_rad == pytest.approx(device.yaw_rad, abs=0.15)
    assert end.estimate.step_scale == pytest.approx(1 / 0.97, abs=0.06)
    claims = [
        error_m(each.estimate, truth)
        for each, truth in zip(followed, device.truth_m, strict=True)
        if each.state.state == "converged"
    ]
    assert len(claims) > 40
    assert max(claims) < 1.0


def test_the_same_steps_give_the_same_bits_and_a_state_is_never_changed(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any], path_of: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(4)
    steps = carried_over(rng, grids["ground"], path_of(rng, 10.0)).steps
    once, again = (walk_on(tracker_on(grids), steps) for _ in range(2))
    for one, other in zip(once, again, strict=True):
        assert_same(one, other)
    middle = len(steps) // 2
    resumed = walk_on(tracker_on(grids), steps[middle:], once[middle - 1].state)  # from a state that was gone on from
    assert_same(resumed[-1], once[-1])
    other_seed = walk_on(tracker_on(grids, seed=2), steps)[-1]
    assert other_seed.estimate is not None
    assert once[-1].estimate is not None
    assert other_seed.estimate.position_m != once[-1].estimate.position_m


def assert_same(a: Any, b: Any) -> None:
    """Equal, field by field and bit by bit."""
    assert type(a) is type(b)
    if is_dataclass(a):
        for each in fields(a):
            assert_same(getattr(a, each.name), getattr(b, each.name))
    elif isinstance(a, np.ndarray):
        np.testing.assert_array_equal(a, b)
    elif isinstance(a, tuple):
        assert len(a) == len(b)
        for x, y in zip(a, b, strict=True):
            assert_same(x, y)
    else:
        assert a == b or (a != a and b != b)  # NaN


def test_a_device_that_was_carried_away_is_lost_and_found_again(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any], path_of: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(5)
    here = carried_over(rng, grids["ground"], path_of(rng, 12.0))
    there = carried_over(rng, grids["first"], path_of(rng, 22.0), first=len(here.steps))
    jumped = [
        replace(s, t_s=s.t_s + 60.0, displacement_m=s.displacement_m + here.steps[-1].displacement_m)
        for s in there.steps
    ]
    followed = walk_on(tracker_on(grids), [*here.steps, *jumped])
    states = [each.state.state for each in followed]
    assert states[len(here.steps) - 1] == "converged"
    assert "lost" in states[len(here.steps) :]
    end = followed[-1]
    assert end.state.state == "converged"
    assert end.estimate is not None
    assert end.estimate.floor == 1
    assert error_m(end.estimate, there.truth_m[-1]) < 0.6


def test_in_another_building_nothing_is_claimed(
    grids: dict[str, FieldGrid], grid_of: Callable[..., FieldGrid], carried_over: Callable[..., Any],
    path_of: Callable[..., Array],
) -> None:  # fmt: skip
    rng = np.random.default_rng(6)
    elsewhere = grid_of(np.random.default_rng(99))
    followed = walk_on(tracker_on(grids), carried_over(rng, elsewhere, path_of(rng, 20.0)).steps)
    assert np.mean([each.state.state == "converged" for each in followed]) < 0.05
    assert followed[-1].probability < 0.5


def test_a_told_start_needs_no_search(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any], path_of: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(7)
    device = carried_over(rng, grids["first"], path_of(rng, 8.0))
    steps = [replace(s, heading_rad=device.yaw_rad + 0.1, heading_sd_rad=0.2) for s in device.steps]
    x, y, z = device.truth_m[0] + [0.3, -0.4, 0.1]
    followed = walk_on(tracker_on(grids, prior=StartPrior((x, y, z), 0.7)), steps)
    assert followed[0].estimate is not None
    assert followed[0].estimate.floor == 1
    assert error_m(followed[-1].estimate, device.truth_m[-1]) < 0.4
    assert followed[-1].state.state == "converged"


def test_a_device_that_does_not_know_how_it_moves_is_followed_where_it_was_told_to_be(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any], path_of: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(8)
    device = carried_over(rng, grids["ground"], path_of(rng, 8.0))
    turn = np.array(
        [[np.cos(device.yaw_rad), -np.sin(device.yaw_rad)], [np.sin(device.yaw_rad), np.cos(device.yaw_rad)]]
    )
    steps = [
        replace(s, displacement_m=None, yaw_rad=None, B_uT=np.append(turn @ s.B_uT[:2], s.B_uT[2]))
        for s in device.steps
    ]
    prior = StartPrior(tuple(device.truth_m[0].tolist()), 1.0)  # type: ignore[arg-type]
    tracker = tracker_on(
        {"ground": grids["ground"]}, frame="building", prior=prior, options=replace(FEW, speed_m_s=1.5)
    )
    errors = [error_m(f.estimate, p) for f, p in zip(walk_on(tracker, steps), device.truth_m, strict=True)]
    assert np.median(errors[len(errors) // 2 :]) < 1.0
    nowhere = walk_on(tracker_on({"ground": grids["ground"]}, frame="building", options=FEW), steps[:5])
    assert nowhere[0].estimate is not None  # everywhere at once
    assert nowhere[0].state.state == "searching"


def test_norm_tracks_take_longer_and_end_right(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any], path_of: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(9)
    device = carried_over(rng, grids["ground"], path_of(rng, 30.0), noise_uT=0.3)
    steps = [replace(s, B_uT=np.linalg.norm(s.B_uT, keepdims=True), yaw_rad=None) for s in device.steps]
    end = walk_on(tracker_on(grids, frame="norm", options=replace(FEW, window_m=15.0)), steps)[-1]
    assert error_m(end.estimate, device.truth_m[-1]) < 1.0


def test_a_reckoned_height_changes_the_floor_and_stairs_do_where_there_is_none(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any]
) -> None:
    rng = np.random.default_rng(10)
    below = carried_over(rng, grids["ground"], straight((2.0, 7.0), (11.0, 7.3)))
    above = carried_over(rng, grids["first"], straight((12.5, 7.5), (3.0, 11.0)), first=len(below.steps) + 10)
    turn = above.yaw_rad - below.yaw_rad
    c, s = np.cos(turn), np.sin(turn)
    R = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    apart = np.array([1.5, 0.2, 0.0])
    c0, s0 = np.cos(below.yaw_rad), np.sin(below.yaw_rad)
    gap = np.array([c0 * apart[0] + s0 * apart[1], -s0 * apart[0] + c0 * apart[1], 0.0])
    last = below.steps[-1]

    def route(rise_m: float) -> list[Step]:
        up = np.array([0.0, 0.0, rise_m])
        stairs = [
            replace(
                last, number=last.number + k, t_s=last.t_s + k, displacement_m=last.displacement_m + (gap + up) * k / 10
            )
            for k in range(1, 11)
        ]
        after = [
            replace(
                each, t_s=each.t_s + last.t_s + 11,
                displacement_m=last.displacement_m + gap + up + R @ each.displacement_m,
                B_uT=R @ each.B_uT, yaw_rad=each.yaw_rad + turn,
            )
            for each in above.steps
        ]  # fmt: skip
        return [*below.steps, *stairs, *after]

    followed = walk_on(tracker_on(grids), route(4.0))
    floors = [each.estimate.floor for each in followed[-len(above.steps) :] if each.estimate]
    assert np.mean(floors) > 0.95
    assert error_m(followed[-1].estimate, above.truth_m[-1]) < 0.6
    box = lambda p: (p[:, 0] > 10.5) & (p[:, 0] < 13.0)  # noqa: E731
    stairs = Ground(connectors=(Connector("stairs", ("ground", "first"), box),))
    end = walk_on(tracker_on(grids, options=replace(FEW, ground=stairs)), route(0.0))[-1]
    assert end.estimate is not None
    assert end.estimate.floor == 1
    assert error_m(end.estimate, above.truth_m[-1]) < 1.0


def straight(start: tuple[float, float], end: tuple[float, float]) -> Array:
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    return np.linspace(start, end, int(length / 0.12))


def test_smoothed_places_err_less_than_those_said_at_the_time(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any], path_of: Callable[..., Array]
) -> None:
    at_the_time, smoothed = [], []
    for seed in range(4):
        rng = np.random.default_rng(40 + seed)
        device = carried_over(rng, grids["ground"], path_of(rng, 25.0), noise_uT=2.0)
        options = replace(FEW, noise_uT=2.0, lag_m=6.0, position_walk_m=0.12)
        followed = walk_on(tracker_on({"ground": grids["ground"]}, options=options), device.steps)
        if followed[-1].state.state != "converged":
            continue
        for each in followed:
            for place in each.settled:
                now = followed[place.node.number]
                if now.state.particles is None or place.node.path_m < 10.0:
                    continue
                truth = device.truth_m[place.node.number]
                smoothed.append(float(np.hypot(*(np.array(place.position_m[:2]) - truth[:2]))))
                at_the_time.append(error_m(now.estimate, truth))
    assert len(smoothed) > 40
    assert np.sqrt(np.mean(np.square(smoothed))) < 0.95 * np.sqrt(np.mean(np.square(at_the_time)))


def test_steps_out_of_order_and_frames_no_map_answers_are_refused(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any], path_of: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(12)
    steps = carried_over(rng, grids["ground"], path_of(rng, 3.0)).steps
    tracker = tracker_on(grids)
    state = walk_on(tracker, steps[:4])[-1].state
    for wrong in (steps[3], replace(steps[4], t_s=0.0)):
        with pytest.raises(InvalidInput, match="does not come after"):
            follow(tracker, state, wrong)
    with pytest.raises(InvalidInput, match="none of the floors"):
        make_tracker([], "level", FEW, 1)
    ground = grids["ground"]
    norms = replace(
        ground, components="norm", mean_uT=ground.mean_uT[..., :1], sd_uT=ground.sd_uT[..., :1],
        gradient_uT_per_m=ground.gradient_uT_per_m[..., :1, :], ambient_uT=np.ones(1), prior_sd_uT=np.ones(1),
        noise_sd_uT=np.ones(1),
    )  # fmt: skip
    with pytest.raises(IncompatibleFrames):
        make_tracker([prepare_floor("ground", norms)], "level", FEW, 1)


def test_standing_still_and_a_step_without_a_reading_change_nothing_but_time(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any], path_of: Callable[..., Array]
) -> None:
    rng = np.random.default_rng(13)
    steps = carried_over(rng, grids["ground"], path_of(rng, 12.0)).steps
    tracker = tracker_on(grids)
    walked = walk_on(tracker, steps)[-1]
    last = steps[-1]
    still = [replace(last, number=last.number + k, t_s=last.t_s + k) for k in range(1, 200)]
    blind = [replace(each, number=each.number + 200, t_s=each.t_s + 200, B_uT=None) for each in still]
    stood = walk_on(tracker, [*still, *blind], walked.state)[-1]
    assert walked.estimate is not None
    assert stood.estimate is not None
    assert stood.state.state == walked.state.state
    np.testing.assert_allclose(stood.estimate.position_m, walked.estimate.position_m, atol=0.2)
    assert 0.5 < np.trace(stood.estimate.covariance_m2) / np.trace(walked.estimate.covariance_m2) < 2.0


def test_a_walkable_area_and_its_walls_keep_the_belief_inside(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any]
) -> None:
    """A corridor 2 m wide along x = 7: the belief is in it from the first place said."""
    rng = np.random.default_rng(14)
    device = carried_over(rng, grids["ground"], straight((7.0, 2.0), (7.2, 13.0)), noise_uT=4.0)
    inside = lambda p: (np.abs(p[:, 0] - 7.0) < 1.0) & (p[:, 1] > 0.5) & (p[:, 1] < 14.5)  # noqa: E731
    sides = np.array([[[6.0, 0.5], [6.0, 14.5]], [[8.0, 0.5], [8.0, 14.5]]])
    ground = Ground(
        walls={"ground": sides}, walkable={"ground": inside, "first": lambda p: np.zeros(len(p), dtype=bool)}
    )
    options = replace(FEW, noise_uT=4.0, ground=ground)
    for each in walk_on(tracker_on(grids, options=options), device.steps):
        if each.estimate is not None:
            assert each.estimate.floor == 0
            assert abs(each.estimate.position_m[0] - 7.0) < 1.05
    nowhere = Ground(walkable=dict.fromkeys(("ground", "first"), lambda p: p[:, 0] > 1000.0))
    with pytest.raises(InvalidInput, match="walkable area"):
        tracker_on(grids, options=replace(FEW, ground=nowhere))


def test_reckoning_may_fail_for_a_while(
    grids: dict[str, FieldGrid], carried_over: Callable[..., Any], path_of: Callable[..., Array]
) -> None:
    """Steps without a displacement in mid-track: the belief widens, and narrows again when the device reckons on."""
    rng = np.random.default_rng(15)
    device = carried_over(rng, grids["ground"], path_of(rng, 22.0))
    gap = range(100, 112)
    steps = [replace(s, displacement_m=None) if k in gap else s for k, s in enumerate(device.steps)]
    followed = walk_on(tracker_on(grids), steps)
    assert followed[99].state.state == "converged"
    errors = [error_m(each.estimate, p) for each, p in zip(followed, device.truth_m, strict=True) if each.estimate]
    assert max(errors[-60:]) < 1.0
    assert followed[-1].state.state == "converged"
