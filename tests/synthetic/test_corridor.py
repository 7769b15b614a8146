"""Storms' corridor: its sizes, its map, and walks along it."""

import numpy as np
import pytest

from app.synthetic.corridor import CORNER_M, FINE_M, NODE_M, inside, make_corridor, surveyed_cells, walk_corridor


@pytest.fixture(scope="module")
def corridor():
    return make_corridor(np.random.default_rng(0))


@pytest.fixture(scope="module")
def cells(corridor):
    return surveyed_cells(corridor, np.random.default_rng(1))


def test_sizes_follow_from_the_source():
    assert CORNER_M[0] == pytest.approx(40.0, abs=0.01)  # 80 s at 0.5 m/s (Storms, L729)
    assert CORNER_M[1] == pytest.approx(-1.145, abs=0.003)  # where its vehicle starts (Storms, L817)
    assert pytest.approx(10 * FINE_M) == NODE_M


def test_nodes_keep_their_values_and_the_rest_is_unknown(corridor, cells):
    nodes = np.array([[3.81, -0.762], [20.955, -2.286], [40.005, -11.049], [41.148, -19.431]])
    np.testing.assert_allclose(cells.at(nodes), corridor.field_uT(nodes), atol=1e-6)
    assert np.isnan(cells.at(np.array([[10.0, -5.0]]))).all()
    assert cells.known.sum() == (61 * 1081 + 450 * 61)


def test_gradient_is_as_asked(corridor, cells):
    steps = np.gradient(cells.mean_uT, FINE_M, axis=(0, 1))
    slope = np.sqrt(sum(np.square(each).sum(axis=-1) for each in steps))
    assert np.median(slope[cells.known]) == pytest.approx(3.0, rel=0.15)


def test_old_maps_say_how_much_they_err(corridor, cells):
    old = surveyed_cells(corridor, np.random.default_rng(2), noise_uT=0.167, drift_sd_uT=0.3)
    assert old.variance_uT2[0, -1, 0] == pytest.approx(0.167**2 + 0.3**2)
    error = (old.mean_uT - cells.mean_uT)[cells.known]
    assert error.std() == pytest.approx(np.sqrt(0.167**2 + 0.3**2), rel=0.3)


@pytest.mark.parametrize("sigma_a", [0.08, 0.02])
def test_walks_stay_inside_turn_once_and_follow_the_model(sigma_a):
    walks = walk_corridor(np.random.default_rng(3), 20, sigma_a)
    assert walks.state.shape == (20, 1156, 4)
    assert inside(walks.state[..., :2], 1e-5).all()
    assert np.all((walks.turn_step >= 650) & (walks.turn_step <= 950))
    before = np.concatenate([state[:step] for state, step in zip(walks.state, walks.turn_step, strict=True)])
    assert before[:, 2].mean() == pytest.approx(0.5, abs=0.1)
    changes = np.concatenate([np.diff(s[:k], axis=0)[:, 2:] for s, k in zip(walks.state, walks.turn_step, strict=True)])
    assert changes.std() == pytest.approx(sigma_a * np.sqrt(0.1), rel=0.05)


def test_walks_repeat_with_their_seed():
    one, other = (walk_corridor(np.random.default_rng(5), 3) for _ in range(2))
    np.testing.assert_array_equal(one.state, other.state)
