"""ML, MLR and ABL on the vectors that tell them apart, and the scales they must not depend on."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.positioning.techniques import (
    best_bin,
    best_stretch_bin,
    chi_square_limit,
    likelihood_rival,
    normalised_mass,
    peak_over_uniform,
)


@pytest.fixture
def log_l() -> np.ndarray:
    """Sixty points a metre apart: a broad good region about 12 and one slightly better point at 45."""
    squares = np.full(60, 400.0)
    squares[9:16] = 90, 40, 20, 15, 22, 45, 95
    squares[45] = 9
    return -squares / (2 * 7.0**2)


def test_ratio_refuses_what_maximum_likelihood_reports(log_l: np.ndarray) -> None:
    best = int(np.argmax(log_l))
    assert best == 45
    places = np.column_stack([np.arange(60.0), np.zeros(60)])
    rival = likelihood_rival(places, np.zeros(60, dtype=np.int64), log_l, best, 20.0)
    assert rival is not None
    assert rival.candidate == 12
    assert np.exp(rival.log_ratio) == pytest.approx(1.06314, rel=1e-5)


@pytest.mark.parametrize(("cells", "mass"), [(3, 0.390118), (5, 0.594719), (7, 0.717556)])
def test_bins_prefer_the_broad_region(log_l: np.ndarray, cells: int, mass: float) -> None:
    share = np.exp(log_l) / np.exp(log_l).sum()
    assert np.exp(log_l).sum() == pytest.approx(6.337560, rel=1e-6)
    assert share.max() == pytest.approx(0.143944, rel=1e-5)
    for table in (share[None, :], share[:, None]):
        found = best_bin(table, cells)
        assert found.mass == pytest.approx(mass, rel=1e-5)
        assert max(found.row, found.column) == pytest.approx(12.0, abs=0.3)


@pytest.mark.parametrize(("width_m", "mass"), [(3.0, 0.390118), (5.0, 0.594719), (7.0, 0.717556)])
def test_bins_along_a_road_prefer_the_broad_region(log_l: np.ndarray, width_m: float, mass: float) -> None:
    share = normalised_mass(log_l)
    along_m = np.arange(60.0)
    found = best_stretch_bin(share, along_m, np.zeros(60, dtype=np.int64), along_m[:, None], width_m)
    assert found.mass == pytest.approx(mass, rel=1e-5)
    assert (found.first + found.stop - 1) / 2 == 12.0
    assert found.stop - found.first == width_m
    assert found.position_m[0] == pytest.approx(12.0, abs=0.3)


def test_bins_do_not_reach_over_the_joint_of_two_roads(log_l: np.ndarray) -> None:
    stretch, along_m = np.repeat([0, 1], [12, 48]), np.concatenate([np.arange(12.0), np.arange(48.0)])
    position_m = np.stack([along_m, 50.0 * stretch], axis=1)  # the broad region is cut between its samples 11 and 12
    found = best_stretch_bin(normalised_mass(log_l), along_m, stretch, position_m, 7.0)
    assert (found.first, found.stop) == (12, 19)
    assert found.position_m[1] == pytest.approx(50.0)


@given(st.integers(0, 200), st.floats(0.3, 9.0))
def test_best_bin_along_a_road_as_by_hand(seed: int, width_m: float) -> None:
    rng = np.random.default_rng(seed)
    lengths = rng.integers(1, 9, size=3)
    stretch = np.repeat(np.arange(3), lengths)
    along_m = np.concatenate([rng.uniform(-5.0, 5.0) + np.cumsum(rng.uniform(0.1, 2.0, n)) for n in lengths])
    mass = rng.dirichlet(np.ones(len(stretch)))
    heaviest = max(
        sum(
            mass[j]
            for j in range(i, len(mass))
            if stretch[j] == stretch[i] and along_m[j] - along_m[i] < width_m * (1 - 1e-9)
        )
        for i in range(len(mass))
    )
    found = best_stretch_bin(mass, along_m, stretch, along_m[:, None], width_m)
    assert found.mass == pytest.approx(heaviest)
    assert found.mass == pytest.approx(mass[found.first : found.stop].sum())
    assert along_m[found.first] - 1e-9 <= found.position_m[0] <= along_m[found.stop - 1] + 1e-9


def test_mass_survives_likelihoods_that_underflow() -> None:
    np.testing.assert_allclose(normalised_mass(np.array([-5000.0, -5000.0 + np.log(3.0)])), [0.25, 0.75])


def test_no_rival_where_the_map_ends() -> None:
    places = np.array([[0.0, 0.0], [1.0, 0.0]])
    planes = np.zeros(2, dtype=np.int64)
    assert likelihood_rival(places, planes, np.array([0.0, -1.0]), 0, 5.0) is None
    other_floor = likelihood_rival(places, np.array([0, 1]), np.array([0.0, -1.0]), 0, 5.0)
    assert other_floor is not None
    assert other_floor.log_ratio == 1.0


def test_threshold_is_the_same_on_maps_of_any_size() -> None:
    for cells in (100, 10_000):
        assert peak_over_uniform(np.full(cells, 3.0), cells) == pytest.approx(1.0)


def test_gate_of_one_vector() -> None:
    assert chi_square_limit(3, 0.997) == pytest.approx(13.93, abs=0.01)
    assert chi_square_limit(3, 0.997) < 1000 / 7.2**2  # a ratio of 2.62 would let this pass
