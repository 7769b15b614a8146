"""Features: found where the field stands out, laid on the map's peaks, and never believed more than the rest allows."""

from collections.abc import Callable

import numpy as np
import pytest

from app.errors import InvalidWindow
from app.field.grid import FieldGrid
from app.positioning.feature_matching import feature_candidates, find_feature, map_peaks
from app.positioning.floors import prepare_floor
from app.positioning.lattice import reduce_window, single_course, turn_window
from app.positioning.locate import locate
from app.positioning.window import Window


@pytest.fixture(scope="module")
def bumps() -> list[tuple[float, float]]:
    return [(6.0, 5.0), (14.0, 9.0), (22.0, 4.0)]


@pytest.fixture
def grid(grid_of: Callable, bumps: list[tuple[float, float]]) -> FieldGrid:
    """A flat map with three bumps of unlike shapes, metres wide."""
    base: FieldGrid = grid_of(np.random.default_rng(0), (60, 110), field_sd_uT=0.0, noise_sd_uT=0.3, map_sd_uT=0.1,
                              origin_m=(0.0, 0.0))  # fmt: skip
    x, y = np.meshgrid(0.25 * np.arange(110), 0.25 * np.arange(60))
    mean = base.mean_uT.copy()
    for k, (cx, cy) in enumerate(bumps):
        height = np.array([12.0, 4.0 * k, -10.0 + 6.0 * k])
        mean[0] += (np.exp(-((x - cx) ** 2 + (y - cy) ** 2) / 2.0)[..., None] * height).astype(np.float32)
    return FieldGrid(**{name: mean if name == "mean_uT" else getattr(base, name) for name in base.__slots__})


def walk_past(grid: FieldGrid, bump: tuple[float, float], rng: np.random.Generator, noise_uT: float = 0.2) -> Window:
    along = np.linspace(-5.0, 5.0, 41)
    p = np.column_stack([bump[0] + along, np.full(41, bump[1] + 0.25)])
    B = grid.at(np.column_stack([p, np.full(41, 1.2)])).mean_uT + rng.normal(0.0, noise_uT, (41, 3))
    return Window("building", B, np.column_stack([p - p[0], np.zeros(41)]), noise_uT)


def test_the_map_peaks_are_the_bumps(grid: FieldGrid, bumps: list[tuple[float, float]]) -> None:
    (plane,) = prepare_floor("a", grid).planes
    peaks = 0.25 * map_peaks(plane, 5.0)[:, ::-1]
    assert len(peaks) == 3
    for bump in bumps:
        assert np.linalg.norm(peaks - bump, axis=1).min() < 0.3


def test_a_feature_is_a_section_about_its_peak(grid: FieldGrid, bumps: list[tuple[float, float]]) -> None:
    window = reduce_window(walk_past(grid, bumps[1], np.random.default_rng(1)), "vector", 0.25)
    feature = find_feature(window, 0.5)
    assert feature.deviation_uT > 8.0
    assert len(feature.section) < len(window) // 2
    at = feature.section.from_last_m[feature.peak] - [-5.0, 0.0]
    assert np.linalg.norm(at) < 0.6
    with pytest.raises(InvalidWindow, match="stands out"):
        find_feature(window, 10.0)


def test_candidates_put_the_peak_on_a_peak(grid: FieldGrid, bumps: list[tuple[float, float]]) -> None:
    (plane,) = prepare_floor("a", grid).planes
    window = reduce_window(walk_past(grid, bumps[0], np.random.default_rng(2)), "vector", 0.25)
    feature = find_feature(window, 0.5)
    courses = single_course(np.linspace(0.0, 6.0, 20))
    found = feature_candidates(feature, [plane], courses)
    offset = turn_window(feature.section, courses, 0.25).offset_cells[found.course, feature.peak]
    peak = 0.25 * (np.stack([found.row, found.column], axis=1) + offset)[:, ::-1]
    near = np.min([np.linalg.norm(peak - bump, axis=1) for bump in bumps], axis=0)
    assert near.max() < 0.8
    assert len(found.row) > 3 * len(courses)


def test_a_window_past_a_feature_is_found_by_it(grid: FieldGrid, bumps: list[tuple[float, float]]) -> None:
    floors, rng = [prepare_floor("a", grid)], np.random.default_rng(3)
    for bump in bumps:
        fix = locate(walk_past(grid, bump, rng), floors, composition="feature")
        assert fix.ml is not None
        assert np.linalg.norm(np.array(fix.ml.position_m[:2]) - [bump[0] + 5.0, bump[1] + 0.25]) < 0.5
        assert fix.ml.residual_rms_uT < 1.0


def test_an_unknown_feature_is_refused_by_its_rms(grid: FieldGrid, bumps: list[tuple[float, float]]) -> None:
    from app.positioning.fix import LocateOptions

    window = walk_past(grid, bumps[0], np.random.default_rng(4))
    other = window.B_uT.copy()
    other[:, 1] += 25.0 * np.exp(-(np.linspace(-5, 5, 41) ** 2))
    fix = locate(
        Window("building", other, window.displacement_m, 0.2),
        [prepare_floor("a", grid)],
        composition="feature",
        options=LocateOptions(feature_rms_uT=1.5),
    )
    assert fix.status in ("inconsistent", "unmapped")
    assert fix.ml is not None
    assert fix.ml.residual_rms_uT > 1.5
