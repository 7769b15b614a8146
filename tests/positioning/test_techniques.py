"""ML, MLR and ABL on the vectors that tell them apart, and the scales they must not depend on."""

import numpy as np
import pytest

from app.positioning.techniques import (
    best_bin,
    chi_square_limit,
    likelihood_rival,
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
