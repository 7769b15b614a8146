"""Kuevor's room: does it look like the room of the dissertation, and is its field a field in air?"""

import numpy as np
import pytest

from app.synthetic.room import (
    EPSILON_SCAN_M,
    GAMMA_SCAN_M,
    LOWER_FOUR_M,
    TRAINING_BOX_M,
    UPPER_FOUR_M,
    UTILIZATION_BOX_M,
    box_grid_m,
    fly,
    make_room,
)

SEEDS = range(6)


@pytest.mark.parametrize("seed", SEEDS)
def test_fields_and_gradients_are_those_of_the_seeds_room(seed):
    room = make_room(np.random.default_rng(seed))
    gradient = room.gradient_norm_uT_per_m(box_grid_m(UTILIZATION_BOX_M, (30, 30, 6)))
    assert gradient.max() == pytest.approx(20.0)
    assert 0.2 < gradient.min() < 3.0
    norm = np.linalg.norm(room.field_uT(box_grid_m(TRAINING_BOX_M, (9, 7, 8))), axis=1)
    assert 35.0 < norm.min() < norm.max() < 80.0  # Kuevor, L1301: 43.9-73.3 uT


@pytest.mark.parametrize("seed", SEEDS)
def test_the_field_has_neither_curl_nor_divergence(seed):
    room = make_room(np.random.default_rng(seed))
    points_m, step_m = box_grid_m(TRAINING_BOX_M, (4, 4, 4)), 1e-3
    jacobian = np.stack(
        [(room.field_uT(points_m + s) - room.field_uT(points_m - s)) / (2 * step_m) for s in step_m * np.eye(3)],
        axis=2,
    )
    scale = room.gradient_norm_uT_per_m(points_m)
    assert np.allclose(np.linalg.norm(jacobian, axis=(1, 2)), scale, rtol=1e-4)
    assert np.all(np.abs(np.trace(jacobian, axis1=1, axis2=2)) < 1e-3 * scale)
    assert np.all(np.abs(jacobian - jacobian.transpose(0, 2, 1)).max(axis=(1, 2)) < 1e-3 * scale)


@pytest.mark.parametrize(
    ("altitudes_m", "seeds_count"),
    [(LOWER_FOUR_M, 577), (UPPER_FOUR_M, 573), (GAMMA_SCAN_M, 442), (EPSILON_SCAN_M, 396)],
)
def test_flights_cover_the_box_at_their_altitudes(altitudes_m, seeds_count):
    rng = np.random.default_rng(0)
    flight = fly(make_room(rng), altitudes_m, rng)
    assert len(flight) == pytest.approx(seeds_count, rel=0.13)  # Kuevor, L704-L714
    on_altitude = np.abs(flight.p_building_m[:, 2, None] - altitudes_m).min(axis=1) < 1e-9
    assert on_altitude.mean() > 0.97
    assert np.all(flight.p_building_m >= TRAINING_BOX_M[0] - 1e-9)
    assert np.all(flight.p_building_m <= TRAINING_BOX_M[1] + 1e-9)
    for altitude in altitudes_m:
        level = flight.p_building_m[flight.p_building_m[:, 2] == altitude]
        assert len(set(np.round(level[:, 1] / 0.25).tolist())) == 13
        assert np.all(np.ptp(level[:, :2], axis=0) > [3.9, 2.9])
    speed_m_s = np.linalg.norm(np.diff(flight.p_building_m, axis=0), axis=1) * 2.0
    assert speed_m_s.max() < 1.9  # Kuevor, L528-L535


def test_ten_hertz_is_five_times_two_hertz():
    rng = np.random.default_rng(0)
    room = make_room(rng)
    fine, coarse = (fly(room, GAMMA_SCAN_M, rng, rate_hz=rate, noise_uT=0.0) for rate in (10.0, 2.0))
    assert np.allclose(fine.B_uT[::5], coarse.B_uT)
    assert np.allclose(coarse.B_uT, room.field_uT(coarse.p_building_m))


def test_noise_and_offset_are_what_was_asked():
    room = make_room(np.random.default_rng(0))
    rng = np.random.default_rng(1)
    flights = [fly(room, GAMMA_SCAN_M, rng, noise_uT=0.3, offset_sd_uT=0.5) for _ in range(60)]
    errors_uT = [flight.B_uT - room.field_uT(flight.p_building_m) for flight in flights]
    assert np.sqrt(np.mean([error.var(axis=0) for error in errors_uT])) == pytest.approx(0.3, rel=0.02)
    assert np.std([error.mean(axis=0) for error in errors_uT]) == pytest.approx(0.5, rel=0.2)
