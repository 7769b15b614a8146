import numpy as np
import pytest

from app.geometry import rotate_by_quaternion, wrap_angle_rad, yaw_matrix
from app.survey.read import read_survey
from app.synthetic import Magnetometer, SyntheticBuilding, random_waypoints, survey, survey_csv, window

PERFECT = Magnetometer(noise_uT=0.0)
FLAWED = Magnetometer(
    noise_uT=0.4, hard_iron_uT=(1.0, -2.0, 0.5), tilt_sd_rad=0.02, yaw_sd_rad=0.05, position_sd_m=0.3,
    step_scale_sd=0.02, step_noise_m=0.03,
)  # fmt: skip


def test_perfect_survey_reads_the_field(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    walk = random_waypoints(building, 1, rng, length_m=40.0)
    samples = survey(building, walk, PERFECT, rng)
    np.testing.assert_array_equal(samples.p_building_m, walk.p_building_m)
    np.testing.assert_allclose(samples.B_uT, building.field_uT(walk.p_building_m), atol=1e-9)


def test_survey_errors_have_the_sizes_stated(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    walk = random_waypoints(building, 0, rng, length_m=400.0, rate_hz=5.0)
    noisy = survey(building, walk, Magnetometer(noise_uT=0.7), rng)
    assert np.std(noisy.B_uT - building.field_uT(walk.p_building_m)) == pytest.approx(0.7, rel=0.05)
    moved = survey(building, walk, Magnetometer(noise_uT=0.0, position_sd_m=0.5, position_correlation_m=2.0), rng)
    offset = (moved.p_building_m - walk.p_building_m)[:, :2]
    assert offset.std() == pytest.approx(0.5, rel=0.2)
    assert np.abs(np.diff(offset, axis=0)).mean() < 0.25


def test_hard_iron_stays_in_the_body_frame(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    walk = random_waypoints(building, 0, rng, length_m=60.0)
    samples = survey(building, walk, Magnetometer(noise_uT=0.0, hard_iron_uT=(3.0, 0.0, 1.0)), rng)
    error = samples.B_uT - building.field_uT(walk.p_building_m)
    forward = np.stack([np.cos(walk.heading_rad), np.sin(walk.heading_rad)], axis=1)
    np.testing.assert_allclose(error[:, :2], 3.0 * forward, atol=1e-9)
    np.testing.assert_allclose(error[:, 2], 1.0, atol=1e-9)


def test_attitude_error_turns_the_field_and_keeps_its_norm(
    building: SyntheticBuilding, rng: np.random.Generator
) -> None:
    walk = random_waypoints(building, 0, rng, length_m=60.0)
    samples = survey(building, walk, Magnetometer(noise_uT=0.0, tilt_sd_rad=0.03, yaw_sd_rad=0.05), rng)
    truth = building.field_uT(walk.p_building_m)
    np.testing.assert_allclose(np.linalg.norm(samples.B_uT, axis=1), np.linalg.norm(truth, axis=1), rtol=1e-12)
    angle = np.linalg.norm(np.cross(samples.B_uT, truth), axis=1) / np.sum(truth**2, axis=1)
    assert 0.01 < np.sqrt(np.mean(angle**2)) < 0.1


def test_csv_round_trip_in_the_building_frame(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    samples = survey(building, random_waypoints(building, 1, rng, length_m=20.0), FLAWED, rng)
    read = read_survey(survey_csv(samples), format="csv").samples
    assert read.frame == "building"
    for name in ("t_s", "p_building_m", "B_uT"):
        np.testing.assert_allclose(getattr(read, name), getattr(samples, name), rtol=1e-7, atol=1e-7)


def test_csv_round_trip_in_the_body_frame(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    samples = survey(building, random_waypoints(building, 0, rng, length_m=20.0), FLAWED, rng)
    read = read_survey(survey_csv(samples, body=True), format="csv").samples
    np.testing.assert_allclose(read.B_uT, samples.B_uT, atol=1e-6)
    assert read.q_body_to_building is not None
    assert samples.q_body_to_building is not None
    turned_back = rotate_by_quaternion(samples.q_body_to_building * [1, -1, -1, -1], samples.B_uT)
    np.testing.assert_allclose(rotate_by_quaternion(read.q_body_to_building, turned_back), samples.B_uT, atol=1e-6)


def test_perfect_level_window_is_the_field_seen_from_its_first_sample(
    building: SyntheticBuilding, rng: np.random.Generator
) -> None:
    walk = random_waypoints(building, 1, rng, length_m=60.0)
    seen, pose = window(building, walk, PERFECT, rng, length_m=10.0, samples=20)
    assert seen.yaw_rad is not None
    start_heading = pose.heading_rad - seen.yaw_rad[-1]
    turn = yaw_matrix(start_heading)
    p = pose.position_m + (seen.displacement_m - seen.displacement_m[-1]) @ turn.T
    p[:, 2] = pose.position_m[2]
    B_building = seen.B_uT @ turn.T
    np.testing.assert_allclose(B_building[-1], building.field_uT(pose.position_m[None])[0], atol=1e-9)
    np.testing.assert_allclose(B_building, building.field_uT(p), atol=2.0)  # the bob is not in the displacement
    assert pose.floor == 1
    assert seen.heading_rad is None
    assert -np.pi < pose.heading_rad <= np.pi


def test_window_is_equally_spaced_and_starts_at_zero(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    walk = random_waypoints(building, 0, rng, length_m=60.0)
    seen, _ = window(building, walk, PERFECT, rng, length_m=12.0, samples=25)
    assert seen.B_uT.shape == (25, 3)
    assert not seen.displacement_m[0].any()
    step = np.linalg.norm(np.diff(seen.displacement_m, axis=0), axis=1)
    assert step.max() == pytest.approx(0.5, rel=1e-2)
    assert seen.t_s is not None
    assert seen.t_s[0] == 0.0
    assert np.all(np.diff(seen.t_s) > 0)


def test_building_and_norm_windows(building: SyntheticBuilding) -> None:
    walk = random_waypoints(building, 0, np.random.default_rng(2), length_m=60.0)
    frames = {
        frame: window(building, walk, PERFECT, np.random.default_rng(3), length_m=8.0, samples=9, frame=frame)
        for frame in ("building", "level", "norm")
    }
    seen, pose = frames["building"]
    level, _ = frames["level"]
    norm, _ = frames["norm"]
    p = pose.position_m + seen.displacement_m - seen.displacement_m[-1]
    np.testing.assert_allclose(seen.B_uT[-1], building.field_uT(p)[-1], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(seen.B_uT, axis=1, keepdims=True), norm.B_uT, atol=1e-9)
    np.testing.assert_allclose(level.B_uT[:, 2], seen.B_uT[:, 2], atol=1e-9)
    np.testing.assert_allclose(level.displacement_m, norm.displacement_m)


def test_one_sample_window(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    walk = random_waypoints(building, 0, rng, length_m=20.0)
    seen, pose = window(building, walk, FLAWED, rng, length_m=0.0, samples=1)
    assert seen.B_uT.shape == (1, 3)
    assert seen.displacement_m.tolist() == [[0.0, 0.0, 0.0]]
    assert pose.position_m.shape == (3,)


def test_dead_reckoning_drifts_by_what_is_stated(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    sensor = Magnetometer(noise_uT=0.0, step_scale_sd=0.05)
    lengths = []
    for _ in range(200):
        walk = random_waypoints(building, 0, rng, length_m=12.0)
        seen, _ = window(building, walk, sensor, rng, length_m=10.0, samples=6)
        exact, _ = window(building, walk, PERFECT, np.random.default_rng(0), length_m=10.0, samples=6)
        lengths.append(np.linalg.norm(np.diff(seen.displacement_m, axis=0), axis=1).max() / 2.0)
        assert exact.displacement_m.shape == seen.displacement_m.shape
    assert np.std(lengths) == pytest.approx(0.05, rel=0.35)


def test_headings_wrap(building: SyntheticBuilding, rng: np.random.Generator) -> None:
    walk = random_waypoints(building, 0, rng, length_m=200.0)
    assert np.all(walk.heading_rad == wrap_angle_rad(walk.heading_rad))


def test_same_seed_same_window(building: SyntheticBuilding) -> None:
    walk = random_waypoints(building, 0, np.random.default_rng(1), length_m=60.0)
    first, second = (
        window(building, walk, FLAWED, np.random.default_rng(8), length_m=10.0, samples=20) for _ in range(2)
    )
    np.testing.assert_array_equal(first[0].B_uT, second[0].B_uT)
    np.testing.assert_array_equal(first[0].displacement_m, second[0].displacement_m)
    np.testing.assert_array_equal(first[1].position_m, second[1].position_m)
