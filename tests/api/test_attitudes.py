"""Orientations over HTTP: every reference, against the truth of a simulated walk over a mapped floor."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

RATE_HZ = 50.0
G = 9.81
ANCHOR = {"latitude_deg": 42.294431, "longitude_deg": -83.710442, "height_m": 236.0, "bearing_deg": 2.0}


@pytest.fixture(scope="module")
def database_url(sqlite_url: str) -> str:
    """The database is asked for rows by their ids alone, as in test_calibrations, which runs on both kinds."""
    return sqlite_url


@pytest.fixture(scope="module")
def carried(true_field_uT: Callable[..., np.ndarray]) -> tuple[dict[str, Any], np.ndarray, Rotation]:
    """A minute's walk over the small floor, the device tilting in the hand: the query's columns, places, attitudes."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 60.0, 1.0 / RATE_HZ)
    x, y = 6.0 + 4.5 * np.sin(0.35 * t), 4.0 + 3.0 * np.sin(0.21 * t + 0.5)
    p = np.column_stack([x, y, np.full(len(t), 1.2)])
    angles = np.column_stack([0.3 * t + 0.4 * np.sin(0.5 * t), 0.2 * np.sin(0.7 * t), 0.3 * np.sin(0.4 * t + 1.0)])
    truth = Rotation.from_euler("ZYX", angles)
    turned = (truth[:-1].inv() * truth[1:]).as_rotvec() * RATE_HZ
    gyro = np.vstack([turned[:1], turned]) + np.array([0.004, -0.003, 0.002]) + rng.normal(0, 0.003, (len(t), 3))
    acceleration = np.gradient(np.gradient(p, t, axis=0), t, axis=0) + np.array([0.0, 0.0, G])
    force = truth.inv().apply(acceleration) + rng.normal(0, 0.1, (len(t), 3))
    B = truth.inv().apply(true_field_uT(x, y)) + rng.normal(0, 0.3, (len(t), 3))
    columns: dict[str, Any] = {
        "t_s": t.tolist(), "gyro_rad_per_s": gyro.tolist(), "accelerometer_m_per_s2": force.tolist(),
        "magnetometer_ut": [row if k % 2 == 0 else None for k, row in enumerate(B.tolist())],
    }  # fmt: skip
    return columns, p, truth


@pytest.fixture(scope="module")
def anchored_floor(service: Any, walk_csv: Callable[..., bytes]) -> str:
    building = service.http.post("/v1/buildings", json={"name": "Anchored", "anchor": ANCHOR}).json()["id"]
    made = service.http.post(
        f"/v1/buildings/{building}/floors", json={"name": "G", "ordinal": 0, "elevation_m": 0.0}
    )  # fmt: skip
    floor = str(made.json()["id"])
    for seed in (1, 2, 3):
        service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(seed, offset_m=0.25 * seed))
    service.run_jobs()
    return floor


def ask(service: Any, columns: dict[str, Any], reference: dict[str, Any], **more: object) -> Any:
    answer = service.http.post("/v1/attitudes", json={**columns, "reference": reference, "every": 10, **more})
    assert answer.status_code == 200, answer.text
    return answer.json()


def errors_deg(answer: Any, truth: Rotation) -> tuple[np.ndarray, np.ndarray]:
    """Heading and tilt errors of the answered samples, in the building frame, after the first ten seconds."""
    at = np.round(np.array(answer["t_s"]) * RATE_HZ).astype(int)
    got = Rotation.from_quat(answer["orientation"], scalar_first=True)
    off = (got * truth[at].inv()).as_rotvec(degrees=True)[at > 10 * RATE_HZ]
    return off[:, 2], np.linalg.norm(off[:, :2], axis=1)


def test_a_map_gives_the_right_north_where_one_vector_does_not(service: Any, anchored_floor: str, carried: Any) -> None:
    columns, p, truth = carried
    on_map = ask(service, columns, {"kind": "map", "floor_id": anchored_floor, "position_m": p.tolist(),
                                    "position_sd_m": 0.1})  # fmt: skip
    heading, tilt = errors_deg(on_map, truth)
    rms = np.sqrt(np.mean(heading**2))
    assert rms < 2.0
    assert np.sqrt(np.mean(tilt**2)) < 2.0
    assert on_map["frame"] == "building"
    assert on_map["reference"]["mapped_share"] > 0.9
    assert on_map["magnetometer_used_share"] > 0.8
    point = ask(service, columns, {"kind": "map_point", "floor_id": anchored_floor, "position_m": [6.0, 4.0, 1.2]})
    earth = ask(service, columns, {"kind": "wmm", "floor_id": anchored_floor})
    assert earth["reference"]["model"] == "WMM-2025"
    for other in (point, earth):
        assert np.sqrt(np.mean(errors_deg(other, truth)[0] ** 2)) > 2.0 * rms
        assert other["frame"] == "building"


def test_without_a_reference_gravity_is_up_and_yaw_is_relative(service: Any, carried: Any) -> None:
    columns, _, truth = carried
    told = ask(service, columns, {"kind": "none"})
    assert told["frame"] == "relative"
    assert told["calibration"] is None
    at = np.round(np.array(told["t_s"]) * RATE_HZ).astype(int)
    up = Rotation.from_quat(told["orientation"], scalar_first=True).inv().apply([0, 0, 1])
    off = np.degrees(np.arccos(np.clip(np.sum(up * truth[at].inv().apply([0, 0, 1]), axis=1), -1, 1)))
    assert np.sqrt(np.mean(off[at > 500] ** 2)) < 3.0
    learned = ask(service, columns, {"kind": "learned"})
    assert learned["frame"] == "relative"


def test_angles_and_their_sds_are_those_of_the_quaternion(service: Any, carried: Any) -> None:
    columns, _, _ = carried
    told = ask(service, columns, {"kind": "level", "horizontal_ut": 18.0, "vertical_ut": -42.0})
    assert told["frame"] == "magnetic_north"
    angles = Rotation.from_quat(told["orientation"], scalar_first=True).as_euler("ZYX")
    for k, name in enumerate(("yaw", "pitch", "roll")):
        np.testing.assert_allclose(told[f"{name}_rad"], angles[:, k], atol=1e-9)
        assert min(told[f"{name}_sd_rad"]) > 0.0
    assert np.linalg.eigvalsh(told["covariance_rad2"]).min() > 0.0
    assert told["t_s"][-1] == columns["t_s"][-1]
    assert len(told["t_s"]) == len(told["orientation"]) == len(columns["t_s"]) // 10 + 1


def test_a_hard_iron_is_taken_out_by_the_devices_calibration(service: Any, anchored_floor: str, carried: Any) -> None:
    columns, p, truth = carried
    hard_iron = np.array([25.0, -15.0, 10.0])
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(500, 3))
    sphere = 50.0 * directions / np.linalg.norm(directions, axis=1, keepdims=True) + hard_iron
    made = service.http.post("/v1/calibrations", json={
        "device": "attitude phone", "method": "ellipsoid", "reference": {"magnitude_ut": 50.0},
        "b_ut": sphere.tolist()})  # fmt: skip
    assert made.status_code == 201, made.text
    raw = columns | {
        "magnetometer_ut": [None if row is None else np.add(row, hard_iron).tolist()
                            for row in columns["magnetometer_ut"]]
    }  # fmt: skip
    reference = {"kind": "map", "floor_id": anchored_floor, "position_m": p.tolist(), "position_sd_m": 0.1}
    calibrated = ask(service, raw, reference, device="attitude phone")
    assert calibrated["calibration"]["id"] == made.json()["id"]
    assert np.sqrt(np.mean(errors_deg(calibrated, truth)[0] ** 2)) < 2.0


def test_a_magnet_held_near_is_told_and_not_believed(service: Any, anchored_floor: str, carried: Any) -> None:
    columns, p, truth = carried
    from_s, to_s = 30.0, 38.0
    rows = [
        row if row is None or not from_s <= t <= to_s else np.add(row, [40.0, 30.0, -20.0]).tolist()
        for t, row in zip(columns["t_s"], columns["magnetometer_ut"], strict=True)
    ]
    reference = {"kind": "map", "floor_id": anchored_floor, "position_m": p.tolist(), "position_sd_m": 0.1}
    told = ask(service, columns | {"magnetometer_ut": rows}, reference)
    covered = sum(max(0.0, min(each["end_s"], to_s) - max(each["start_s"], from_s)) for each in told["disturbed"])
    assert covered > 0.6 * (to_s - from_s), told["disturbed"]
    heading, _ = errors_deg(told, truth)
    assert np.sqrt(np.mean(heading**2)) < 6.0


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "lengths": ({"gyro_rad_per_s": [[0, 0, 0]]}, "gyro_rad_per_s"),
    "time goes back": ({"t_s": [0.0, 0.0]}, "increase"),
    "no gravity": ({"accelerometer_m_per_s2": [None, None]}, "gravity"),
    "part of a row": ({"accelerometer_m_per_s2": [[0, 0], [0, 0, 9.8]]}, "accelerometer"),
    "wmm where": ({"reference": {"kind": "wmm"}}, "building_id"),
    "map where": ({"reference": {"kind": "map", "floor_id": "x"}}, "position_m"),
    "map for each": ({"reference": {"kind": "map", "floor_id": "x", "position_m": [1, 2, 3]}}, "every sample"),
    "level of what": ({"reference": {"kind": "level"}}, "horizontal_ut"),
    "nothing to compare": ({"magnetometer_ut": [None, None]}, "magnetometer"),
    "unknown": ({"reference": {"kind": "compass"}}, "kind"),
}


@pytest.mark.parametrize("kind", ["map", "map_point"])
def test_no_position_is_refused(service: Any, kind: str) -> None:
    reference = {"kind": kind, "floor_id": "x", "position_m": []}
    query = {
        "t_s": [0.0, 0.02], "gyro_rad_per_s": [[0, 0, 0]] * 2, "accelerometer_m_per_s2": [[0, 0, 9.8]] * 2,
        "magnetometer_ut": [[18, 3, -42]] * 2, "reference": reference,
    }  # fmt: skip
    answer = service.http.post("/v1/attitudes", json=query)
    assert answer.status_code == 422, answer.text
    assert "position_m" in answer.text


@pytest.mark.parametrize("last_s", [1e11, 1e150, 1e308])
def test_a_long_silence_has_an_answer_and_one_beyond_any_clock_is_refused(service: Any, last_s: float) -> None:
    query = {
        "t_s": [0.0, 1.0, last_s], "gyro_rad_per_s": [[0, 0, 0.1]] * 3, "accelerometer_m_per_s2": [[0, 0, 9.8]] * 3,
        "reference": {"kind": "none"},
    }  # fmt: skip
    answer = service.http.post("/v1/attitudes", json=query)
    assert answer.status_code == (200 if last_s <= 1e11 else 422), answer.text
    assert answer.status_code == 422 or None not in answer.json()["yaw_sd_rad"]


@pytest.mark.parametrize("case", REFUSED)
def test_what_cannot_be_answered_is_refused(service: Any, case: str) -> None:
    body, said = REFUSED[case]
    good = {
        "t_s": [0.0, 0.02], "gyro_rad_per_s": [[0, 0, 0]] * 2, "accelerometer_m_per_s2": [[0, 0, 9.8]] * 2,
        "magnetometer_ut": [[18, 3, -42]] * 2, "reference": {"kind": "level", "horizontal_ut": 18, "vertical_ut": -42},
    }  # fmt: skip
    assert service.http.post("/v1/attitudes", json=good).status_code == 200
    answer = service.http.post("/v1/attitudes", json=good | body)
    assert answer.status_code == 422, answer.text
    assert said in answer.text


def test_of_others_nothing_is_told(
    service: Any, anchored_floor: str, building: str, stranger: dict[str, str], new_floor: Callable[..., str]
) -> None:
    body = {"t_s": [0.0, 0.02], "gyro_rad_per_s": [[0, 0, 0]] * 2, "accelerometer_m_per_s2": [[0, 0, 9.8]] * 2,
            "magnetometer_ut": [[18, 3, -42]] * 2}  # fmt: skip
    here = {"kind": "map_point", "floor_id": anchored_floor, "position_m": [6.0, 4.0, 1.2]}
    for reference in (here, {"kind": "wmm", "floor_id": anchored_floor}):
        asked = body | {"reference": reference}
        assert service.http.post("/v1/attitudes", json=asked).status_code == 200
        assert service.http.post("/v1/attitudes", json=asked, headers=stranger).status_code == 404
    unmapped = here | {"floor_id": new_floor()}
    assert service.http.post("/v1/attitudes", json=body | {"reference": unmapped}).status_code == 409
    away = here | {"position_m": [500.0, 4.0, 1.2]}
    assert service.http.post("/v1/attitudes", json=body | {"reference": away}).status_code == 422
    unanchored = {"kind": "wmm", "building_id": building}
    answer = service.http.post("/v1/attitudes", json=body | {"reference": unanchored})
    assert answer.status_code == 422
    assert "anchor" in answer.text


def steps_of(carried: Any, *, body: bool, per_step: int = 5) -> list[dict[str, Any]]:
    """The walk as a track's steps, ten a second, each with the inertial samples since the one before."""
    columns, p, truth = carried
    level = Rotation.from_euler("z", -truth[0].as_euler("ZYX")[0])
    steps = []
    for number, end in enumerate(range(per_step, len(p), per_step)):
        rows = slice(end - per_step, end)
        inertial = {name: values[rows] for name, values in columns.items()}
        reading = np.array([row for row in inertial["magnetometer_ut"] if row is not None]).mean(axis=0)
        at = end - 1
        step = {"number": number, "t_s": columns["t_s"][at], "inertial": inertial}
        if body:
            step |= {"b_ut": reading.tolist(), "displacement_m": level.apply(p[at] - p[per_step - 1]).tolist()}
        else:
            turned = truth[at].apply(reading)
            step |= {"b_ut": turned.tolist(), "displacement_m": (p[at] - p[per_step - 1]).tolist()}
        steps.append(step)
    return steps


def test_a_track_follows_the_attitude_against_the_map_where_it_is(
    service: Any, anchored_floor: str, carried: Any
) -> None:
    """Yaw is not known before the track has converged; then the map tells the building's own north."""
    made = service.http.post("/v1/tracks", json={
        "floor_ids": [anchored_floor], "frame": "building", "attitude": {"reference": "map"}, "seed": 5,
        "options": {"particles": 1000, "noise_ut": 0.3, "speed_m_s": 1.5}})  # fmt: skip
    assert made.status_code == 201, made.text
    track = made.json()
    assert track["attitude"] == {"reference": "map"}
    steps = steps_of(carried, body=False)
    path = f"/v1/tracks/{track['id']}/steps"
    first = service.http.post(path, json={"steps": steps[:5]}).json()["estimate"]
    assert first["attitude"]["frame"] == "building"
    assert first["attitude"]["yaw_sd_rad"] > 1.0
    assert first["attitude"]["pitch_sd_rad"] < 0.2
    for start in range(5, len(steps), 100):
        answer = service.http.post(path, json={"steps": steps[start : start + 100]})
        assert answer.status_code == 200, answer.text
    estimate = answer.json()["estimate"]
    assert estimate["state"] == "converged"
    assert estimate["disturbed"] is False
    attitude = estimate["attitude"]
    _, _, truth = carried
    at = round(estimate["t_s"] * RATE_HZ)
    off = (Rotation.from_quat(attitude["orientation"], scalar_first=True) * truth[at].inv()).as_rotvec(degrees=True)
    assert np.abs(off[2]) < 5.0
    assert np.linalg.norm(off[:2]) < 4.0
    assert attitude["yaw_sd_rad"] < 0.1
    replayed = service.http.post(f"/v1/tracks/{track['id']}/replay").text.strip().splitlines()[-1]
    assert '"equal":true' in replayed


def test_a_phones_own_attitude_levels_its_readings(service: Any, anchored_floor: str, carried: Any) -> None:
    """Steps in the device's axes without orientation: the track's own attitude turns them."""
    asked = {"floor_ids": [anchored_floor], "frame": "body", "orientation_frame": "level", "seed": 5,
             "attitude": {"reference": "none"}, "options": {"particles": 1000, "noise_ut": 0.3}}  # fmt: skip
    track = service.http.post("/v1/tracks", json=asked).json()
    steps = steps_of(carried, body=True)
    for start in range(0, len(steps), 100):
        answer = service.http.post(f"/v1/tracks/{track['id']}/steps", json={"steps": steps[start : start + 100]})
        assert answer.status_code == 200, answer.text
    estimate = answer.json()["estimate"]
    _, p, _ = carried
    assert estimate["state"] == "converged", estimate
    assert np.hypot(*(np.array(estimate["position_m"][:2]) - p[round(estimate["t_s"] * RATE_HZ)][:2])) < 0.6
    assert estimate["attitude"]["frame"] == "relative"


def test_inertial_samples_need_a_track_with_attitude_and_increasing_times(
    service: Any, anchored_floor: str, building: str, carried: Any
) -> None:
    plain = {"floor_ids": [anchored_floor], "frame": "building"}
    steps = steps_of(carried, body=False)[:2]
    track = service.http.post("/v1/tracks", json=plain).json()["id"]
    answer = service.http.post(f"/v1/tracks/{track}/steps", json={"steps": steps})
    assert answer.status_code == 422
    assert answer.json()["errors"][0]["location"] == "/body/steps/0/inertial"
    track = service.http.post("/v1/tracks", json=plain | {"attitude": {"reference": "wmm"}}).json()
    assert track["attitude"]["model"] == "WMM-2025"
    backwards = steps[0]["inertial"] | {"t_s": steps[0]["inertial"]["t_s"][::-1]}
    path = f"/v1/tracks/{track['id']}/steps"
    answer = service.http.post(path, json={"steps": [steps[0] | {"inertial": backwards}]})
    assert answer.status_code == 422
    assert "increase" in answer.text
    # samples that were followed already, or come before the accelerometer's first reading, count for nothing
    deaf = steps[0]["inertial"] | {"accelerometer_m_per_s2": [None] * 5}
    first = service.http.post(path, json={"steps": [steps[0] | {"inertial": deaf}]}).json()["estimate"]
    assert first["attitude"] is None
    told = service.http.post(path, json={"steps": [steps[1]]}).json()["estimate"]["attitude"]
    again = steps[1] | {"number": 2}
    assert service.http.post(path, json={"steps": [again]}).json()["estimate"]["attitude"] == told


def test_places_that_jitter_are_not_taken_for_speed(service: Any, anchored_floor: str, carried: Any) -> None:
    """White errors of 0.1 m fifty times a second look like 7 m/s, with which the accelerometer would tell nothing."""
    columns, p, truth = carried
    jittering = p + np.random.default_rng(1).normal(0.0, 0.1, p.shape) * [1.0, 1.0, 0.0]
    told = ask(service, columns, {"kind": "map", "floor_id": anchored_floor, "position_m": jittering.tolist(),
                                  "position_sd_m": 0.1})  # fmt: skip
    heading, tilt = errors_deg(told, truth)
    assert np.sqrt(np.mean(heading**2)) < 3.0
    assert np.sqrt(np.mean(tilt**2)) < 2.0
    assert np.sqrt(np.mean(np.square(told["pitch_sd_rad"]))) < 0.05
