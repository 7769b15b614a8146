"""Branch and bound against the naive exhaustive scan: the same poses with the same scores, whatever the world."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from app.field.grid import FieldGrid
from app.field.pyramid import build_pyramid
from app.positioning.floors import Plane, prepare_floor, reduce_floor
from app.positioning.lattice import ReducedWindow, heading_lattice, reduce_window
from app.positioning.search import PosePrior, search

FLAT = 1.0


def exhaustive_scores(
    plane: Plane, window: ReducedWindow, headings: np.ndarray, prior: PosePrior, temper: float, demeaned: bool
) -> np.ndarray:
    """(headings, ny, nx) of log L + temper * log prior, by the formula, one sample after the other."""
    ny, nx = plane.shape
    scores = np.empty((len(headings), ny, nx))
    jj, ii = np.meshgrid(np.arange(ny), np.arange(nx), indexing="ij")
    for h, heading in enumerate(headings):
        c, s = np.cos(heading), np.sin(heading)
        residuals, variances = [], []
        for k in range(len(window)):
            dx, dy = window.from_last_m[k]
            row = jj + int(np.rint((s * dx + c * dy) / plane.resolution_m))
            column = ii + int(np.rint((c * dx - s * dy) / plane.resolution_m))
            inside = (row >= 0) & (row < ny) & (column >= 0) & (column < nx)
            at = (row.clip(0, ny - 1) + 1, column.clip(0, nx - 1) + 1)
            mean = np.where(inside[..., None], plane.mean_uT[at], plane.ambient_uT.astype(np.float32)).astype(float)
            off_map = plane.off_map_variance_uT2.astype(np.float32)
            variance = np.where(inside[..., None], plane.variance_uT2[at], off_map).astype(float)
            z = window.features_uT[k].copy()
            if window.turns:
                z[:2] = c * z[0] - s * z[1], s * z[0] + c * z[1]
            residuals.append(z - mean)
            variances.append(variance + window.noise_variance_uT2[k])
        r, v = np.array(residuals), np.array(variances)
        if demeaned:
            offset = (r / v).sum(axis=0) / (1 / v).sum(axis=0)
            log_l = -0.5 * ((r - offset) ** 2 / v + np.log(2 * np.pi * v)).sum(axis=(0, 3))
            log_l += 0.5 * np.log(2 * np.pi / (1 / v).sum(axis=0)).sum(axis=-1)
        else:
            log_l = -0.5 * (r**2 / v + np.log(2 * np.pi * v)).sum(axis=(0, 3))
        log_prior = prior.heading_log[h] + np.zeros((ny, nx))
        if prior.position_m is not None:
            x = plane.origin_m[0] + plane.resolution_m * ii - prior.position_m[0]
            y = plane.origin_m[1] + plane.resolution_m * jj - prior.position_m[1]
            z_off = plane.height_m - prior.position_m[2]
            log_prior -= 0.5 * (x**2 + y**2 + z_off**2) / prior.sd_m**2
        scores[h] = log_l + temper * log_prior
    return scores


def assert_same_as_exhaustive(
    planes: Sequence[Plane],
    window: ReducedWindow,
    headings: np.ndarray,
    prior: PosePrior,
    window_nats: float,
    temper: float,
    demeaned: bool,
) -> None:
    found = search(
        planes, window, headings, prior, window_nats=window_nats, temper=temper, demeaned=demeaned, capacity=10**7
    )
    everything = [exhaustive_scores(plane, window, headings, prior, temper, demeaned) for plane in planes]
    best = max(float(scores.max()) for scores in everything)
    assert found.complete
    assert found.score[0] == pytest.approx(best, abs=1e-6)
    first = everything[found.plane[0]][found.heading[0], found.row[0], found.column[0]]
    assert first == pytest.approx(best, abs=1e-6)
    margin = 1e-6
    for k, scores in enumerate(everything):
        here = found.plane == k
        got = np.full(scores.shape, -np.inf)
        got[found.heading[here], found.row[here], found.column[here]] = found.score[here]
        surely = scores >= best - window_nats + margin
        assert np.isfinite(got[surely]).all()
        assert not np.isfinite(got[scores < best - window_nats - margin]).any()
        np.testing.assert_allclose(got[np.isfinite(got)], scores[np.isfinite(got)], atol=1e-6)
    left_out = sum(np.exp((s - best) / temper).sum() for s in everything) - np.exp((found.score - best) / temper).sum()
    assert left_out <= found.missed_mass * (1 + 1e-6) + 1e-6


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    seed=st.integers(0, 10_000),
    frame=st.sampled_from(["building", "level", "norm"]),
    shapes=st.lists(st.tuples(st.integers(2, 40), st.integers(2, 40)), min_size=1, max_size=2),
    samples=st.integers(2, 12),
    length_m=st.sampled_from([0.0, 1.0, 4.0, 25.0]),
    demeaned=st.booleans(),
    positioned=st.booleans(),
    unmapped=st.sampled_from([0.0, 0.4]),
    field_sd_uT=st.sampled_from([0.3, 5.0]),
    offset_uT=st.sampled_from([0.0, 6.0]),
    temper=st.sampled_from([1.0, 4.0]),
    window_nats=st.sampled_from([0.0, 3.0, 12.0]),
)
def test_finds_exactly_what_the_exhaustive_scan_finds(
    seed: int, frame: str, shapes: list, samples: int, length_m: float, demeaned: bool, positioned: bool,
    unmapped: float, field_sd_uT: float, offset_uT: float, temper: float, window_nats: float,
    grid_of: Callable, walk_on: Callable,
) -> None:  # fmt: skip
    rng = np.random.default_rng(seed)
    grids = [grid_of(rng, shape, unmapped=unmapped, field_sd_uT=field_sd_uT) for shape in shapes]
    walked = walk_on(rng, grids[0], frame, length_m, samples, inside=False, offset_uT=offset_uT)
    components = "norm" if frame == "norm" else "vector"
    planes = [p for k, g in enumerate(grids) for p in reduce_floor(prepare_floor(str(k), g), components).planes]
    window = reduce_window(walked.window, components, 0.25)
    if len(window) == 1:
        demeaned = False
    headings = heading_lattice(walked.window, 0.6)
    heading_log = rng.normal(size=len(headings)) if positioned else np.zeros(len(headings))
    position = (float(rng.uniform(-3, 4)), float(rng.uniform(7, 12)), 0.0) if positioned else None
    prior = PosePrior(position, 1.5, heading_log)
    assert_same_as_exhaustive(planes, window, headings, prior, window_nats, temper, demeaned)


@pytest.mark.parametrize("components", ["level", "norm"])
def test_agrees_on_maps_of_poorer_components(components: str, grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(4)
    vector = grid_of(rng, (30, 50), heights_m=(0.5, 1.5))
    walked = walk_on(rng, vector, "level", layer=1)
    planes = reduce_floor(prepare_floor("a", vector), components).planes
    window = reduce_window(walked.window, components, 0.25)
    headings = heading_lattice(walked.window, 0.2)
    prior = PosePrior(None, FLAT, np.zeros(len(headings)))
    assert_same_as_exhaustive(planes, window, headings, prior, 8.0, 1.0, False)
    assert_same_as_exhaustive(planes, window, headings, prior, 8.0, 1.0, True)


def test_keeps_within_capacity_and_says_what_it_left(grid_of: Callable, walk_on: Callable) -> None:
    rng = np.random.default_rng(5)
    grid: FieldGrid = grid_of(rng, (40, 40), field_sd_uT=0.0)
    planes = prepare_floor("a", grid).planes
    walked = walk_on(rng, grid)
    window, headings = reduce_window(walked.window, "vector", 0.25), heading_lattice(walked.window, 0.2)
    prior = PosePrior(None, FLAT, np.zeros(len(headings)))
    found = search(planes, window, headings, prior, window_nats=50.0, capacity=400)
    assert 0 < len(found.score) <= 400
    assert not found.complete
    everything = exhaustive_scores(planes[0], window, headings, prior, 1.0, False)
    left_out = np.exp(everything - found.score[0]).sum() - np.exp(found.score - found.score[0]).sum()
    assert left_out <= found.missed_mass * (1 + 1e-6)
    assert np.ptp(found.row) > 20


@pytest.mark.parametrize(("ny", "nx"), [(1, 1), (3, 17), (20, 9)])
def test_pyramid_bounds_enclose_every_square(ny: int, nx: int) -> None:
    rng = np.random.default_rng(6)
    mean = rng.normal(size=(ny + 2, nx + 2, 2)).astype(np.float32)
    variance = rng.uniform(0.1, 30.0, size=(ny + 2, nx + 2, 2)).astype(np.float32)
    for border in (np.s_[0], np.s_[-1], np.s_[:, 0], np.s_[:, -1]):
        mean[border], variance[border] = 7.0, 40.0
    tree = build_pyramid(mean, variance, 4)
    pad = 40
    big_mean, big_variance = (np.pad(a[1:-1, 1:-1], ((pad, pad), (pad, pad), (0, 0)), constant_values=value)
                              for a, value in ((mean, 7.0), (variance, 40.0)))  # fmt: skip
    for level in tree.levels:
        codes = level.records.view(np.uint8)[..., 16:20]
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
                least, most = big_variance[square].min(axis=(0, 1)), big_variance[square].max(axis=(0, 1))
                for c in range(2):
                    assert tree.ladder_uT2[c, codes[at][c]] <= least[c]
                    assert tree.ladder_uT2[c, codes[at][2 + c]] >= most[c]


@pytest.mark.parametrize("demeaned", [False, True])
def test_a_spent_budget_leaves_a_valid_bound(demeaned: bool, grid_of: Callable, walk_on: Callable) -> None:
    """However little work is allowed: the mass left out stays bounded, and the answer does not claim completeness."""
    rng = np.random.default_rng(7)
    planes = prepare_floor("a", grid_of(rng, (40, 40), field_sd_uT=1.0)).planes
    walked = walk_on(rng, grid_of(rng, (40, 40)), samples=10)
    window, headings = reduce_window(walked.window, "vector", 0.25), heading_lattice(walked.window, 0.2)
    prior = PosePrior(None, FLAT, np.zeros(len(headings)))
    everything = exhaustive_scores(planes[0], window, headings, prior, 4.0, demeaned)
    for budget in (1, 100_000):
        found = search(planes, window, headings, prior, window_nats=200.0, temper=4.0, demeaned=demeaned, budget=budget)
        assert not found.complete
        assert len(found.score) * len(window) * 3 <= max(budget, 1000)
        best = found.score[0]
        left_out = np.exp((everything - best) / 4.0).sum() - np.exp((found.score - best) / 4.0).sum()
        assert left_out <= found.missed_mass * (1 + 1e-6) + 1e-6
