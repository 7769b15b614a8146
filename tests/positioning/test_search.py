"""Branch and bound against the naive exhaustive scan: the same poses with the same scores, whatever the world."""

import dataclasses
from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from app.field.grid import FieldGrid
from app.field.pyramid import build_pyramid
from app.geometry import yaw_matrix
from app.positioning.floors import Plane, prepare_floor, reduce_floor
from app.positioning.lattice import (
    Courses,
    ReducedWindow,
    Steps,
    bent_m,
    heading_lattice,
    reduce_window,
    single_course,
)
from app.positioning.search import PosePrior, search
from app.positioning.window import Window
from app.positioning.window_error import WindowError, plain_error


def exhaustive_scores(
    plane: Plane, window: ReducedWindow, courses: Courses, prior: PosePrior, error: WindowError
) -> np.ndarray:
    """(courses, ny, nx) of log L + log prior with inflated variances, by the formula, one sample after the other."""
    ny, nx = plane.shape
    scores = np.empty((len(courses), ny, nx))
    jj, ii = np.meshgrid(np.arange(ny), np.arange(nx), indexing="ij")
    along = window.path_m - 0.5 * (window.path_m[0] + window.path_m[-1])
    for h in range(len(courses)):
        c, s = np.cos(courses.heading_rad[h]), np.sin(courses.heading_rad[h])
        told, _ = bent_m(window, courses.drift_rad_per_m[h : h + 1])
        residuals, variances = [], []
        for k in range(len(window)):
            dx, dy = courses.scale[h] * told[0, k]
            row = jj + int(np.rint((s * dx + c * dy) / plane.resolution_m))
            column = ii + int(np.rint((c * dx - s * dy) / plane.resolution_m))
            inside = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
            at = (row.clip(0, ny - 1) + 1, column.clip(0, nx - 1) + 1)
            mean = np.where(inside[..., None], plane.mean_uT[at], plane.ambient_uT.astype(np.float32)).astype(float)
            variance = np.where(inside, plane.variance_uT2[at], np.float32(plane.off_map_variance_uT2)).astype(float)
            yaw = courses.heading_rad[h] + courses.drift_rad_per_m[h] * along[k] if window.turns else 0.0
            r = (
                yaw_matrix(yaw) @ window.features_uT[k] - mean
                if len(plane.scale) == 3
                else window.features_uT[k] - mean
            )
            if len(plane.scale) == 3:  # to the sensor's axes, which the drift does not turn
                facing = (courses.heading_rad[h] if window.turns else 0.0) + window.yaw_rad[k]
                r = (r @ yaw_matrix(facing)) @ (window.tilt[k].T if len(window.tilt) else np.eye(3))
            residuals.append(r)
            variances.append(error.inflation * (error.own_share * variance + window.noise_variance_uT2[k]))
        r, v = np.array(residuals), np.array(variances)[..., None]
        log_l = -0.5 * (r**2 / v + np.log(2 * np.pi * v)).sum(axis=(0, 3))
        if (p := error.offset_precision) is not None:
            total = (1 / v).sum(axis=0) + p
            log_l += 0.5 * np.sum((r / v).sum(axis=0) ** 2 / total - np.log(total / (p or 2 * np.pi)), axis=-1)
        log_prior = courses.log_prior[h] + np.zeros((ny, nx))
        if prior.position_m is not None:
            x = plane.origin_m[0] + plane.resolution_m * ii - prior.position_m[0]
            y = plane.origin_m[1] + plane.resolution_m * jj - prior.position_m[1]
            z_off = plane.height_m - prior.position_m[2]
            log_prior -= 0.5 * (x**2 + y**2 + z_off**2) / prior.sd_m**2
        scores[h] = log_l + log_prior
    if prior.walkable is not None:
        scores[:, ~prior.walkable[0]] = -np.inf
    return scores


def assert_same_as_exhaustive(
    planes: Sequence[Plane],
    window: ReducedWindow,
    courses: Courses,
    prior: PosePrior,
    error: WindowError,
    window_nats: float,
) -> None:
    found = search(planes, window, courses, prior, error, window_nats=window_nats, capacity=10**7)
    everything = [exhaustive_scores(plane, window, courses, prior, error) for plane in planes]
    best = max(float(scores.max()) for scores in everything)
    assert found.complete
    assert found.score[0] == pytest.approx(best, abs=1e-6)
    first = everything[found.plane[0]][found.course[0], found.row[0], found.column[0]]
    assert first == pytest.approx(best, abs=1e-6)
    margin = 1e-6
    for k, scores in enumerate(everything):
        here = found.plane == k
        got = np.full(scores.shape, -np.inf)
        got[found.course[here], found.row[here], found.column[here]] = found.score[here]
        surely = scores >= best - window_nats + margin
        assert np.isfinite(got[surely]).all()
        assert not np.isfinite(got[scores < best - window_nats - margin]).any()
        np.testing.assert_allclose(got[np.isfinite(got)], scores[np.isfinite(got)], atol=1e-6)
    left_out = sum(np.exp(s - best).sum() for s in everything) - np.exp(found.score - best).sum()
    assert left_out <= found.missed_mass * (1 + 1e-6) + 1e-6


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 10_000),
    frame=st.sampled_from(["building", "level", "norm"]),
    shapes=st.lists(st.tuples(st.integers(2, 40), st.integers(2, 40)), min_size=1, max_size=2),
    samples=st.integers(2, 12),
    length_m=st.sampled_from([0.0, 1.0, 4.0, 25.0]),
    offset_precision=st.sampled_from([None, None, 0.0, 0.05, 1.0]),
    nuisances=st.booleans(),
    positioned=st.booleans(),
    unmapped=st.sampled_from([0.0, 0.4]),
    field_sd_uT=st.sampled_from([0.3, 5.0]),
    offset_uT=st.sampled_from([0.0, 6.0]),
    inflation=st.sampled_from([1.0, 4.0]),
    tilted=st.booleans(),
    window_nats=st.sampled_from([0.0, 3.0, 12.0]),
)
def test_finds_exactly_what_the_exhaustive_scan_finds(
    seed: int, frame: str, shapes: list, samples: int, length_m: float, offset_precision: float | None,
    nuisances: bool, positioned: bool, unmapped: float, field_sd_uT: float, offset_uT: float, inflation: float,
    tilted: bool, window_nats: float, grid_of: Callable, walk_on: Callable,
) -> None:  # fmt: skip
    rng = np.random.default_rng(seed)
    grids = [grid_of(rng, shape, unmapped=unmapped, field_sd_uT=field_sd_uT) for shape in shapes]
    walked = walk_on(rng, grids[0], frame, length_m, samples, inside=False, offset_uT=offset_uT)
    components = "norm" if frame == "norm" else "vector"
    planes = [p for k, g in enumerate(grids) for p in reduce_floor(prepare_floor(str(k), g), components).planes]
    asked = walked.window
    if tilted and frame != "norm":
        asked = dataclasses.replace(asked, device_to_frame=Rotation.random(samples, random_state=rng).as_matrix())
    window = reduce_window(asked, components, 0.25, planes[0].scale)
    if len(window) == 1 and offset_precision == 0.0:
        offset_precision = None
    courses = courses_of(asked, 0.6, nuisances=nuisances)
    if positioned:
        courses = dataclasses.replace(courses, log_prior=courses.log_prior + rng.normal(size=len(courses)))
    position = (float(rng.uniform(-3, 4)), float(rng.uniform(7, 12)), 0.0) if positioned else None
    error = dataclasses.replace(plain_error(len(window), offset_precision), inflation=inflation, own_share=0.8)
    assert_same_as_exhaustive(planes, window, courses, PosePrior(position, 1.5), error, window_nats)


def courses_of(window: Window, step_rad: float, *, nuisances: bool = False) -> Courses:
    """A coarse lattice: headings, and with nuisances three scales and three drifts."""
    headings = heading_lattice(window, step_rad)
    if not nuisances:
        return single_course(headings)
    h, s, d = (a.ravel() for a in np.meshgrid(headings, [-0.1, 0.0, 0.1], [-0.05, 0.0, 0.05], indexing="ij"))
    drift = d if window.frame != "building" else 0.0 * d
    return Courses(h, 1.0 + s, drift, np.log(1.0 + s + 0.1 * d), Steps(step_rad, 0.1, 0.05))


@pytest.mark.parametrize("precision", [None, 0.0, 1.0])
@pytest.mark.parametrize("counts", [(37, 5, 3), (1, 7, 2), (16, 1, 9), (5, 1, 1)])
def test_groups_of_a_fine_lattice_lose_nothing(
    counts: tuple[int, int, int], precision: float | None, grid_of: Callable, walk_on: Callable
) -> None:
    """Headings, scales and drifts so close that groups of them go with every size of block; odd counts among them."""
    rng = np.random.default_rng(21)
    planes = prepare_floor("a", grid_of(rng, (24, 31), length_m=3.0)).planes
    walked = walk_on(rng, grid_of(rng, (60, 60)), length_m=6.0)
    window = reduce_window(walked.window, "vector", 0.25)
    h, s, d = (
        a.ravel()
        for a in np.meshgrid(
            walked.yaw_rad + 0.05 * np.arange(counts[0]), 1.0 + 0.02 * np.arange(counts[1]),
            0.01 * np.arange(counts[2]), indexing="ij",
        )
    )  # fmt: skip
    courses = Courses(h, s, d, rng.normal(size=len(h)), Steps(0.05, 0.02, 0.01))
    error = dataclasses.replace(plain_error(len(window), precision), inflation=2.0)
    assert_same_as_exhaustive(planes, window, courses, PosePrior(), error, 10.0)


@pytest.mark.parametrize("shape", [(1, 1), (1, 30), (2, 3)])
@pytest.mark.parametrize("precision", [None, 0.4])
def test_windows_longer_than_the_map_and_courses_in_no_order(
    shape: tuple[int, int], precision: float | None, grid_of: Callable, walk_on: Callable
) -> None:
    rng = np.random.default_rng(22)
    grid: FieldGrid = grid_of(rng, (2, 30))
    kept = np.s_[:, : shape[0], : shape[1]]
    names = ("mean_uT", "sd_uT", "gradient_uT_per_m", "measured")
    grid = dataclasses.replace(grid, **{name: getattr(grid, name)[kept] for name in names})
    planes = prepare_floor("a", grid).planes
    walked = walk_on(rng, grid_of(rng, (60, 60)), length_m=10.0)
    window = reduce_window(walked.window, "vector", 0.25)
    courses = single_course(rng.uniform(-np.pi, np.pi, 23))
    assert_same_as_exhaustive(planes, window, courses, PosePrior(), plain_error(len(window), precision), 12.0)


def test_a_window_that_matches_nothing_finds_the_best_all_the_same(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(23)
    planes = [plane for k in range(2) for plane in prepare_floor(str(k), grid_of(rng, (30, 40))).planes]
    walked = walk_on(rng, grid_of(rng, (60, 60)), length_m=6.0)
    window, courses = reduce_window(walked.window, "vector", 0.25), courses_of(walked.window, 0.2)
    window = dataclasses.replace(
        window, features_uT=window.features_uT + rng.normal(0.0, 20.0, window.features_uT.shape)
    )
    for precision in (None, 0.0, 1.0):
        assert_same_as_exhaustive(planes, window, courses, PosePrior(), plain_error(len(window), precision), 10.0)


def test_the_walkable_area_is_kept_to(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(14)
    grid = grid_of(rng, (40, 52))
    planes = prepare_floor("a", grid).planes
    walked = walk_on(rng, grid)
    window, courses = reduce_window(walked.window, "vector", 0.25, planes[0].scale), courses_of(walked.window, 0.3)
    mask = rng.random((40, 52)) < 0.02
    for precision in (None, 0.3):
        prior = PosePrior(walkable=[mask])
        assert_same_as_exhaustive(planes, window, courses, prior, plain_error(len(window), precision), 9.0)


def test_when_time_ends_what_was_missed_is_bounded(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(15)
    planes = prepare_floor("a", grid_of(rng, (60, 60))).planes
    walked = walk_on(rng, grid_of(rng, (60, 60)), samples=10)
    window, courses = reduce_window(walked.window, "vector", 0.25), courses_of(walked.window, 0.2)
    error = plain_error(len(window), 0.2)
    everything = exhaustive_scores(planes[0], window, courses, PosePrior(), error)
    for looks in (0, 1, 3):
        left = iter([False] * looks)
        found = search(
            planes,
            window,
            courses,
            PosePrior(),
            error,
            window_nats=10.0,
            out_of_time=lambda left=left: next(left, True),
        )
        assert not found.complete
        assert len(found.score) >= 1
        left_out = np.exp(everything - found.score[0]).sum() - np.exp(found.score - found.score[0]).sum()
        assert left_out <= found.missed_mass * (1 + 1e-6) + 1e-6


@pytest.mark.parametrize("components", ["level", "norm"])
def test_agrees_on_maps_of_poorer_components(components: str, grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(4)
    vector = grid_of(rng, (30, 50), heights_m=(0.5, 1.5))
    walked = walk_on(rng, vector, "level", layer=1)
    planes = reduce_floor(prepare_floor("a", vector), components).planes
    window = reduce_window(walked.window, components, 0.25, planes[0].scale)
    courses = courses_of(walked.window, 0.2)
    for precision in (None, 0.0, 0.5):
        assert_same_as_exhaustive(planes, window, courses, PosePrior(), plain_error(len(window), precision), 8.0)


def test_keeps_within_capacity_and_says_what_it_left(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(5)
    grid: FieldGrid = grid_of(rng, (40, 40), field_sd_uT=0.0)
    planes = prepare_floor("a", grid).planes
    walked = walk_on(rng, grid)
    window, courses = reduce_window(walked.window, "vector", 0.25), courses_of(walked.window, 0.2)
    error = plain_error(len(window))
    found = search(planes, window, courses, PosePrior(), error, window_nats=50.0, capacity=400)
    assert 0 < len(found.score) <= 400
    assert not found.complete
    everything = exhaustive_scores(planes[0], window, courses, PosePrior(), error)
    left_out = np.exp(everything - found.score[0]).sum() - np.exp(found.score - found.score[0]).sum()
    assert left_out <= found.missed_mass * (1 + 1e-6)
    assert np.ptp(found.row) > 20


@pytest.mark.parametrize(("ny", "nx"), [(1, 1), (3, 17), (20, 9)])
def test_pyramid_bounds_enclose_every_square(ny: int, nx: int) -> None:
    rng = np.random.default_rng(6)
    mean = rng.normal(size=(ny + 2, nx + 2, 2)).astype(np.float32)
    variance = rng.uniform(0.1, 30.0, size=(ny + 2, nx + 2)).astype(np.float32)
    for border in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        mean[border], variance[border] = 7.0, 40.0
    tree = build_pyramid(mean, variance, 4)
    pad = 40
    big_mean = np.pad(mean[1:-1, 1:-1], ((pad, pad), (pad, pad), (0, 0)), constant_values=7.0)
    big_variance = np.pad(variance[1:-1, 1:-1], pad, constant_values=40.0)
    for level in tree.levels:
        codes = level.records.view(np.uint8)[..., 16:18]
        height, width = codes.shape[:2]
        for j in range(-level.side - 3, ny + 3):
            for i in range(-level.side - 3, nx + 3):
                at = tuple(min(max((k + level.base) // level.step, 0), n - 1) for k, n in ((j, height), (i, width)))
                square = np.s_[j + pad : j + pad + level.side, i + pad : i + pad + level.side]
                low, high = big_mean[square].min(axis=(0, 1)), big_mean[square].max(axis=(0, 1))
                assert (level.records[at][:2] <= low).all()
                assert (level.records[at][2:4] >= high).all()
                if level.step == 1:
                    np.testing.assert_array_equal(level.records[at][:4], np.concatenate([low, high]))
                assert tree.ladder_uT2[codes[at][0]] <= big_variance[square].min()
                assert tree.ladder_uT2[codes[at][1]] >= big_variance[square].max()


@pytest.mark.parametrize("precision", [None, 0.0])
def test_a_spent_budget_leaves_a_valid_bound(precision: float | None, grid_of: Callable, walk_on: Callable) -> None:
    """However little work is allowed: the mass left out stays bounded, and the answer does not claim completeness."""
    rng = np.random.default_rng(7)
    planes = prepare_floor("a", grid_of(rng, (40, 40), field_sd_uT=1.0)).planes
    walked = walk_on(rng, grid_of(rng, (40, 40)), samples=10)
    window, courses = reduce_window(walked.window, "vector", 0.25), courses_of(walked.window, 0.2)
    error = dataclasses.replace(plain_error(len(window), precision), inflation=4.0)
    everything = exhaustive_scores(planes[0], window, courses, PosePrior(), error)
    for budget in (1, 100_000):
        found = search(planes, window, courses, PosePrior(), error, window_nats=50.0, budget=budget)
        assert not found.complete
        assert len(found.score) * len(window) * 3 <= max(budget, 1000)
        best = found.score[0]
        left_out = np.exp(everything - best).sum() - np.exp(found.score - best).sum()
        assert left_out <= found.missed_mass * (1 + 1e-6) + 1e-6
