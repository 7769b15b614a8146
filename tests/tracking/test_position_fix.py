"""Fixes from single readings: against sums by hand, the source's worked figures, and what gates are for."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.field.grid import FieldGrid
from app.tracking.grid_posterior import GridPosterior, grid_posterior, local_maxima, log_likelihood, log_prior
from app.tracking.map_cells import MapCells
from app.tracking.position_fix import FixSettings, half_width_16_84, lever_arm_agrees, matched_fix, ml_fix

CELL_M = 0.0381


def cells_of(mean, known=None, variance=0.0, resolution_m=0.1, origin_m=(0.0, 0.0)):
    known = np.ones(mean.shape[:2], dtype=bool) if known is None else known
    return MapCells(origin_m, resolution_m, mean, np.broadcast_to(variance, mean.shape).copy(), known)


def wavy(ny=40, nx=50, c=3, resolution_m=0.1):
    y, x = np.mgrid[:ny, :nx] * resolution_m
    return cells_of(np.stack([20 + 3 * np.sin(1.3 * x + k) + 2 * np.cos(1.7 * y - k * x) for k in range(c)], axis=-1))


def test_half_width_of_a_gaussian_slice():
    """The source's check value: sd 0.300 m on its grid over +-2 m."""
    x = np.arange(-2.0, 2.0, CELL_M)
    assert half_width_16_84(-0.5 * (x / 0.3) ** 2, CELL_M) == pytest.approx(0.300, abs=5e-4)


def test_half_width_saturates_with_the_slice():
    assert half_width_16_84(np.zeros(100), 0.01) == pytest.approx(0.3413, abs=1e-4)
    assert half_width_16_84(np.array([-np.inf, 0.0, -np.inf]), CELL_M) >= CELL_M / np.sqrt(12.0)


@given(st.integers(0, 1000), st.floats(0.5, 2.0))
def test_half_width_scales_and_mirrors(seed, factor):
    logs = np.random.default_rng(seed).normal(0.0, 3.0, 30)
    width = half_width_16_84(logs, 1.0)
    assert half_width_16_84(logs[::-1], factor) == pytest.approx(factor * width)
    assert half_width_16_84(logs + 700.0, 1.0) == pytest.approx(width)


def test_prior_weights_of_the_worked_example():
    """(Storms, L678-684): peaks (X, Y) weigh 0.612, 0.768 and 1.2e-18; our y is -Y."""
    for peak, weight in (((1.75, 1.0), 0.612), ((2.4, 1.0), 0.768), ((1.5, 3.2), 1.2e-18)):
        one = cells_of(np.zeros((1, 1, 3)), origin_m=(peak[0], -peak[1]))
        found = np.exp(log_prior(one, np.array([2.2438, -1.1565]), np.diag([0.4837, 0.0513]))[0, 0])
        assert found == pytest.approx(weight, rel=0.05)


def test_worked_example_of_three_peaks():
    """Equal likelihoods at the three peaks: the third vanishes, and the second wins by their prior weights."""
    y, x = np.arange(61) * 0.1 - 4.0, np.arange(41) * 0.1
    mean = np.full((61, 41, 1), 10.0)
    for px, py in ((1.7, -1.0), (2.4, -1.0), (1.5, -3.2)):
        mean[np.argmin(np.abs(y - py)), np.argmin(np.abs(x - px))] = 0.0
    fix = ml_fix(
        cells_of(mean, origin_m=(0.0, -4.0)), np.zeros(1), np.array([2.2438, -1.1565]), np.diag([0.4837, 0.0513]),
        FixSettings(noise_sd_uT=1.0),
    )  # fmt: skip
    np.testing.assert_allclose(fix.position_m, [2.4, -1.0], atol=1e-9)
    assert fix.diagnostics.peaks == 2
    assert np.sqrt(fix.covariance_m2[0, 0]) > 0.3  # the slice along x goes through both, and R says so
    assert fix.diagnostics.rival_log_ratio == np.inf


@given(st.integers(0, 10_000), st.booleans())
def test_posterior_as_by_hand(seed, with_map):
    rng = np.random.default_rng(seed)
    cells = cells_of(rng.normal(size=(5, 6, 2)), rng.random((5, 6)) > 0.3, variance=rng.uniform(0.01, 1.0, (5, 6, 2)))
    reading, mean = rng.normal(size=2), np.array([0.2, 0.3])
    P = np.array([[0.05, 0.02], [0.02, 0.04]])
    found = grid_posterior(cells, reading, mean, P, np.array([1.0, 1.0]), 0.3, map_variance=with_map)
    if not cells.known.any():
        assert found is None
        return
    total = np.full((5, 6), -np.inf)
    for j, i in np.argwhere(cells.known):
        v = 0.09 + (cells.variance_uT2[j, i] if with_map else 0.0) * np.ones(2)
        off = np.array([0.1 * i, 0.1 * j]) - mean
        log_L = -0.5 * np.sum((reading - cells.mean_uT[j, i]) ** 2 / v + np.log(2 * np.pi * v))
        total[j, i] = log_L - 0.5 * off @ np.linalg.inv(P) @ off
    np.testing.assert_allclose(found.log_posterior, total, rtol=1e-9)
    mass = np.exp(total - total.max())
    place = np.stack(np.meshgrid(np.arange(6) * 0.1, np.arange(5) * 0.1), axis=-1)
    by_hand = (mass[..., None] * place).sum(axis=(0, 1)) / mass.sum()
    np.testing.assert_allclose(found.moments()[0], by_hand, atol=1e-9)
    assert cells.known[found.best]


def test_moments_of_a_gaussian_are_its_own_on_a_resolved_lattice():
    flat = cells_of(np.full((81, 81, 1), 5.0))
    P = np.array([[0.09, 0.03], [0.03, 0.06]])
    found = grid_posterior(
        flat, np.array([5.0]), np.array([4.0, 4.0]), P, np.array([2.0, 2.0]), 1.0, resolve_prior=True
    )
    mean, covariance = found.moments()
    np.testing.assert_allclose(mean, [4.0, 4.0], atol=1e-9)
    np.testing.assert_allclose(covariance, P, rtol=1e-3)


def test_a_narrow_prior_is_not_lost_between_cells():
    flat = cells_of(np.full((21, 21, 1), 5.0))
    settings = FixSettings(noise_sd_uT=1.0, resolve_prior=True, reach_sigmas=5.0, least_reach_m=0.0)
    fix = matched_fix(flat, np.array([5.0]), np.array([1.03, 0.97]), 0.01**2 * np.eye(2), settings)
    np.testing.assert_allclose(fix.position_m, [1.03, 0.97], atol=1e-6)
    np.testing.assert_allclose(fix.covariance_m2, 0.01**2 * np.eye(2), rtol=1e-3, atol=1e-9)


def test_moments_of_a_plane_slope_are_the_kalman_update():
    """h = g x is linear: the posterior is known in closed form."""
    x = np.arange(241) * 0.05
    cells = cells_of(np.tile(48.0 + 2.0 * x, (241, 1))[..., None], resolution_m=0.05)
    P, sigma = np.diag([0.09, 0.04]), 0.2
    fix = matched_fix(
        cells, np.array([60.3]), np.array([6.0, 6.0]), P, FixSettings(noise_sd_uT=sigma, reach_sigmas=6.0)
    )
    gain = 0.09 * 2.0 / (4.0 * 0.09 + sigma**2)
    np.testing.assert_allclose(fix.position_m, [6.0 + gain * 0.3, 6.0], atol=1e-3)
    assert fix.covariance_m2[0, 0] == pytest.approx(0.09 * (1.0 - 2.0 * gain), abs=3e-4)
    assert fix.covariance_m2[1, 1] == pytest.approx(0.04, abs=3e-4)


def test_log_determinant_makes_uncertain_cells_pay():
    """Two cells with the same misfit per variance: the surer one is likelier, unless taken literally."""
    cells = cells_of(np.array([[[1.0], [2.0]]]), variance=np.array([[[0.75], [3.75]]]))
    misfit, likelihood = log_likelihood(cells, np.zeros(1), 0.5)
    assert misfit[0, 0] == pytest.approx(1.0)
    assert misfit[0, 1] == pytest.approx(1.0)
    assert likelihood[0, 0] - likelihood[0, 1] == pytest.approx(np.log(2.0))
    assert log_likelihood(cells, np.zeros(1), 0.5, map_variance=False)[0][0, 1] == pytest.approx(16.0)


def test_unknown_cells_never_win_and_nothing_known_is_no_fix():
    cells = wavy()
    known = np.ones(cells.known.shape, dtype=bool)
    known[20, 25] = False
    holed = replace(cells, known=known)
    fix = ml_fix(holed, cells.mean_uT[20, 25], np.array([2.5, 2.0]), 0.1 * np.eye(2), FixSettings())
    assert fix is not None
    assert not np.allclose(fix.position_m, [2.5, 2.0])
    nothing = replace(cells, known=np.zeros_like(known))
    assert ml_fix(nothing, cells.mean_uT[0, 0], np.array([2.5, 2.0]), np.eye(2), FixSettings()) is None
    assert ml_fix(cells, cells.mean_uT[0, 0], np.array([99.0, 2.0]), 0.01 * np.eye(2), FixSettings()) is None


@pytest.mark.parametrize("make", [ml_fix, matched_fix])
def test_a_reading_a_thousand_sigmas_off_still_finds_the_least_bad_cell(make):
    cells = wavy()
    fix = make(
        cells, cells.mean_uT[20, 25] + 1000.0, np.array([2.5, 2.0]), 0.05 * np.eye(2), FixSettings(noise_sd_uT=0.1)
    )
    assert np.isfinite(fix.position_m).all()
    assert np.isfinite(fix.covariance_m2).all()


@settings(max_examples=40)
@given(st.integers(0, 10_000))
def test_the_true_cell_is_found_without_noise(seed):
    rng = np.random.default_rng(seed)
    cells = wavy()
    j, i = int(rng.integers(8, 32)), int(rng.integers(8, 42))
    true = 0.1 * np.array([i, j])
    fix = ml_fix(
        cells, cells.mean_uT[j, i], true + rng.normal(0.0, 0.1, 2), 0.04 * np.eye(2), FixSettings(noise_sd_uT=0.02)
    )
    np.testing.assert_allclose(fix.position_m, true, atol=1e-9)
    assert fix.diagnostics.misfit == pytest.approx(0.0, abs=1e-9)


def test_gates_refuse_what_they_are_for_and_only_when_on():
    cells = wavy()
    reading, P = cells.mean_uT[20, 25], 0.02 * np.eye(2)
    near, far = np.array([2.5, 2.0]), np.array([1.2, 2.0])
    off = FixSettings(noise_sd_uT=0.1, use_prior=False, least_reach_m=3.0)
    assert ml_fix(cells, reading, far, P, off).refused is None
    assert ml_fix(cells, reading, far, P, replace(off, innovation_gate=True)).refused == "innovation"
    assert ml_fix(cells, reading, near, P, replace(off, innovation_gate=True)).refused is None
    assert ml_fix(cells, reading + 50.0, near, P, replace(off, fit_gate=True)).refused == "fit"
    assert ml_fix(cells, reading, near, P, replace(off, fit_gate=True)).refused is None


def test_veto_of_two_equal_peaks():
    x = np.arange(101) * 0.05
    mirror = np.abs(x - 2.5)[None, :, None] * np.ones((41, 1, 1))  # symmetric: two places fit alike
    cells = cells_of(mirror, resolution_m=0.05)
    settings = FixSettings(noise_sd_uT=0.05, ambiguity_veto=True, reach_sigmas=3.0)
    ambiguous = ml_fix(cells, np.array([0.8]), np.array([2.5, 1.0]), np.diag([0.5, 0.05]), settings)
    assert ambiguous.refused == "ambiguous"
    assert ambiguous.diagnostics.peaks >= 2
    assert ml_fix(cells, np.array([0.8]), np.array([3.3, 1.0]), np.diag([0.05, 0.05]), settings).refused is None


def test_border_of_the_window():
    x = np.arange(101) * 0.1
    slope = cells_of(np.tile(x, (101, 1))[..., None])
    settings = FixSettings(noise_sd_uT=0.05, reach_sigmas=3.0, most_border_mass=0.05)
    P = 0.09 * np.eye(2)
    assert matched_fix(slope, np.array([8.0]), np.array([5.0, 5.0]), P, settings).refused == "border"
    assert matched_fix(slope, np.array([5.2]), np.array([5.0, 5.0]), P, settings).refused is None


def test_lever_arm_of_two_sensors():
    cells = wavy()
    one, other = (
        ml_fix(cells, cells.mean_uT[20, i], np.array([0.1 * i, 2.0]), 0.04 * np.eye(2), FixSettings()) for i in (20, 25)
    )
    assert lever_arm_agrees(one, other, np.array([0.5, 0.0]))
    assert not lever_arm_agrees(one, other, np.array([0.0, 0.5]))


@given(st.integers(0, 10_000))
def test_local_maxima_as_by_looking_at_neighbours(seed):
    values = np.random.default_rng(seed).normal(size=(7, 8))
    found = {tuple(each) for each in local_maxima(values, within=np.inf).tolist()}
    padded = np.pad(values, 1, constant_values=-np.inf)
    by_hand = {(j, i) for j in range(7) for i in range(8) if values[j, i] >= padded[j : j + 3, i : i + 3].max()}
    assert found == by_hand


def test_window_and_bilinear_values():
    cells = wavy()
    part = cells.window(np.array([2.0, 1.5]), np.array([0.5, 0.3]))
    np.testing.assert_allclose(part.x_m, np.arange(15, 26) * 0.1)
    np.testing.assert_allclose(part.y_m, np.arange(12, 19) * 0.1)
    points = np.array([[1.23, 2.34], [0.0, 0.0], [4.9, 3.9], [5.0, 1.0], [-0.01, 1.0]])
    values = cells.at(points)
    j, i, u, v = 23, 12, 0.3, 0.4
    corner = cells.mean_uT[j : j + 2, i : i + 2]
    by_hand = (1 - v) * ((1 - u) * corner[0, 0] + u * corner[0, 1]) + v * ((1 - u) * corner[1, 0] + u * corner[1, 1])
    np.testing.assert_allclose(values[0], by_hand)
    np.testing.assert_allclose(values[1:3], [cells.mean_uT[0, 0], cells.mean_uT[39, 49]])
    assert np.isnan(values[3:]).all()
    fine = cells.resampled(np.array([2.0, 1.5]), np.array([0.1, 0.06]), 0.02)
    np.testing.assert_allclose(fine.mean_uT[3, 5], cells.at(np.array([[2.0, 1.5]]))[0])
    assert fine.mean_uT.shape == (7, 11, 3)


def test_a_layer_of_a_served_map():
    """The cells are the layer's, and values between them those that `FieldGrid.at` gives."""
    rng = np.random.default_rng(0)
    mean = rng.normal(size=(2, 5, 6, 3)).astype(np.float32)
    grid = FieldGrid(
        "vector", (1.0, -2.0), 0.5, np.array([0.0, 1.5]), mean, np.abs(mean), np.zeros((2, 5, 6, 3, 2), np.float32),
        rng.random((2, 5, 6)) > 0.2, np.zeros(3), np.ones(3), np.ones(3),
    )  # fmt: skip
    cells = MapCells.of_grid(grid, 1)
    points = rng.uniform([1.0, -2.0], [3.5, 0.0], (40, 2))
    served = grid.at(np.column_stack([points, np.full(40, 1.5)]))
    np.testing.assert_array_equal(np.isfinite(cells.at(points)[:, 0]), served.measured)
    np.testing.assert_allclose(cells.at(points)[served.measured], served.mean_uT[served.measured], atol=1e-6)
    np.testing.assert_allclose(cells.variance_uT2, np.square(mean[1]), rtol=1e-6)


def test_norm_of_a_map():
    cells = replace(wavy(), variance_uT2=np.full((40, 50, 3), 0.04))
    norm = cells.norm()
    np.testing.assert_allclose(norm.mean_uT[..., 0], np.linalg.norm(cells.mean_uT, axis=-1))
    np.testing.assert_allclose(norm.variance_uT2, 0.04)


def test_border_mass_of_a_uniform_posterior():
    flat = cells_of(np.zeros((10, 10, 1)))
    posterior = GridPosterior(flat, np.zeros((10, 10)), np.zeros((10, 10)), np.zeros((10, 10)))
    assert posterior.border_mass() == pytest.approx(0.36)
