"""The Cramer-Rao bound against formulae on a plane field, a naive joint information matrix, and a plain loop."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.field import expected_error
from app.field.expected_error import (
    DECORRELATED_SHARE,
    UNKNOWN_HEADING_SD_RAD,
    WindowModel,
    expected_error_m,
    point_information,
    window_covariance_m2,
)
from app.field.grid import FieldGrid

SURE = WindowModel(noise_uT=0.5, bias_sd_uT=0.0, heading_sd_rad=0.0, scale_sd=0.0)
SLOPE = np.array([[2.0, 0.0], [0.0, 3.0], [0.0, 0.0]])  # uT/m of a plane field


def make_grid(field, size_m=(12.0, 9.0), resolution_m=0.5, components="vector", hole=None, **more) -> FieldGrid:
    """A grid of `field(x, y) -> (mean (..., c), gradient (..., c, 2))`, with the measured cells of `hole` taken out."""
    nx, ny = (int(s / resolution_m) + 1 for s in size_m)
    x, y = np.meshgrid(resolution_m * np.arange(nx), resolution_m * np.arange(ny))
    mean, gradient = field(x, y)
    c = mean.shape[-1]
    measured = np.ones((1, ny, nx), dtype=bool)
    if hole is not None:
        measured[0] = ~hole(x, y)
    grid = FieldGrid(
        components, (0.0, 0.0), resolution_m, np.array([1.2]), mean[None].astype(np.float32),
        np.full((1, ny, nx, c), 0.3, np.float32), gradient[None].astype(np.float32), measured,
        np.zeros(c), np.full(c, 9.0), np.full(c, 0.4), error_correlation_m=1.0,
    )  # fmt: skip
    return replace(grid, **more)


def plane(x, y):
    mean = np.stack([2.0 * x, 3.0 * y, np.full(x.shape, -40.0)], axis=-1)
    return mean, np.broadcast_to(SLOPE, (*x.shape, 3, 2)).copy()


def waves(x, y):
    """A smooth vector field with its exact gradient."""
    mean = np.stack([20 + 4 * np.sin(0.7 * x) * np.cos(0.5 * y), 3 * np.cos(0.4 * x + 0.9 * y), -40 + x * y / 9], -1)
    dx = [2.8 * np.cos(0.7 * x) * np.cos(0.5 * y), -1.2 * np.sin(0.4 * x + 0.9 * y), y / 9]
    dy = [-2 * np.sin(0.7 * x) * np.sin(0.5 * y), -2.7 * np.sin(0.4 * x + 0.9 * y), x / 9]
    return mean, np.stack([np.stack(dx, -1), np.stack(dy, -1)], axis=-1)


def straight(end_m, angle, length_m, step_m=0.5):
    s = step_m * np.arange(int(length_m / step_m + 1e-9) + 1)[::-1]
    return np.asarray(end_m) - s[:, None] * np.array([np.cos(angle), np.sin(angle)])


def error_m(grid, path, window):
    return float(np.sqrt(np.trace(window_covariance_m2(grid, path, window))))


def test_a_plane_field_with_nothing_unknown_has_the_textbook_variance() -> None:
    grid = make_grid(plane)
    walked = 8.5  # seventeen readings, each standing for half a metre
    density = 0.25 * (0.3**2 + 0.4**2) + 0.25 * 0.5**2
    extent = np.array([12.5, 9.5])
    expected = 1.0 / (walked * np.diag(SLOPE[:2]) ** 2 / density + 12.0 / extent**2)
    found = window_covariance_m2(grid, straight((11.0, 5.0), 0.0, 8.0), SURE)
    np.testing.assert_allclose(found, np.diag(expected), rtol=1e-6, atol=1e-9)
    correlated = replace(grid, error_correlation_m=5.0)  # one independent reading per 0.6 m
    density = 5.0 * DECORRELATED_SHARE * (0.3**2 + 0.4**2) + 0.25 * 0.5**2
    expected = 1.0 / (walked * np.diag(SLOPE[:2]) ** 2 / density + 12.0 / extent**2)
    found = window_covariance_m2(correlated, straight((11.0, 5.0), 0.0, 8.0), SURE)
    np.testing.assert_allclose(np.diag(found), expected, rtol=1e-6)


def test_a_constant_field_tells_nothing_but_that_the_device_is_on_the_map() -> None:
    def constant(x, y):
        return np.full((*x.shape, 1), 48.0), np.zeros((*x.shape, 1, 2))

    layer = expected_error_m(make_grid(constant, components="norm"), 0, WindowModel(length_m=4.0))
    np.testing.assert_allclose(layer, np.hypot(12.5, 9.5) / np.sqrt(12.0), rtol=1e-9)


def test_an_unknown_offset_hides_a_plane_field_and_only_curvature_helps() -> None:
    unknown = replace(SURE, bias_sd_uT=np.inf)
    path = straight((11.0, 5.0), 0.3, 8.0)
    assert error_m(make_grid(plane), path, unknown) == pytest.approx(np.hypot(12.5, 9.5) / np.sqrt(12.0), rel=1e-6)
    assert error_m(make_grid(waves), path, unknown) < 1.0


def test_the_bound_is_that_of_the_whole_information_matrix_by_differences() -> None:
    """All unknowns at once (x, y, heading, three offsets, scale): differentiated numerically, inverted."""
    grid, length = make_grid(waves, resolution_m=0.05), 5.0
    window = replace(SURE, bias_sd_uT=2.0, heading_sd_rad=0.4, scale_sd=0.05)
    s = np.linspace(0.0, 1.0, 21)
    path = np.column_stack([3.0 + length * s, 2.0 + 2.0 * s**2])

    def readings(p):  # minus what the map says there, so that an offset and a turn enter as they do in a residual
        c, sn = np.cos(p[2]), np.sin(p[2])
        turn = np.array([[c, -sn], [sn, c]])
        q = path[-1] + p[:2] + (1.0 + p[6]) * (path - path[-1]) @ turn.T
        there, here = waves(q[:, 0], q[:, 1])[0], waves(path[:, 0], path[:, 1])[0]
        here[:, :2] = here[:, :2] @ turn.T
        return (there - here - p[3:6]).ravel()

    step = 1e-5 * np.eye(7)
    jacobian = np.stack([(readings(d) - readings(-d)) / 2e-5 for d in step], axis=1)
    walked = np.linalg.norm(np.diff(path, axis=0), axis=1)
    walked = 0.5 * (np.append(walked[0], walked) + np.append(walked, walked[-1]))
    weight = np.repeat(walked / (0.25 * (0.3**2 + 0.4**2) + 0.25 * 0.5**2), 3)
    prior = [12.0 / 12.05**2, 12.0 / 9.05**2, 0.4**-2, 0.25, 0.25, 0.25, 0.05**-2]
    naive = np.linalg.inv(jacobian.T @ (weight[:, None] * jacobian) + np.diag(prior))[:2, :2]
    np.testing.assert_allclose(window_covariance_m2(grid, path, window), naive, rtol=0.01)


@pytest.mark.parametrize("components", ["vector", "level", "norm"])
@pytest.mark.parametrize("bias_sd_uT", [0.0, 1.0, np.inf])
def test_the_layer_is_a_loop_over_windows(monkeypatch, components, bias_sd_uT) -> None:
    """Along the grid's axes, where windows fall on cell centres."""
    monkeypatch.setattr(expected_error, "DIRECTIONS", 4)
    c = {"vector": 3, "level": 2, "norm": 1}[components]

    def field(x, y):
        mean, gradient = waves(x, y)
        return mean[..., -c:], gradient[..., -c:, :]

    def hole(x, y):
        return ((x > 4) & (y > 5)) | (x > 10)

    grid = make_grid(field, components=components, hole=hole)
    window = WindowModel(length_m=4.0, bias_sd_uT=bias_sd_uT)
    layer = expected_error_m(grid, 0, window)
    assert np.isfinite(layer).sum() > 100
    for j, i in [(0, 0), (3, 7), (10, 20), (11, 8), (17, 2), (18, 8), (4, 22), (9, 24)]:
        variances = []
        for angle in (0.0, np.pi / 2, np.pi, 1.5 * np.pi):
            path = np.round(2 * straight((0.5 * i, 0.5 * j), angle, 4.0)) / 2
            if grid.at(path).measured.mean() >= 0.5:
                variances.append(np.trace(window_covariance_m2(grid, path, window)))
        expected = np.sqrt(np.mean(variances)) if variances and grid.measured[0, j, i] else np.nan
        assert layer[j, i] == pytest.approx(expected, rel=1e-6, nan_ok=True)


def test_cells_that_no_mapped_window_reaches_are_not_judged() -> None:
    grid = make_grid(waves, hole=lambda x, y: (x > 4) & ~((x > 10) & (y > 7)))
    layer = expected_error_m(grid, 0, WindowModel(length_m=6.0))
    assert np.isnan(layer[16:, 22:]).all()  # an island two metres across
    assert np.isfinite(layer[:, :9]).all()
    np.testing.assert_array_equal(np.isfinite(layer) & ~grid.measured[0], False)


def test_a_finer_grid_of_the_same_field_gives_the_same_layer() -> None:
    coarse, fine = (
        expected_error_m(make_grid(waves, resolution_m=r), 0, WindowModel(length_m=4.0)) for r in (0.5, 0.25)
    )
    assert fine.shape == (37, 49)
    np.testing.assert_allclose(fine[::2, ::2], coarse, rtol=0.02)


@settings(max_examples=40, deadline=None)
@given(
    angle=st.floats(0.0, 2 * np.pi), length=st.floats(2.0, 8.0), noise=st.floats(0.0, 3.0), bias=st.floats(0.0, 5.0)
)  # fmt: skip
def test_knowing_less_never_helps_and_walking_further_never_hurts(angle, length, noise, bias) -> None:
    grid = make_grid(waves)
    window = WindowModel(noise_uT=noise, bias_sd_uT=bias, heading_sd_rad=0.1, scale_sd=0.0)
    path = straight((6.0, 4.5), angle, length)
    error = error_m(grid, path, window)
    for worse in (
        replace(window, noise_uT=noise + 0.5), replace(window, bias_sd_uT=bias + 1.0),
        replace(window, heading_sd_rad=UNKNOWN_HEADING_SD_RAD), replace(window, scale_sd=0.02),
    ):  # fmt: skip
        assert error_m(grid, path, worse) >= error * (1 - 1e-9)
    assert error_m(grid, straight((6.0, 4.5), angle, length + 2.0), window) <= error * (1 + 1e-9)


def test_a_turned_building_is_as_easy() -> None:
    def turned(x, y):
        """`waves` seen from axes turned by +90 degrees: (x, y) there is (y, -x + 12) here."""
        mean, gradient = waves(y, 12.0 - x)
        yaw = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        return mean @ yaw.T, (yaw @ gradient) @ np.array([[0.0, 1.0], [-1.0, 0.0]])

    here, there = make_grid(waves, (12.0, 12.0)), make_grid(turned, (12.0, 12.0))
    window = WindowModel(length_m=4.0, bias_sd_uT=0.5)
    np.testing.assert_allclose(
        expected_error_m(there, 0, window), np.rot90(expected_error_m(here, 0, window), -1), rtol=1e-5
    )


def test_information_of_one_reading_is_summed_over_components() -> None:
    found = point_information(make_grid(plane), 0, 0.5)
    np.testing.assert_allclose(found, (2.0**2 + 3.0**2) / (0.3**2 + 0.4**2 + 0.5**2), rtol=1e-6)
