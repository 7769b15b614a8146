"""Gradient norms, extremes and GLM against Kuevor's published figures and plain loops."""

import numpy as np
import pytest

from app.field.grid import FieldGrid
from app.field.localizability import (
    best_and_worst_points,
    glm,
    glm_average,
    glm_ratio_of_means,
    gradient_norms,
)


def grid_with(gradient, measured) -> FieldGrid:
    nz, ny, nx, c, _ = gradient.shape
    cells = np.zeros((nz, ny, nx, c), np.float32)
    names = {3: "vector", 2: "level", 1: "norm"}
    return FieldGrid(
        names[c], (10.0, 20.0), 0.5, 1.0 + 0.5 * np.arange(nz), cells, cells + 1, gradient.astype(np.float32), measured,
        np.zeros(c), np.ones(c), np.ones(c),
    )  # fmt: skip


def test_column_norms_and_their_total_are_those_published_at_the_worst_point() -> None:
    """(Kuevor, L1736, L1878): 2.30 and 2.67 uT/m along x and y, 5.61 in all, which leaves 4.36 along z."""
    columns = np.array([[0.6, 0.0, 0.8], [0.0, 1.0, 0.0], [0.8, -0.6, 0.0]]).T  # three directions in field space
    norms = gradient_norms(columns * [2.30, 2.67, 4.36])
    assert (float(norms.x), float(norms.y)) == pytest.approx((2.30, 2.67))
    assert norms.z is not None
    assert float(norms.z) == pytest.approx(4.36)
    assert float(norms.total) == pytest.approx(5.61, abs=0.01)
    flat = gradient_norms((columns * [2.30, 2.67, 4.36])[:, :2])
    assert flat.z is None
    assert float(flat.total) == pytest.approx(np.hypot(2.30, 2.67))


@pytest.mark.parametrize("c", [1, 2, 3])
def test_extremes_are_of_measured_cells_of_the_layer(c) -> None:
    rng = np.random.default_rng(c)
    gradient, measured = rng.normal(size=(2, 7, 9, c, 2)), rng.random((2, 7, 9)) < 0.5
    gradient[1, 6, 8], measured[1, 6, 8] = 100.0, False
    gradient[1, 0, 0], measured[1, 0, 0] = 0.0, False
    gradient[0, 5, 5], measured[0, 5, 5] = 50.0, True
    gradient[1, 2, 3], measured[1, 2, 3] = 9.0, True
    gradient[1, 4, 1], measured[1, 4, 1] = 1e-3, True
    found = best_and_worst_points(grid_with(gradient, measured), 1)
    assert found is not None
    best, worst = found
    np.testing.assert_allclose(best.position_m, [11.5, 21.0, 1.5])
    np.testing.assert_allclose(worst.position_m, [10.5, 22.0, 1.5])
    assert best.gradient_uT_per_m == pytest.approx(9.0 * np.sqrt(2 * c))
    assert best_and_worst_points(grid_with(gradient, np.zeros_like(measured)), 0) is None


def test_glm_is_a_ratio_of_moving_means() -> None:
    rng = np.random.default_rng(0)
    gradient, error = rng.normal(size=(40, 3, 2)), rng.normal(size=(40, 3))
    series = glm(gradient, error)
    signal = [0.05 * np.sqrt(np.sum(g**2)) for g in gradient]
    noise = [np.sqrt(np.sum(e**2)) for e in error]
    naive = [np.mean(signal[k - 4 : k + 1]) / np.mean(noise[k - 4 : k + 1]) for k in range(4, 40)]
    assert np.isnan(series.glm[:4]).all()
    np.testing.assert_allclose(series.glm[4:], naive)
    assert np.isnan(glm(gradient[:3], error[:3]).glm).all()


def test_glm_signal_at_kuevors_points() -> None:
    """(Kuevor, L1736): 5.61 and 21.88 uT/m give 0.28 and 1.09 uT over 5 cm; with 0.3-0.5 uT of noise 0.6-3.6."""
    gradient = np.zeros((2, 3, 3))
    gradient[0, 0, 0], gradient[1, 1, 2] = 5.61, 21.88
    series = glm(gradient, np.array([[0.5, 0.0, 0.0], [0.0, 0.3, 0.0]]), window=1)
    np.testing.assert_allclose(series.signal_uT, [0.28, 1.09], atol=0.005)
    np.testing.assert_allclose(series.glm, [0.56, 3.65], atol=0.01)


def test_averages_take_samples_at_two_hertz_and_one_lucky_sample_dominates_only_one_of_them() -> None:
    t = np.arange(0.0, 10.0, 0.005)
    gradient, error = np.tile([12.0, 16.0], (len(t), 1, 1)), np.full((len(t), 1), 7.0)
    every_half_second = np.arange(0, len(t), 100)
    error[every_half_second] = 0.5  # seen only if samples are those at 2 Hz
    assert glm_average(t, glm(gradient, error)) == pytest.approx(2.0)
    error[300] = 1e-9
    assert glm_average(t, glm(gradient, error)) > 1e6
    assert glm_ratio_of_means(t, glm(gradient, error)) == pytest.approx(2.0 * 20 / 19)


def test_a_constant_field_is_worth_nothing_even_without_noise() -> None:
    series = glm(np.zeros((10, 3, 2)), np.zeros((10, 3)))
    np.testing.assert_array_equal(series.glm[4:], 0.0)
    assert glm_average(np.arange(10.0), series) == 0.0
