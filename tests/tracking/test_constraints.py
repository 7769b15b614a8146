"""Box, altimeter and road against the sources' tables."""

import numpy as np
import pytest

from app.tracking.constraints import Box, RoadPenalty, altimeter_log_likelihood

DOWN = np.array([1.0, 1.0, -1.0, 1.0, 1.0, -1.0])  # the source's z points down
BOX = Box(np.array([-2.25, -1.75, 0.0]), np.array([2.25, 1.75, 2.5]))
ALL_OUTSIDE = np.array(
    [
        [3.2, 1.1, -2.1, 0.75, 0.12, 0.13],
        [1.7, 1.9, -2.2, 0.1, 0.3, 0.12],
        [1.8, 2.1, -2.7, 0.2, 0.5, -0.2],
    ]
)
MOVED_IN = np.array(
    [
        [2.0, 1.1, -2.1, 0.0, 0.12, 0.13],
        [1.7, 1.5, -2.2, 0.1, 0.0, 0.12],
        [1.8, 1.5, -2.25, 0.2, 0.0, 0.0],
    ]
)


class TestBox:
    def test_table_4_1_becomes_table_4_2(self):
        """All outside: back in by a quarter of a metre, axis by axis (Kuevor, L1577-L1589)."""
        found = BOX.apply(ALL_OUTSIDE * DOWN, np.log([0.15, 0.8, 0.05]))
        assert found.all_outside
        np.testing.assert_allclose(found.state * DOWN, MOVED_IN, atol=1e-12)
        np.testing.assert_allclose(np.exp(found.log_weight), 1.0 / 3.0)

    def test_one_inside_is_enough(self):
        state = np.vstack([ALL_OUTSIDE * DOWN, [[0.0, 0.0, 1.0, 0.0, 0.0, 0.0]]])
        found = BOX.apply(state, np.log(np.full(4, 0.25)))
        assert not found.all_outside
        np.testing.assert_array_equal(np.exp(found.log_weight), [0.0, 0.0, 0.0, 0.25])
        np.testing.assert_array_equal(found.state, state)

    def test_nothing_to_do(self):
        state, log_weight = np.zeros((2, 6)), np.log([0.5, 0.5])
        found = BOX.apply(state, log_weight)
        assert found.state is state
        assert found.log_weight is log_weight

    def test_the_caller_keeps_its_own(self):
        state = ALL_OUTSIDE * DOWN
        BOX.apply(state, np.zeros(3))
        np.testing.assert_array_equal(state, ALL_OUTSIDE * DOWN)


def test_altimeter():
    """Height up from the floor, variance 0.005 m^2 (Kuevor, eq. 4.9, L1846)."""
    found = altimeter_log_likelihood(np.array([1.0, 1.1]), 1.0)
    np.testing.assert_allclose(found, [0.0, -0.5 * 0.01 / 0.005])


def test_road_weights():
    """0, 3, 6, 12 and 18 m from the nearest sample (Shockley 10.2)."""
    road = RoadPenalty.of(np.column_stack([np.arange(100.0), np.zeros(100)]))
    log_penalty, nearest = road.nearest(np.column_stack([[10.0, 20.0, 30.2, 40.0, 50.0], [0.0, 3.0, 6.0, -12.0, 18.0]]))
    assert list(nearest) == [10, 20, 30, 40, 50]
    np.testing.assert_allclose(np.exp(log_penalty), [1.0, 0.8825, 0.6065, 0.1353, 0.0111], atol=5e-4)
    assert np.exp(road.nearest(np.array([[5.0, 6.0]]))[0][0]) == pytest.approx(0.6065, abs=5e-5)
