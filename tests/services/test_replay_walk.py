"""A walk through the analytic building, replayed on the map of its field: places, windows, frames and bounds."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.errors import InvalidInput
from app.field.error_structure import ErrorStructure
from app.field.grid import FieldGrid
from app.field.samples import COMPONENT_NAMES, Components, Samples
from app.geometry import Array, yaw_matrix
from app.positioning.fix import LocateOptions
from app.positioning.locate import SearchableFloor, locate, prepare_floor
from app.positioning.window import Window
from app.services.judge_windows import PHONE, SENSOR_NOISE_UT, cut_windows
from app.services.replay_walk import MOST_WINDOWS, ask_along, replay_walk
from app.survey.walk import DeadReckoning, Walk
from app.synthetic import Magnetometer, SyntheticBuilding, SyntheticWalk, make_building, random_waypoints, survey

STEP_M, HEIGHT_M = 0.25, 1.2
SENSOR = Magnetometer(noise_uT=0.4)


@pytest.fixture(scope="module")
def building() -> SyntheticBuilding:
    return make_building(np.random.default_rng(11), width_m=20.0, depth_m=16.0, floors=1)


@pytest.fixture(scope="module")
def floor(building: SyntheticBuilding) -> SearchableFloor:
    return floor_of(building, "vector")


def floor_of(building: SyntheticBuilding, components: Components) -> SearchableFloor:
    """The floor's map as it would be if nothing but the noise were wrong with it."""
    points_m = building.device_grid_m(0, STEP_M)
    ny, nx = points_m.shape[:2]
    truth = building.field_uT(points_m.reshape(-1, 3))
    n = len(truth)
    mean = Samples(np.arange(n), points_m.reshape(-1, 3), truth, "building").features(components)
    mean = mean.reshape(1, ny, nx, -1)
    c = len(COMPONENT_NAMES[components])
    gradient = np.stack([np.gradient(mean, STEP_M, axis=2), np.gradient(mean, STEP_M, axis=1)], axis=-1)
    grid = FieldGrid(
        components, (float(points_m[0, 0, 0]), float(points_m[0, 0, 1])), STEP_M, np.array([HEIGHT_M]),
        mean.astype(np.float32), np.full(mean.shape, 0.3, np.float32), gradient.astype(np.float32),
        np.ones((1, ny, nx), dtype=bool), mean.mean(axis=(0, 1, 2)), np.full(c, 5.0), np.full(c, 0.5),
        error_structure=ErrorStructure(0.0, 0.0, 1.0, 1.0),
    )  # fmt: skip
    return prepare_floor("F", grid)


@pytest.fixture(scope="module")
def walked(building: SyntheticBuilding) -> SyntheticWalk:
    """Where nobody surveyed."""
    return random_waypoints(building, 0, np.random.default_rng(2), length_m=40.0)


@pytest.fixture(scope="module")
def walk(building: SyntheticBuilding, walked: SyntheticWalk) -> Walk:
    return Walk(survey(building, walked, SENSOR, np.random.default_rng(3)), {})


@pytest.fixture(scope="module")
def traced(walk: Walk, walked: SyntheticWalk) -> Walk:
    """The same walk by a phone that counts its steps a twentieth too long and thinks it knows north to 0.3 rad."""
    samples, heading = walk.samples, np.unwrap(walked.heading_rad)
    yaw, n = heading - heading[0], len(walk.samples)
    B = np.stack([yaw_matrix(-h) @ b for h, b in zip(heading, samples.B_uT, strict=True)])
    p = (samples.p_building_m - samples.p_building_m[0]) * [1.05, 1.05, 0.0]
    reckoned = DeadReckoning(
        p @ yaw_matrix(-float(heading[0])).T, yaw, B, np.tile([1.0, 0, 0, 0], (n, 1)), np.zeros(0), np.zeros(0),
        heading + 0.1, np.full(n, 0.3), 4.0,
    )  # fmt: skip
    return Walk(samples, {}, reckoned)


def in_frame(walk: Walk, frame: Any) -> Walk:
    samples = walk.samples
    B = samples.features("norm")
    if frame == "level":  # a level frame whose yaw wanders as it likes
        turns = np.random.default_rng(4).uniform(-3, 3, len(samples))
        B = np.stack([yaw_matrix(t) @ b for t, b in zip(turns, samples.B_uT, strict=True)])
    return Walk(Samples(samples.t_s, samples.p_building_m, B, frame), {})


def same_fix(one: Any, other: Any) -> bool:
    posterior = one.posterior
    return (one.status, posterior.position_m, posterior.radius_95_m, posterior.modes) == (
        other.status, other.posterior.position_m, other.posterior.radius_95_m, other.posterior.modes
    )  # fmt: skip


def assert_placed(found: list[Any], within_m: float) -> None:
    errors_m = [each.error_m for each in found]
    assert np.median(errors_m) < within_m, errors_m
    held = [each.error_m <= each.fix.posterior.radius_95_m for each in found]
    assert np.mean(held) >= 0.85, list(zip(errors_m, [e.fix.posterior.radius_95_m for e in found], strict=True))


def test_a_held_out_walk_is_placed_and_its_radii_hold(floor: SearchableFloor, walk: Walk) -> None:
    replay = replay_walk(walk, [floor], 8.0, 2.0)
    found = list(replay.fixes)
    walked_m = float(walk.samples.path_length_m()[-1])
    assert len(found) == replay.windows == pytest.approx((walked_m - 8.0) / 2.0, abs=1.0)
    assert_placed(found, 0.3)
    assert np.mean([each.fix.status == "fix" for each in found]) > 0.8
    for each in found:
        at = int(np.searchsorted(walk.samples.t_s, each.t_s))
        assert (walk.samples.t_s[at], *walk.samples.p_building_m[at]) == (each.t_s, *each.truth_m)
        assert each.error_m == pytest.approx(np.hypot(*(np.array(each.fix.posterior.position_m) - each.truth_m)[:2]))


def test_a_fix_is_that_of_the_same_window_built_by_hand(floor: SearchableFloor, walk: Walk) -> None:
    """Walk along the path, put samples 5 cm apart, turn them to where the walk first went, ask."""
    samples = walk.samples
    kept = [0]
    for k in range(1, len(samples)):
        if np.linalg.norm((samples.p_building_m[k] - samples.p_building_m[kept[-1]])[:2]) >= 0.05:
            kept.append(k)
    p, B = samples.p_building_m[kept] * [1.0, 1.0, 0.0], samples.B_uT[kept]
    path_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    ahead = next(each for each in p - p[0] if np.linalg.norm(each) > 1.0)
    turn = yaw_matrix(-float(np.arctan2(ahead[1], ahead[0])))
    found = list(replay_walk(walk, [floor], 8.0, 3.0).fixes)
    for number, each in enumerate(found):
        part = slice(np.searchsorted(path_m, 3.0 * number), np.searchsorted(path_m, 3.0 * number + 8.0) + 1)
        moved = (p[part] - p[part][0]) @ turn.T
        window = Window("level", B[part] @ turn.T, moved, SENSOR_NOISE_UT, yaw_rad=np.zeros(len(moved)))
        fix = locate(window, [floor], techniques=(), options=LocateOptions())
        assert fix.status == each.fix.status
        assert fix.posterior is not None
        np.testing.assert_allclose(each.fix.posterior.position_m, fix.posterior.position_m, atol=1e-6)
        assert each.fix.posterior.radius_95_m == pytest.approx(fix.posterior.radius_95_m)
    assert len(found) == len(np.arange(0.0, path_m[-1] - 8.0, 3.0))


@pytest.mark.parametrize("components", ["vector", "level", "norm"])
def test_a_trace_is_asked_by_its_own_dead_reckoning(
    building: SyntheticBuilding, traced: Walk, components: Components
) -> None:
    floors = [floor_of(building, components)]
    found = list(replay_walk(traced, floors, 10.0, 3.0).fixes)
    samples, reckoned = ask_along(traced, 0.05)
    windows = list(cut_windows(reckoned, 10.0, 3.0))
    assert len(windows) == len(found)
    for (part, window), each in zip(windows, found, strict=True):
        assert each.t_s == samples.t_s[part][-1]
        if components == "norm":
            window = replace(window, frame="norm", B_uT=np.linalg.norm(window.B_uT, axis=1, keepdims=True))
        assert same_fix(locate(window, floors, techniques=(), options=PHONE), each.fix)
    assert_placed(found, 1.0)


@pytest.mark.parametrize("components", ["vector", "norm"])
@pytest.mark.parametrize("frame", ["building", "level", "norm"])
def test_tables_of_every_frame_are_asked_for_what_they_share_with_the_map(
    building: SyntheticBuilding, walk: Walk, frame: Any, components: Components
) -> None:
    floors = [floor_of(building, components)]
    asked = walk if frame == "building" else in_frame(walk, frame)
    found = list(replay_walk(asked, floors, 12.0, 6.0).fixes)
    assert_placed(found, 0.5)
    if frame != "building":  # magnitudes are all there is, whichever way they came
        for each, other in zip(found, replay_walk(walk, [floor_of(building, "norm")], 12.0, 6.0).fixes, strict=True):
            np.testing.assert_array_equal(each.truth_m, other.truth_m)
            if components == "norm":
                np.testing.assert_allclose(each.fix.posterior.position_m, other.fix.posterior.position_m, atol=1e-6)


def straight(x_m: Array, y_m: Array | None = None) -> Walk:
    n = len(x_m)
    y_m = np.zeros(n) if y_m is None else y_m
    p = np.column_stack([x_m, y_m, np.full(n, HEIGHT_M)])
    return Walk(Samples(0.01 * np.arange(n), p, np.tile([18.0, 2.0, -43.0], (n, 1)), "building"), {})


@pytest.mark.parametrize(
    "x_m",
    [np.array([3.0, 5.0]), np.full(500, 3.0), 3.0 + 0.02 * (np.arange(5000) % 2), np.linspace(0.0, 9.9, 100)],
    ids=["two samples", "standing", "standing, labels that tremble", "too short"],
)
def test_a_walk_shorter_than_a_window_is_refused(floor: SearchableFloor, x_m: Array) -> None:
    with pytest.raises(InvalidInput, match=r"m long, and a window 10 m") as refused:
        replay_walk(straight(x_m), [floor], 10.0, 2.0)
    assert refused.value.faults[0].location == "/query/window_m"


def test_a_phone_that_counted_no_steps_is_told_so(floor: SearchableFloor, traced: Walk) -> None:
    assert traced.dead_reckoning is not None
    still = replace(traced.dead_reckoning, displacement_m=0.0 * traced.dead_reckoning.displacement_m)
    with pytest.raises(InvalidInput, match=r"by the device's own steps the walk is 0\.0 m long"):
        replay_walk(replace(traced, dead_reckoning=still), [floor], 10.0, 2.0)


def test_a_walk_of_two_far_samples_is_asked_all_the_same(floor: SearchableFloor) -> None:
    replay = replay_walk(straight(np.array([3.0, 15.0])), [floor], 10.0, 2.0)
    assert [each.fix.status in ("fix", "ambiguous", "inconsistent", "unmapped") for each in replay.fixes] == [True]


def test_windows_and_their_samples_are_bounded_however_long_the_walk(floor: SearchableFloor) -> None:
    """An hour at 100 Hz, half of it standing: nothing is located before it is asked for."""
    walking = np.linspace(0.0, 4000.0, 180_000)
    x_m = np.concatenate([walking[:90_000], np.full(180_000, walking[90_000]), walking[90_000:]])
    long = straight(x_m)
    replay = replay_walk(long, [floor], 200.0, 0.2)
    assert replay.windows <= MOST_WINDOWS
    _, reckoned = ask_along(long, 0.4)
    assert max(len(window.B_uT) for _, window in cut_windows(reckoned, 200.0, 50.0)) <= 502
    assert replay.path_m.base is None or len(replay.path_m.base) < 20_000, "the walk as read is let go"
