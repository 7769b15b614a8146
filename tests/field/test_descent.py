"""Against functions whose minimum is known, and SciPy's bounded least squares where it is not."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear, rosen, rosen_der

from app.field.descent import descend

WIDE = np.array([(-50.0, 50.0)] * 3)


def bowl(curvature, centre):
    return lambda x: (0.5 * (x - centre) @ curvature @ (x - centre), curvature @ (x - centre))


def counted(objective):
    calls = []

    def counting(x):
        calls.append(x)
        return objective(x)

    return counting, calls


@given(seed=st.integers(0, 10_000))
def test_a_bowl_within_bounds_has_the_minimum_of_a_second_implementation(seed):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(3, 3))
    curvature, centre = a @ a.T + 0.3 * np.eye(3), rng.uniform(-3.0, 3.0, 3)
    bounds = np.array([(-1.0, 1.5)] * 3)
    found = descend(bowl(curvature, centre), np.zeros(3), bounds, 0.1 * np.eye(3), 1e-10)
    root = np.linalg.cholesky(curvature).T
    theirs = lsq_linear(root, root @ centre, (bounds[:, 0], bounds[:, 1]), method="bvls", tol=1e-14)
    assert np.all((found.point >= bounds[:, 0]) & (found.point <= bounds[:, 1]))
    assert found.value == pytest.approx(theirs.cost, abs=1e-8)


def test_a_bent_valley_is_followed_to_its_end():
    found = descend(lambda x: (rosen(x), rosen_der(x)), np.array([-1.2, 1.0, 0.5]), WIDE, np.eye(3), 1e-12)
    assert np.allclose(found.point, 1.0, atol=1e-3)


def test_the_curvature_found_makes_the_next_search_short():
    curvature = np.array([[5.0, 1.0, 0.0], [1.0, 0.5, 0.1], [0.0, 0.1, 0.05]])
    first, first_calls = counted(bowl(curvature, np.ones(3)))
    found = descend(first, np.zeros(3), WIDE, 0.1 * np.eye(3), 1e-10)
    second, second_calls = counted(bowl(curvature, np.array([1.2, 0.9, 1.1])))
    again = descend(second, found.point, WIDE, found.curvature, 1e-10)
    assert again.value < 1e-6
    assert len(second_calls) < 0.6 * len(first_calls)


def test_where_nothing_can_be_gained_one_evaluation_is_enough():
    objective, calls = counted(bowl(np.eye(3), np.full(3, -9.0)))
    found = descend(objective, np.zeros(3), np.array([(0.0, 1.0)] * 3), np.eye(3), 1e-6)
    assert np.array_equal(found.point, np.zeros(3))
    assert len(calls) == 1


def test_a_variable_whose_bounds_are_equal_stays():
    bounds = np.array([(-1.0, 1.0), (0.5, 0.5), (-1.0, 1.0)])
    found = descend(bowl(np.eye(3), np.array([0.3, 0.0, 9.0])), np.zeros(3), bounds, 0.1 * np.eye(3), 1e-10)
    assert np.allclose(found.point, [0.3, 0.5, 1.0], atol=1e-4)
