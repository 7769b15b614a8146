"""The nearest point on the measured contour against brute force, and the check of a contour against the truth."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from app.positioning.contour import ContourPoint, contour_tolerance_uT, nearest_on_contour

SHAPES = st.tuples(st.integers(1, 8), st.integers(1, 8))
NORMS = SHAPES.flatmap(lambda s: arrays(float, s, elements=st.one_of(st.floats(40.0, 60.0), st.just(np.nan))))
PLACES = st.tuples(st.floats(-3.0, 11.0), st.floats(-3.0, 11.0))


def brute_force(norm, start, measured, tolerance, reach):
    best = None
    for row in range(norm.shape[0]):
        for column in range(norm.shape[1]):
            distance = float(np.hypot(row - start[0], column - start[1]))
            agrees = abs(norm[row, column] - measured) <= tolerance[row, column] and distance <= reach
            if agrees and (best is None or distance < best.distance_cells):
                best = ContourPoint(row, column, distance)
    return best


@given(NORMS, PLACES, st.floats(40.0, 60.0), st.floats(0.0, 5.0), st.floats(0.0, 12.0))
def test_as_by_brute_force(norm, start, measured, sigma, reach):
    tolerance = contour_tolerance_uT(norm, 0.25, sigma)
    found = nearest_on_contour(norm, start, measured, tolerance, reach)
    assert found == brute_force(norm, start, measured, tolerance, reach)


@given(NORMS, st.floats(0.0, 5.0))
def test_tolerance_is_known_everywhere_and_at_least_a_sigma(norm, sigma):
    tolerance = contour_tolerance_uT(norm, 0.25, sigma)
    assert tolerance.shape == norm.shape
    assert np.all(tolerance >= sigma)


@pytest.mark.parametrize("resolution_m", [0.1, 0.5])
def test_tolerance_is_half_the_change_across_a_cell(resolution_m):
    row, column = np.mgrid[:6, :7].astype(float)
    norm = 50.0 + 0.6 * row + 0.8 * column
    np.testing.assert_allclose(contour_tolerance_uT(norm, resolution_m, 0.1), 0.5)
    norm[2, 3] = np.nan  # beside a gap one side is enough
    np.testing.assert_allclose(contour_tolerance_uT(norm, resolution_m, 0.1)[np.isfinite(norm)], 0.5)
    np.testing.assert_allclose(contour_tolerance_uT(norm, resolution_m, 2.0), 2.0)


@given(st.integers(0, 30))
def test_a_place_that_agrees_stays(seed):
    rng = np.random.default_rng(seed)
    norm = 50.0 + rng.normal(size=(9, 9))
    row, column = rng.integers(9, size=2)
    found = nearest_on_contour(norm, (float(row), float(column)), float(norm[row, column]), 0.01, 5.0)
    assert found == ContourPoint(row, column, 0.0)


def test_one_tolerance_for_all_cells():
    norm = np.array([[50.0, 51.0, 52.0, 53.0]])
    assert nearest_on_contour(norm, (0.0, 0.2), 52.4, 0.5, 9.0) == ContourPoint(0, 2, pytest.approx(1.8))
    assert nearest_on_contour(norm, (0.0, 0.2), 52.4, 0.5, 1.0) is None


def test_the_truth_lies_on_the_contour_of_its_reading():
    """Three points, their readings and the contour: within sigma / |gradient| and half a cell (Cuenca, L909)."""
    rng = np.random.default_rng(5)
    resolution_m, sigma_uT = 0.1, 0.15
    y, x = np.mgrid[:60, :80] * resolution_m
    norm = 50.0 + 3.0 * np.sin(0.9 * x) + 2.0 * np.cos(1.1 * y + 0.4 * x)
    tolerance = contour_tolerance_uT(norm, resolution_m, sigma_uT)
    slope = np.hypot(*np.gradient(norm, resolution_m))
    steep = np.argwhere(slope > 1.0)
    for row, column in steep[rng.integers(len(steep), size=30)]:
        reading = float(norm[row, column] + sigma_uT * rng.uniform(-1.0, 1.0))
        found = nearest_on_contour(norm, (float(row), float(column)), reading, tolerance, 10.0)
        assert found is not None
        assert found.distance_cells * resolution_m <= sigma_uT / slope[row, column] + resolution_m
