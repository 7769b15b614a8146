"""Reading a grid between its cells."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.field.grid import FieldGrid


def plane_grid(heights: tuple[float, ...] = (1.0,)) -> FieldGrid:
    """mean = 1 + 2x + 3y + 10z, all but one corner cell measured."""
    x, y = 0.5 * np.arange(6), 0.5 * np.arange(5)
    z = np.array(heights)
    mean = 1 + 2 * x[None, None, :] + 3 * y[None, :, None] + 10 * z[:, None, None]
    measured = np.ones(mean.shape, dtype=bool)
    measured[:, 0, 0] = False
    gradient = np.broadcast_to(np.array([2.0, 3.0]), (*mean.shape, 1, 2))
    return FieldGrid(
        components="norm",
        origin_m=(0.0, 0.0),
        resolution_m=0.5,
        heights_m=z,
        mean_uT=mean[..., None].astype(np.float32),
        sd_uT=np.full((*mean.shape, 1), 0.3, dtype=np.float32),
        gradient_uT_per_m=gradient.astype(np.float32),
        measured=measured,
        ambient_uT=np.array([48.0]),
        prior_sd_uT=np.array([6.0]),
        noise_sd_uT=np.array([0.4]),
    )


@given(st.floats(0.5, 2.5), st.floats(0.5, 2.0), st.floats(1.0, 3.0))
def test_a_linear_field_is_read_exactly(x: float, y: float, z: float) -> None:
    values = plane_grid((1.0, 3.0)).at(np.array([[x, y, z]]))
    assert values.mean_uT[0, 0] == pytest.approx(1 + 2 * x + 3 * y + 10 * z, abs=1e-5)
    np.testing.assert_allclose(values.gradient_uT_per_m[0, 0], [2, 3])
    assert values.sd_uT[0, 0] == pytest.approx(0.3, abs=1e-6)
    assert values.measured[0]


def test_a_map_of_one_height_ignores_z() -> None:
    grid = plane_grid()
    low, high = grid.at(np.array([[1.0, 1.0, -5.0], [1.0, 1.0, 50.0]])).mean_uT
    assert low == high
    assert grid.at(np.array([[1.0, 1.0]])).mean_uT[0] == low


def test_above_and_below_the_layers_nothing_is_measured() -> None:
    z = [0.98, 0.995, 1.0, 3.0, 3.005, 3.02, 9.0]
    values = plane_grid((1.0, 3.0)).at(np.array([[1.0, 1.0, each] for each in z]))
    assert values.measured.tolist() == [False, True, True, True, True, False, False]
    np.testing.assert_array_equal(values.mean_uT[[0, 5, 6]], np.full((3, 1), 48.0))
    np.testing.assert_array_equal(values.sd_uT[[0, 5, 6]], np.full((3, 1), 6.0))


def test_outside_is_the_prior_and_not_measured() -> None:
    values = plane_grid().at(np.array([[-0.01, 1.0], [2.51, 1.0], [1.0, 9.0]]))
    assert not values.measured.any()
    np.testing.assert_array_equal(values.mean_uT, np.full((3, 1), 48.0))
    np.testing.assert_array_equal(values.sd_uT, np.full((3, 1), 6.0))


def test_a_point_needs_every_cell_around_it_measured() -> None:
    inside, beside, on_far_corner = plane_grid().at(np.array([[0.4, 0.4], [0.6, 0.4], [2.5, 2.0]])).measured
    assert not inside
    assert beside
    assert on_far_corner
