"""The whole answer: position and heading of the last sample, statuses, refusals, and stated uncertainty that holds."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from app.errors import IncompatibleFrames, InvalidInput, InvalidWindow
from app.field.grid import FieldGrid
from app.geometry import wrap_angle_rad, yaw_matrix
from app.positioning.fix import Fix, LocateOptions, Prior
from app.positioning.locate import locate, prepare_floor, prepare_floors, shared_noise_sd_uT, warm_up
from app.positioning.window import Window


@pytest.fixture(scope="module")
def rng() -> np.random.Generator:
    return np.random.default_rng(11)


@pytest.fixture
def world(grid_of: Callable) -> FieldGrid:
    return grid_of(np.random.default_rng(1), (100, 120), length_m=1.6)


def error_m(fix: Fix, position: np.ndarray) -> float:
    assert fix.ml is not None
    return float(np.linalg.norm(np.array(fix.ml.position_m[:2]) - position))


@pytest.mark.parametrize("frame", ["building", "level", "norm"])
def test_position_and_heading_are_those_of_the_last_sample(
    frame: str, world: FieldGrid, walk_on: Callable, rng: np.random.Generator
) -> None:
    walked = walk_on(rng, world, frame, length_m=16.0 if frame == "norm" else 10.0, samples=30)
    fix = locate(walked.window, [prepare_floor("a", world)])
    assert fix.status == "fix", fix.reason
    assert fix.ml is not None
    assert fix.posterior is not None
    assert error_m(fix, walked.position_m) < 0.5
    assert fix.ml.position_m[2] == 1.2
    if frame == "building":
        assert fix.ml.heading_rad is None
        assert fix.posterior.modes[0].heading_rad is None
    else:
        assert fix.ml.heading_rad is not None
        assert abs(wrap_angle_rad(fix.ml.heading_rad - walked.heading_rad)) < 0.15
    assert fix.mlr.available
    assert fix.abl.available
    for estimate in (fix.mlr, fix.abl):
        assert np.linalg.norm(np.array(estimate.position_m)[:2] - walked.position_m) < 1.0


@pytest.mark.parametrize("components", ["level", "norm"])
def test_poorer_maps_answer_what_they_can(components: str, grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(3)
    grid = grid_of(rng, (80, 80), components)
    floor = prepare_floor("a", grid)
    walked = walk_on(rng, grid, "norm", length_m=10.0, samples=30)
    if components == "norm":
        assert error_m(locate(walked.window, [floor]), walked.position_m) < 0.5
        with pytest.raises(IncompatibleFrames):
            locate(dataclasses.replace(walked.window, frame="level", B_uT=np.ones((30, 3))), [floor])
        return
    turned = np.zeros((30, 3))
    points = walked.position_m + (walked.window.displacement_m - walked.window.displacement_m[-1])[:, :2] @ (
        yaw_matrix(walked.yaw_rad)[:2, :2].T
    )
    horizontal, vertical = grid.at(points).mean_uT.T
    turned[:, 1], turned[:, 2] = horizontal, vertical
    level = dataclasses.replace(walked.window, frame="level", B_uT=turned)
    assert error_m(locate(level, [floor]), walked.position_m) < 0.3


def test_answer_turns_with_the_building(world: FieldGrid, walk_on: Callable, rng: np.random.Generator) -> None:
    """Turn the building by a quarter: the fix turns, the level window stays."""
    walked = walk_on(rng, world, length_m=6.0, samples=16)
    quarter = FieldGrid(
        "vector",
        (-world.bounds_m[4], world.bounds_m[0]),
        world.resolution_m,
        world.heights_m,
        np.rot90(world.mean_uT, -1, (1, 2)) @ yaw_matrix(np.pi / 2).T.astype(np.float32),
        np.rot90(world.sd_uT, -1, (1, 2))[..., [1, 0, 2]],
        np.stack(
            [
                -(np.rot90(world.gradient_uT_per_m[..., 1], -1, (1, 2)) @ yaw_matrix(np.pi / 2).T),
                np.rot90(world.gradient_uT_per_m[..., 0], -1, (1, 2)) @ yaw_matrix(np.pi / 2).T,
            ],
            axis=-1,
        ).astype(np.float32),
        np.rot90(world.measured, -1, (1, 2)),
        yaw_matrix(np.pi / 2) @ world.ambient_uT,
        world.prior_sd_uT,
        world.noise_sd_uT,
    )
    before = locate(walked.window, [prepare_floor("a", world)]).ml
    after = locate(walked.window, [prepare_floor("a", quarter)]).ml
    assert before is not None
    assert after is not None
    x, y, _ = before.position_m
    np.testing.assert_allclose(after.position_m[:2], [-y, x], atol=0.04)
    assert before.heading_rad is not None
    assert after.heading_rad is not None
    assert abs(wrap_angle_rad(after.heading_rad - before.heading_rad - np.pi / 2)) < 0.01


def test_floors_are_told_apart_and_probabilities_sum_to_one(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(6)
    grids = {name: grid_of(rng, (60, 60), heights_m=(z,)) for name, z in (("ground", 1.2), ("first", 5.2))}
    floors = [prepare_floor(name, grid) for name, grid in grids.items()]
    walked = walk_on(rng, grids["first"], length_m=6.0, samples=16)
    fix = locate(walked.window, floors)
    assert fix.posterior is not None
    assert fix.posterior.floor_id == "first"
    assert fix.posterior.position_m[2] == 5.2
    assert sum(fix.posterior.floor_probability.values()) == pytest.approx(1.0)
    assert fix.posterior.floor_probability["first"] > 0.99
    assert sum(mode.probability for mode in fix.posterior.modes) <= 1.0 + 1e-9
    assert fix.posterior.radius_68_m <= fix.posterior.radius_95_m


def test_a_floor_does_not_win_by_claiming_less_noise(grid_of: Callable, walk_on: Callable) -> None:
    """A map that claims a tenth of the noise gains ln 10 per number in its likelihood: not under one noise for all."""
    rng = np.random.default_rng(61)
    right, wrong = (grid_of(rng, (60, 60), heights_m=(z,), field_sd_uT=1.5, map_sd_uT=0.1) for z in (1.2, 5.2))
    grids = {
        "right": dataclasses.replace(right, noise_sd_uT=np.full(3, 10.0)),
        "boasting": dataclasses.replace(wrong, noise_sd_uT=np.full(3, 1.0)),
    }
    window = walk_on(rng, right, length_m=6.0, samples=16).window
    own = [prepare_floor(name, grid) for name, grid in grids.items()]
    claimed = [locate(window, [floor]).ml for floor in own]
    assert claimed[0] is not None
    assert claimed[1] is not None
    assert claimed[1].log_likelihood > claimed[0].log_likelihood, (
        "under its own noise the wrong floor explains it better"
    )
    fix = locate(window, prepare_floors(grids))
    assert fix.ml is not None
    assert fix.ml.floor_id == "right"
    assert locate(window, own).ml == fix.ml, "however the floors were prepared"


def test_noise_is_shared_by_maps_of_the_same_components_alone(grid_of: Callable) -> None:
    rng = np.random.default_rng(62)
    quiet, loud, level = grid_of(rng, noise_sd_uT=3.0), grid_of(rng, noise_sd_uT=4.0), grid_of(rng, components="level")
    shared = shared_noise_sd_uT([quiet, loud])
    np.testing.assert_array_equal(shared, 4.0)
    assert shared_noise_sd_uT([quiet]) is None
    assert shared_noise_sd_uT([quiet, level]) is None
    alone, together = prepare_floor("a", quiet), prepare_floors({"a": quiet, "b": loud})[0]
    difference = together.planes[0].variance_uT2 - alone.planes[0].variance_uT2
    np.testing.assert_allclose(difference, 16.0 - 9.0, rtol=1e-4)


def test_maps_of_unlike_components_are_compared_on_what_they_share(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(7)
    vector, level = grid_of(rng, (60, 60)), grid_of(rng, (60, 60), "level")
    walked = walk_on(rng, vector, length_m=8.0, samples=24)
    fix = locate(walked.window, [prepare_floor("v", vector), prepare_floor("l", level)])
    assert fix.ml is not None
    assert fix.ml.floor_id == "v"
    assert error_m(fix, walked.position_m) < 0.5


def test_a_prior_settles_what_the_window_cannot(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(8)
    half = grid_of(rng, (40, 40))
    twice = {name: np.concatenate([getattr(half, name)] * 2, axis=2)
             for name in ("mean_uT", "sd_uT", "gradient_uT_per_m", "measured")}  # fmt: skip
    grid = dataclasses.replace(half, **twice)  # the same ten metres, two times over
    walked = walk_on(rng, half, length_m=3.0, samples=12)
    floor = prepare_floor("a", grid)
    undecided = locate(walked.window, [floor])
    assert undecided.status == "ambiguous"
    assert not undecided.mlr.available
    assert undecided.mlr.ratio == pytest.approx(1.0, abs=0.5)
    assert undecided.reason is not None
    assert "walk further" in undecided.reason
    for shift in (0.0, 10.0):
        there = walked.position_m + np.array([shift, 0.0])
        fix = locate(walked.window, [floor], prior=Prior((there[0] + 1, there[1] - 1, 1.2), 2.0))
        assert fix.status == "fix", fix.reason
        assert error_m(fix, there) < 0.5


def test_a_heading_prior_is_used(world: FieldGrid, walk_on: Callable, rng: np.random.Generator) -> None:
    walked = walk_on(rng, world, length_m=4.0, samples=12)
    told = dataclasses.replace(walked.window, heading_rad=walked.yaw_rad + 0.05, heading_sd_rad=0.1)
    assert error_m(locate(told, [prepare_floor("a", world)]), walked.position_m) < 0.5
    believed = dataclasses.replace(walked.window, heading_rad=walked.yaw_rad)
    fix = locate(believed, [prepare_floor("a", world)])
    assert fix.ml is not None
    assert fix.ml.heading_rad == pytest.approx(float(wrap_angle_rad(walked.heading_rad)))


def test_demeaned_forgives_an_offset_that_raw_does_not(
    world: FieldGrid, walk_on: Callable, rng: np.random.Generator
) -> None:
    walked = walk_on(rng, world, length_m=8.0, samples=24, offset_uT=10.0)
    floors = [prepare_floor("a", world)]
    raw = locate(walked.window, floors)
    assert raw.status in ("inconsistent", "unmapped")  # other ground may lie ten microtesla off
    assert raw.reason is not None
    assert "demeaned" in raw.reason
    demeaned = locate(walked.window, floors, composition="demeaned")
    assert demeaned.status == "fix", demeaned.reason
    assert error_m(demeaned, walked.position_m) < 0.5


def test_one_sample_is_answered_with_all_the_doubt_it_deserves(world: FieldGrid, walk_on: Callable) -> None:
    walked = walk_on(np.random.default_rng(9), world, length_m=0.0, samples=1)
    fix = locate(walked.window, [prepare_floor("a", world)])
    assert fix.status == "ambiguous"
    assert fix.ml is not None
    assert fix.posterior is not None
    assert fix.posterior.radius_95_m > 3.0


def test_a_constant_field_is_ambiguous(grid_of: Callable, walk_on: Callable) -> None:
    grid = grid_of(np.random.default_rng(1), (60, 60), field_sd_uT=0.0, sd_spread=0.0, map_sd_uT=0.05)
    walked = walk_on(np.random.default_rng(2), grid, length_m=4.0)
    fix = locate(walked.window, [prepare_floor("a", grid)])
    assert fix.status == "ambiguous", fix.reason
    assert not fix.mlr.available
    assert not fix.abl.available
    assert fix.posterior is not None
    assert fix.posterior.radius_95_m > 5.0


def test_a_window_off_the_map_is_unmapped(world: FieldGrid, rng: np.random.Generator) -> None:
    n = 24
    noise = world.prior_sd_uT * rng.normal(size=(n, 3))
    displacement = np.column_stack([np.linspace(0, 12, n), np.zeros((n, 2))])
    fix = locate(Window("level", world.ambient_uT + noise, displacement, 0.5), [prepare_floor("a", world)])
    assert fix.status == "unmapped"
    assert fix.posterior is not None
    assert fix.posterior.off_map_probability > 0.5


@pytest.mark.slow
def test_a_window_much_longer_than_the_map_is_unmapped(world: FieldGrid, rng: np.random.Generator) -> None:
    displacement = np.column_stack([np.linspace(0, 300, 60), np.zeros((60, 2))])
    B = world.ambient_uT + 4.0 * rng.normal(size=(60, 3))
    assert locate(Window("level", B, displacement, 0.5), [prepare_floor("a", world)]).status == "unmapped"


def test_a_wrong_field_is_inconsistent(world: FieldGrid, walk_on: Callable, rng: np.random.Generator) -> None:
    walked = walk_on(rng, world, length_m=6.0, samples=20)
    spoilt = walked.window.B_uT + np.where(np.arange(20) % 2, 6.0, -6.0)[:, None]
    prior = Prior((*walked.position_m, 1.2), 0.3)
    window = dataclasses.replace(walked.window, B_uT=spoilt, heading_rad=walked.yaw_rad, heading_sd_rad=0.02)
    narrow = dataclasses.replace(world, prior_sd_uT=np.full(3, 1.5))
    fix = locate(window, [prepare_floor("a", narrow)], prior=prior)
    assert fix.status == "inconsistent", fix
    assert fix.reason is not None
    assert "chi-square" in fix.reason


def test_a_small_map_cannot_test_its_rivals(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(3)
    grid = grid_of(rng, (12, 12), length_m=0.8)
    walked = walk_on(rng, grid, length_m=2.0)
    fix = locate(walked.window, [prepare_floor("a", grid)])
    assert not fix.mlr.available
    assert fix.mlr.reason is not None
    assert "no rival" in fix.mlr.reason


def test_estimates_not_asked_for_say_so(world: FieldGrid, walk_on: Callable, rng: np.random.Generator) -> None:
    fix = locate(walk_on(rng, world).window, [prepare_floor("a", world)], techniques=("ml",))
    assert fix.mlr.reason == fix.abl.reason == "not asked for"


def test_no_floor_is_unmapped(world: FieldGrid, walk_on: Callable, rng: np.random.Generator) -> None:
    fix = locate(walk_on(rng, world).window, [])
    assert fix.status == "unmapped"
    assert fix.ml is fix.posterior is None


def test_the_same_question_has_the_same_answer(world: FieldGrid, walk_on: Callable, rng: np.random.Generator) -> None:
    walked, floors = walk_on(rng, world), [prepare_floor("a", world)]
    assert repr(locate(walked.window, floors)) == repr(locate(walked.window, floors))


@pytest.mark.parametrize(
    ("change", "where"),
    [
        ({"B_uT": np.zeros((0, 3)), "displacement_m": np.zeros((0, 3))}, "b_ut"),
        ({"B_uT": np.zeros((8, 2))}, "b_ut"),
        ({"B_uT": np.full((8, 3), np.nan)}, "b_ut/0"),
        ({"displacement_m": np.zeros((7, 3))}, "displacement_m"),
        ({"displacement_m": np.full((8, 3), np.inf)}, "displacement_m"),
        ({"noise_uT": -1.0}, "noise_ut"),
        ({"heading_rad": np.nan}, "heading_rad"),
        ({"heading_sd_rad": -0.1}, "heading_sd_rad"),
        ({"yaw_rad": np.zeros(3)}, "yaw_rad"),
    ],
)
def test_windows_that_cannot_be_matched_are_refused(
    change: dict, where: str, world: FieldGrid, walk_on: Callable, rng: np.random.Generator
) -> None:
    window = dataclasses.replace(walk_on(rng, world).window, **change)
    with pytest.raises(InvalidWindow) as refused:
        locate(window, [prepare_floor("a", world)])
    assert any(where in fault.location for fault in refused.value.faults)


def test_other_refusals(world: FieldGrid, walk_on: Callable, rng: np.random.Generator) -> None:
    window, floors = walk_on(rng, world).window, [prepare_floor("a", world)]
    with pytest.raises(InvalidWindow, match="composition"):
        locate(walk_on(rng, world, length_m=0.0, samples=1).window, floors, composition="demeaned")
    with pytest.raises(InvalidWindow, match="median"):
        locate(window, floors, composition="median")  # type: ignore[arg-type]
    with pytest.raises(InvalidInput, match="prior"):
        locate(window, floors, prior=Prior((0.0, 0.0, 0.0), 0.0))
    with pytest.raises(InvalidInput, match="abl_bin_m"):
        locate(window, floors, options=LocateOptions(abl_bin_m=0.0))


def test_stated_radii_hold_on_data_from_the_model(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(12)
    grid = grid_of(rng, (100, 100), length_m=1.6, map_sd_uT=0.1, noise_sd_uT=0.8)
    floors = [prepare_floor("a", grid)]
    held = []
    for length in (2.0, 3.0, 5.0, 8.0) * 25:
        walked = walk_on(rng, grid, length_m=length, samples=int(2 * length) + 1, noise_uT=0.4)
        belief = locate(walked.window, floors).posterior
        assert belief is not None
        error = np.linalg.norm(np.array(belief.position_m[:2]) - walked.position_m)
        held.append((error <= belief.radius_68_m, error <= belief.radius_95_m))
    share68, share95 = np.mean(held, axis=0)
    assert 0.58 <= share68 <= 0.9
    assert share95 >= 0.89


def test_warm_up_answers() -> None:
    warm_up()


def test_the_strongest_floor_may_be_strong_by_area_alone(grid_of: Callable) -> None:
    """Many even places, each a little worse than the best of another floor, outweigh it together."""
    small = grid_of(np.random.default_rng(0), (20, 240), field_sd_uT=0.0, noise_sd_uT=0.4, sd_spread=0.0)
    wide = grid_of(np.random.default_rng(0), (240, 240), field_sd_uT=0.0, noise_sd_uT=0.4, sd_spread=0.0)
    off_by_a_little = dataclasses.replace(wide, mean_uT=wide.mean_uT + np.float32(0.25))
    displacement = np.column_stack([np.linspace(0, 1.0, 3), np.zeros((3, 2))])
    field = np.tile(small.mean_uT[0, 0, 0].astype(float), (3, 1))
    window = Window("building", field, displacement, 0.4)
    floors, sure = (
        [prepare_floor("small", small), prepare_floor("wide", off_by_a_little)],
        LocateOptions(bias_sd_uT=0.0),
    )
    fix = locate(window, floors, options=sure)
    assert fix.posterior is not None
    assert fix.posterior.floor_id == "wide"
    assert fix.ml is not None
    assert fix.ml.floor_id == "small"
    assert fix.status == "ambiguous"
    assert sum(fix.posterior.floor_probability.values()) == pytest.approx(1.0)


@pytest.mark.parametrize("seed", [6, 18, 25])
def test_a_refined_pose_better_by_more_than_a_float_tells_leaves_an_answer(seed: int, hall_grid: FieldGrid) -> None:
    """Noise under a prior of a centimetre: no lattice pose comes within a thousand nats of the refined one."""
    B = np.array([18.0, 3.0, -42.0]) + np.random.default_rng(seed).normal(0, 30, (11, 3))
    walked = np.column_stack([np.linspace(0, 5, 11), np.zeros((11, 2))])
    fix = locate(
        Window("building", B, walked, 0.5), [prepare_floor("f", hall_grid)], composition="demeaned",
        prior=Prior((4.0, 4.0, 1.2), 0.01),
    )  # fmt: skip
    assert fix.status == "inconsistent"
    assert sum(fix.posterior.floor_probability.values()) == pytest.approx(1.0)
