"""GMA, NEDP and GAN on fields that are known, and the loop through an outage."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.synthetic.softball_field import SensorNoise, fly_track, indoor_cells, sense
from app.tracking.contour_matching import (
    GmaHistory,
    gan_fix,
    gma_fix,
    least_difference,
    nedp_fix,
    square_offsets_m,
    window_fix,
)
from app.tracking.inertial_ekf import InertialNoise
from app.tracking.kalman import GaussianBelief
from app.tracking.magnetic_aiding import Aiding, GpsReadings, navigate

OFFSETS = square_offsets_m()


@pytest.fixture(scope="module")
def cells():
    return indoor_cells(np.random.default_rng(1))


def walked(cells, shift_m, n=60, noise_uT=0.0, seed=0):
    """A history of readings along a curve, believed `shift_m` away from the truth; and the last reading."""
    rng = np.random.default_rng(seed)
    t = np.linspace(0.0, 1.0, n)
    true = np.column_stack([2.0 + 4.0 * t, 10.0 + np.sin(4.0 * t) + 3.0 * t])
    reading = cells.at(true)[:, 0] + noise_uT * rng.normal(size=n)
    history = GmaHistory(OFFSETS, length=40)
    for place, value in zip(true, reading, strict=True):
        history = history.push(cells, place - shift_m, value)
    return history, true[-1], reading[-1]


def test_offsets_are_the_sources():
    """121 of them, -0.5 to 0.5 m by 0.1 m (Cuenca, L613)."""
    assert OFFSETS.shape == (121, 2)
    np.testing.assert_allclose([OFFSETS.min(), OFFSETS.max()], [-0.5, 0.5])
    np.testing.assert_allclose(OFFSETS[60], 0.0, atol=1e-12)


@settings(max_examples=20)
@given(st.integers(-4, 4), st.integers(-4, 4))
def test_gma_finds_the_parallel_path(cells, i, j):
    shift = 0.1 * np.array([i, j])
    history, true, _ = walked(cells, shift)
    found = gma_fix(history, true - shift)
    np.testing.assert_allclose(found.position_m, true, atol=1e-9)
    assert found.confidence > 1.0


def test_gma_as_by_hand(cells):
    history, true, _ = walked(cells, np.array([0.2, 0.1]), noise_uT=0.3)
    by_hand = np.abs(history.residual_uT).mean(axis=1)
    np.testing.assert_allclose(gma_fix(history, true).position_m, true + OFFSETS[by_hand.argmin()])
    assert history.residual_uT.shape == (121, 40)
    assert history.full


def test_history_starts_empty_and_forgets(cells):
    assert gma_fix(GmaHistory(OFFSETS), np.zeros(2)) is None
    history, *_ = walked(cells, np.zeros(2))
    assert not history.forgotten().full
    assert gma_fix(history.forgotten(), np.zeros(2)) is None


def test_off_the_map_there_is_no_match(cells):
    history = GmaHistory(OFFSETS).push(cells, np.array([-50.0, 0.0]), 48.0)
    assert gma_fix(history, np.array([-50.0, 0.0])) is None
    assert nedp_fix(cells, np.array([-50.0, 0.0]), 48.0, 0.5, 0.07) is None
    assert least_difference(cells, np.array([-50.0, 0.0]), 48.0, OFFSETS) is None


def test_nedp_as_by_hand(cells):
    """Among cells that agree within the tolerance, the nearest (Cuenca, L660)."""
    rng = np.random.default_rng(2)
    values, tolerance = cells.mean_uT[..., 0], 0.3
    for _ in range(20):
        start = rng.uniform([1.0, 1.0], [8.0, 36.0])
        reading = float(cells.at(start[None])[0, 0] + rng.normal(0.0, 1.0))
        place = np.stack(np.meshgrid(cells.x_m, cells.y_m), axis=-1)
        distance = np.where(np.abs(values - reading) <= tolerance, np.linalg.norm(place - start, axis=-1), np.inf)
        found = nedp_fix(cells, start, reading, 0.5, 0.07, tolerance)
        if distance.min() > 0.5:
            assert found is None
        else:
            np.testing.assert_allclose(np.linalg.norm(found - start), distance.min(), atol=1e-9)
            assert abs(cells.at(found[None])[0, 0] - reading) <= tolerance + 1e-9


def test_gan_is_nedp_from_gmas_place_or_that_place(cells):
    history, true, reading = walked(cells, np.array([0.2, -0.3]))
    centre = true - [0.2, -0.3]
    found = gan_fix(history, cells, centre, reading, 0.07)
    assert found.on_contour
    np.testing.assert_allclose(found.position_m, nedp_fix(cells, true, reading, 0.5, 0.07))
    nowhere = gan_fix(history, cells, centre, reading + 500.0, 0.07)
    assert not nowhere.on_contour
    np.testing.assert_allclose(nowhere.position_m, true, atol=1e-9)


def test_minimum_difference_jumps_where_gma_does_not(cells):
    """Single readings are prone to noise (Cuenca, L621): over many, their places scatter more."""
    single, matched = [], []
    for seed in range(30):
        history, true, reading = walked(cells, np.zeros(2), noise_uT=0.5, seed=seed)
        single.append(least_difference(cells, true, reading, OFFSETS) - true)
        matched.append(gma_fix(history, true).position_m - true)
    assert np.square(single).mean() > 4.0 * np.square(matched).mean()


def test_window_fix_keeps_its_variance_where_nothing_is_learnt(cells):
    """Hundreds of worthless readings leave the prior as it was: nothing is cut off by the window."""
    P = np.array([[0.04, 0.01], [0.01, 0.02]])
    mean, covariance = np.array([4.0, 15.0]), P
    for _ in range(300):
        fix = window_fix(cells, np.array([48.0]), mean, covariance, 1e5)
        mean, covariance = fix.position_m, fix.covariance_m2
    np.testing.assert_allclose(mean, [4.0, 15.0], atol=1e-3)
    np.testing.assert_allclose(covariance, P, rtol=0.03)


def test_window_fix_narrows_across_contours_only():
    values = np.tile(48.0 + 0.1 * np.arange(121), (121, 1))[..., None]  # 1 uT/m along x
    flat = replace(indoor_cells(np.random.default_rng(0)), mean_uT=values, variance_uT2=np.zeros_like(values),
                   known=np.ones((121, 121), dtype=bool))  # fmt: skip
    fix = window_fix(flat, np.array([54.0]), np.array([6.1, 6.1]), 0.25 * np.eye(2), 0.07)
    assert fix.position_m[0] == pytest.approx(6.0, abs=0.02)
    assert np.sqrt(fix.covariance_m2[0, 0]) < 0.12
    assert np.sqrt(fix.covariance_m2[1, 1]) == pytest.approx(0.5, rel=0.02)


def test_window_fix_refuses_what_its_prior_does_not_allow(cells):
    fix = window_fix(cells, cells.at(np.array([[4.0, 15.0]]))[0] + 40.0, np.array([4.0, 15.0]), 0.04 * np.eye(2), 0.07)
    assert fix.refused is not None


def flown(cells, aiding, velocity=False, seed=0, seconds=20.0):
    rng = np.random.default_rng(seed)
    flight = fly_track("O", seconds)
    log = sense(flight, cells, rng, SensorNoise())
    t = np.arange(len(log.norm_uT)) * flight.dt_s
    due = np.arange(len(t)) % 20 == 0
    place = due & ~((t >= 5.0) & (t < 15.0))
    gps = GpsReadings(np.where(place[:, None], log.gps_m, np.nan),
                      np.where((due & velocity)[:, None], log.gps_velocity_m_s, np.nan))  # fmt: skip
    start = np.concatenate([flight.position_m[0], flight.velocity_m_s[0], flight.angles_rad[0]])
    belief = GaussianBelief(start, np.diag(np.repeat([0.01, 0.01, 1e-4], 3)))
    track = navigate(belief, log.force_m_s2, log.rate_rad_s, log.norm_uT, gps, cells, aiding, flight.dt_s)
    return np.linalg.norm(track.state[:, :2] - flight.position_m[:, :2], axis=1), track


HONEST = InertialNoise(1e-8, (0.032 * 0.01) ** 2, (0.0032 * 0.01) ** 2)


def test_window_carries_through_an_outage(cells):
    alone, _ = flown(cells, Aiding("none", noise=HONEST))
    aided, track = flown(cells, Aiding("window", noise=HONEST, every=4))
    assert aided[1000:1500].max() < 0.3
    assert np.mean(aided[1000:1500] ** 2) < np.mean(alone[1000:1500] ** 2)
    assert track.refused == 0


def test_gma_fed_back_drives_the_filter_astray_and_batches_do_not(cells):
    """C3: a filter that is fed its own window's centre as a measurement follows it (Cuenca, L1021)."""
    fed, _ = flown(cells, Aiding("gma", every=4))
    batches, _ = flown(cells, Aiding("gma", every=4, batches=True))
    assert np.sqrt(np.mean(fed[1000:1500] ** 2)) > 2.0 * np.sqrt(np.mean(batches[1000:1500] ** 2))


def test_without_a_filter_the_place_overwrites_the_position(cells):
    _, track = flown(cells, Aiding("gan", "state", always=True, every=4), seconds=1.0)
    moved = track.state[5, :2] - track.state[4, :2] - track.match_offset_m[4]  # a step without GPS
    np.testing.assert_allclose(moved, track.state[4, 3:5] * 0.01, atol=1e-9)


def test_velocity_helps_in_an_outage(cells):
    """C7 (Cuenca, L1079)."""
    without, _ = flown(cells, Aiding("none"))
    having, _ = flown(cells, Aiding("none"), velocity=True)
    assert having[1000:1500].max() < without[1000:1500].max()


def test_idle_matching_agrees_with_gps(cells):
    """C1: with GPS the best offset is near the centre of the window (Cuenca, L1021)."""
    _, track = flown(cells, Aiding("gma", every=4, fix_variance_m2=1e9))
    off = track.match_offset_m[100:500]
    assert np.median(np.linalg.norm(off[np.isfinite(off[:, 0])], axis=1)) < 0.25
