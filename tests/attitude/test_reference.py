"""Shapes of references, and the variance that an uncertain place adds."""

import numpy as np
import pytest

from app.attitude.reference import (
    MagneticReference,
    constant_reference,
    grid_reference,
    learned_reference,
    level_reference,
    map_reference,
)
from app.errors import InvalidInput
from app.field.grid import FieldGrid


def test_a_variance_may_be_told_in_five_shapes() -> None:
    n, B = 4, np.tile([1.0, 2.0, 3.0], (4, 1))
    for given, first in (
        (2.0, 2.0 * np.eye(3)),
        (np.array([1.0, 2.0, 3.0]), np.diag([1.0, 2.0, 3.0])),
        (np.tile([1.0, 2.0, 3.0], (n, 1)), np.diag([1.0, 2.0, 3.0])),
        (np.full((3, 3), 0.1) + np.eye(3), np.full((3, 3), 0.1) + np.eye(3)),
        (np.tile(np.eye(3), (n, 1, 1)), np.eye(3)),
    ):
        rows, variance = MagneticReference(B, given).rows(n)
        assert rows.shape == (n, 3)
        assert np.array_equal(variance[0], first)


def test_three_samples_with_a_row_each_are_rows() -> None:
    variance = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]])
    _, found = MagneticReference(np.ones((3, 3)), variance).rows(3)
    assert found.shape == (3, 3, 3)
    assert np.array_equal(found[1], np.diag([4.0, 5.0, 6.0]))


def test_an_uncertain_place_adds_the_gradient_both_ways() -> None:
    """J P J^T against the scatter of a linear field over places drawn from P (Kuevor, B20)."""
    rng = np.random.default_rng(1)
    J, A = rng.normal(size=(3, 3)), rng.normal(size=(3, 3))
    P = A @ A.T
    _, variance = map_reference(np.zeros((1, 3)), np.full((1, 3), 0.5), J[None], P).rows(1)
    drawn = rng.multivariate_normal(np.zeros(3), P, 200_000) @ J.T + 0.5 * rng.normal(size=(200_000, 3))
    assert np.allclose(np.cov(drawn.T), variance[0], rtol=0.05, atol=0.05 * np.abs(variance).max())


def test_a_flat_map_takes_a_flat_place() -> None:
    _, variance = map_reference(np.zeros((2, 3)), np.zeros((2, 3)), np.ones((2, 3, 2)), np.eye(2)).rows(2)
    assert np.array_equal(variance[1], np.full((3, 3), 2.0))


def test_rows_whose_variance_is_unknown_are_no_reference() -> None:
    sd = np.array([[1.0, 1.0, 1.0], [np.nan, 1.0, 1.0]])
    B, _ = map_reference(np.ones((2, 3)), sd).rows(2)
    assert np.isfinite(B[0]).all()
    assert np.isnan(B[1]).all()


def test_the_others() -> None:
    assert learned_reference().B_uT is None
    assert np.array_equal(level_reference(20.0, -45.0).rows(7)[0], [[20.0, 0.0, -45.0]])
    assert np.array_equal(constant_reference(np.array([1.0, 2.0, 3.0]), 2.0).rows(7)[1], 4.0 * np.eye(3)[None])
    with pytest.raises(InvalidInput, match="row of three"):
        MagneticReference(np.ones((4, 3))).rows(5)
    with pytest.raises(InvalidInput, match="variance has shape"):
        MagneticReference(np.ones(3), np.ones((2, 2))).rows(5)
    with pytest.raises(InvalidInput, match="not finite"):
        MagneticReference(np.ones(3), np.nan).rows(5)


def test_a_map_says_nothing_of_places_it_does_not_hold(hall_grid: FieldGrid) -> None:
    """One place alone, as a track asks, and among others: nothing is known there, and nothing fails."""
    reference = grid_reference(hall_grid, np.array([[5.0, 4.0, 1.2], [99.0, 4.0, 1.2]]), 0.01 * np.eye(2))
    B, variance = reference.rows(2)
    assert np.isfinite(B[0]).all()
    assert np.isnan(B[1]).all()
    expected = np.square(0.3) + np.square(0.4)
    slope = hall_grid.at(np.array([[5.0, 4.0]])).gradient_uT_per_m[0, :, :2]
    np.testing.assert_allclose(variance[0], expected * np.eye(3) + 0.01 * slope @ slope.T, rtol=1e-6)
    alone, _ = grid_reference(hall_grid, np.array([[99.0, 4.0, 1.2]]), np.eye(2)).rows(1)
    assert np.isnan(alone).all()
