"""Calibrations over HTTP: made from readings, applied to surveys and windows, versioned, never silent."""

import io
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

HARD_IRON = np.array([-30.0, 18.0, 25.0])
DISTORTION = np.array([[1.06, 0.02, -0.01], [0.03, 0.95, 0.02], [-0.02, 0.01, 1.03]])  # true to measured
PLACE = {"latitude_deg": 42.294431, "longitude_deg": -83.710442, "height_m": 236.0, "date": "2022-09-01"}
FIELD_UT = 53.1351


def turned(n: int = 600, seed: int = 0, field_uT: float = FIELD_UT) -> list[list[float]]:
    """Readings of a distorted sensor turned through all directions."""
    rng = np.random.default_rng(seed)
    directions = rng.normal(size=(n, 3))
    B = field_uT * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    readings: list[list[float]] = (B @ DISTORTION.T + HARD_IRON + rng.normal(0, 0.05, (n, 3))).tolist()
    return readings


def circled(n: int = 400, seed: int = 0) -> list[list[float]]:
    """The same turned level, z up: |B_h| 19.3, B_z -49.5 uT."""
    rng = np.random.default_rng(seed)
    angle = np.linspace(0.0, 6.0 * np.pi, n)
    B = np.column_stack([19.283 * np.cos(angle), 19.283 * np.sin(angle), np.full(n, -49.512)])
    readings: list[list[float]] = (B @ DISTORTION.T + HARD_IRON + rng.normal(0, 0.05, (n, 3))).tolist()
    return readings


def calibrate(service: Any, **body: object) -> Any:
    asked = {"device": "phone", "method": "two_step", "reference": PLACE, "b_ut": turned()} | body
    return service.http.post("/v1/calibrations", json=asked)


def test_a_calibration_tells_everything_of_itself(service: Any) -> None:
    answer = calibrate(service, device="all of it", measured_at="2022-09-01T12:00:00Z")
    assert answer.status_code == 201, answer.text
    made = answer.json()
    assert (made["device"], made["version"], made["method"]) == ("all of it", 1, "two_step")
    np.testing.assert_allclose(made["model"]["hard_iron_ut"], HARD_IRON, atol=0.1)
    norm = np.linalg.norm(
        (np.array(turned(seed=1)) - made["model"]["hard_iron_ut"]) @ np.array(made["model"]["correction"]).T, axis=1
    )
    assert np.std(norm - FIELD_UT) < 0.07
    told = {"model": "WMM-2020", "date": "2022-09-01", "valid": True, "magnitude_ut": pytest.approx(53.13507)}
    assert made["reference"] == told
    assert made["coverage"]["cells_seen"] == made["coverage"]["cells"]
    assert set(made["parameter_sd"]) <= set(made["parameters"])
    assert np.array(made["covariance"]).shape == (len(made["parameters"]),) * 2
    assert made["residual_rms_ut"] == pytest.approx(0.05, rel=0.3)
    assert made["advice"] == []
    assert made["measured_at"] == "2022-09-01T12:00:00Z"
    assert service.http.get(f"/v1/calibrations/{made['id']}").json() == made


@pytest.mark.parametrize("method", ["ellipsoid", "two_step", "modified_ellipsoid", "swinging"])
def test_every_method_of_turning_answers(service: Any, method: str) -> None:
    circle = method in ("modified_ellipsoid", "swinging")
    answer = calibrate(service, device=method, method=method, b_ut=circled() if circle else turned())
    assert answer.status_code == 201, answer.text
    made = answer.json()
    corrected = (np.array(circled(seed=2)) - made["model"]["hard_iron_ut"]) @ np.array(made["model"]["correction"]).T
    horizontal = np.linalg.norm(corrected[:, :2], axis=1)
    if circle:
        assert np.abs(horizontal - 19.283).max() < (3.0 if method == "swinging" else 0.3)
        assert made["undetermined"]
        assert made["reference"]["vertical_ut"] == pytest.approx(-49.512, abs=0.001)


def test_versions_count_by_device_and_nothing_is_replaced(service: Any) -> None:
    first, second = (calibrate(service, device="again", b_ut=turned(seed=seed)).json() for seed in (1, 2))
    other = calibrate(service, device="other").json()
    assert [first["version"], second["version"], other["version"]] == [1, 2, 1]
    listed = service.http.get("/v1/calibrations", params={"device": "again"}).json()["items"]
    assert [each["id"] for each in listed] == [first["id"], second["id"]]
    assert service.http.get(f"/v1/calibrations/{first['id']}").json() == first


def test_the_same_request_again_makes_no_second_version(service: Any) -> None:
    key = {"Idempotency-Key": "calibrate-once"}
    asked = {"device": "once", "method": "two_step", "reference": PLACE, "b_ut": turned()}
    first, again = (service.http.post("/v1/calibrations", json=asked, headers=key) for _ in range(2))
    assert first.status_code == 201, first.text
    assert first.json() == again.json()
    assert len(service.http.get("/v1/calibrations", params={"device": "once"}).json()["items"]) == 1
    blobs = service.blob_count()
    assert service.http.post("/v1/calibrations", json=asked, headers=key).headers["Idempotent-Replayed"] == "true"
    assert service.blob_count() == blobs
    other = service.http.post("/v1/calibrations", json=asked | {"device": "another"}, headers=key)
    assert other.status_code == 409


def test_many_calibrations_of_one_device_at_once_are_all_kept(service: Any) -> None:
    with ThreadPoolExecutor(10) as threads:
        answers = list(threads.map(lambda k: calibrate(service, device="busy", b_ut=turned(100, seed=k)), range(10)))
    assert [answer.status_code for answer in answers] == [201] * 10
    assert sorted(answer.json()["version"] for answer in answers) == list(range(1, 11))


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "a circle is no sphere": ({"b_ut": circled()}, "axis"),
    "half of the directions": ({"b_ut": [b for b in turned() if b[0] > -20.0 and b[2] > 30.0]}, "not seen"),
    "no circle": ({"method": "modified_ellipsoid", "b_ut": circled()[:60]}, "circle"),
    "too few": ({"b_ut": turned()[:5]}, "too few"),
    "constant": ({"b_ut": [[20.0, 1.0, -40.0]] * 200}, "constant"),
    "another field": ({"reference": {"magnitude_ut": 20.0}, "b_ut": (3.0 * np.random.default_rng(0).normal(
        size=(300, 3)) ** 3).tolist()}, ""),
    "no reference": ({"reference": None}, "reference"),
    "a place that is none": ({"reference": {"latitude_deg": 10.0}}, "magnitude_ut"),
    "half a place beside a magnitude": ({"reference": {"latitude_deg": 10.0, "magnitude_ut": 50.0}}, "longitude_deg"),
    "two places": ({"reference": PLACE | {"building_id": "x"}}, "not both"),
    "no time in UTC": ({"measured_at": "0001-01-01T00:00:00+14:00"}, "measured_at"),
    "mostly at rest": ({"b_ut": [[20.0, 1.0, -40.0]] * 600 + turned(500)}, "at rest"),
    "beyond any sensor": ({"method": "ellipsoid", "b_ut": (3e8 * np.random.default_rng(0).normal(
        size=(100, 3))).clip(-1e9, 1e9).tolist()}, "microtesla"),
    "before the models": ({"reference": PLACE | {"date": "1999-01-01"}}, "2010"),
    "a walk for turning": ({"walk": {"floor_id": "x", "orientation": [], "position_m": []}}, "map_aided"),
    "no walk": ({"method": "map_aided"}, "walk"),
    "not finite": ({"b_ut": [["x", 0, 0]] * 10}, ""),
    "a device without a name": ({"device": ""}, ""),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_determine_a_calibration_is_refused_with_advice(service: Any, case: str) -> None:
    body, said = REFUSED[case]
    before = service.row_counts()
    answer = calibrate(service, **body)
    assert answer.status_code == 422, answer.text
    assert said in answer.text
    assert service.row_counts() == before


def body_table(readings: np.ndarray, p: np.ndarray, q: np.ndarray) -> bytes:
    rows = np.column_stack([0.2 * np.arange(len(p)), p, readings, q])
    out = io.StringIO()
    np.savetxt(
        out, rows, fmt="%.6f", delimiter=",", header="t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut,qw,qx,qy,qz", comments=""
    )
    return out.getvalue().encode()


@pytest.fixture(scope="module")
def walked(true_field_uT: Callable[..., np.ndarray]) -> Callable[..., tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """A walk over the small floor with the distorted sensor tilting as a hand does: readings, positions, attitudes."""

    def make(seed: int = 0, n: int = 700, tilt_rad: float = 0.5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rng = np.random.default_rng(seed)
        along = np.arange(n) * 0.1
        x = 6.0 + 5.0 * np.sin(0.35 * along + 0.2 * seed)
        y = 4.0 + 3.5 * np.sin(0.21 * along + 0.5)
        p = np.column_stack([x, y, np.full(n, 1.2)])
        tilt = tilt_rad * np.sin(0.9 * along), tilt_rad * np.cos(0.7 * along)
        turned = Rotation.from_euler("zyx", np.column_stack([0.5 * along, *tilt]))
        B = true_field_uT(x, y)
        readings = turned.inv().apply(B) @ DISTORTION.T + HARD_IRON + rng.normal(0, 0.2, (n, 3))
        return readings, p, turned.as_quat(scalar_first=True)

    return make


def test_a_survey_is_calibrated_as_it_comes_in_and_says_so(
    service: Any, new_floor: Callable[..., str], walked: Any, true_field_uT: Callable[..., np.ndarray]
) -> None:
    made = calibrate(service, device="survey phone").json()
    floor = new_floor(auto_build=False)
    readings, p, q = walked()
    data = body_table(readings, p, q)
    asked = {"device": "survey phone"}
    answer = service.http.post(f"/v1/floors/{floor}/surveys", params=asked, content=data)
    assert answer.status_code == 202, answer.text
    survey = answer.json()["survey"]
    assert survey["calibration_id"] == made["id"]
    report = service.http.get(f"/v1/surveys/{survey['id']}/report").json()
    assert report["calibration"] == {"id": made["id"], "device": "survey phone", "version": 1}
    assert any("calibration" in each for each in report["assumptions"])
    assert report["session"] == "survey phone v1"
    told = service.http.get(f"/v1/surveys/{survey['id']}/samples").json()
    rows = np.array(told["rows"])
    left = rows[:, 4:] - true_field_uT(rows[:, 1], rows[:, 2])
    # a turned sphere leaves a rotation of the sensor unseen: the lower-triangular model's own, about 3 % here
    assert np.sqrt(np.mean(left**2)) < 2.5
    # the same bytes without it, or with another one, are not silently the same survey
    again = service.http.post(f"/v1/floors/{floor}/surveys", params=asked, content=data)
    assert (again.status_code, again.json()["survey"]["id"]) == (200, survey["id"])
    plain = service.http.post(f"/v1/floors/{floor}/surveys", content=data)
    assert plain.status_code == 409
    assert f"replaces={survey['id']}" in plain.json()["detail"]
    calibrate(service, device="survey phone", b_ut=turned(seed=9))
    assert service.http.post(f"/v1/floors/{floor}/surveys", params=asked, content=data).status_code == 409
    newer = service.http.post(
        f"/v1/floors/{floor}/surveys", params=asked | {"replaces": survey["id"]}, content=data
    )  # fmt: skip
    assert newer.status_code == 202, newer.text
    assert newer.json()["survey"]["calibration_id"] != made["id"]


def test_a_calibration_needs_readings_in_the_sensors_axes(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes]
) -> None:
    made = calibrate(service, device="axes").json()
    answer = service.http.post(
        f"/v1/floors/{new_floor()}/surveys", params={"calibration_id": made["id"]}, content=walk_csv(1)
    )
    assert answer.status_code == 422
    assert "qw,qx,qy,qz" in answer.json()["detail"]


def window_of(walked: Any, frame: str, mistaken_yaw: float = 0.0) -> tuple[dict[str, Any], np.ndarray]:
    readings, p, q = walked(seed=5)
    kept = slice(100, 200, 4)
    start = Rotation.from_quat(q[kept][0], scalar_first=True).as_euler("zyx")[0] if frame == "level" else 0.0
    level = Rotation.from_euler("z", -start)
    attitude = level * Rotation.from_quat(q[kept], scalar_first=True)
    window = {
        "frame": "body", "orientation_frame": frame, "b_ut": readings[kept].tolist(), "noise_ut": 0.3,
        "displacement_m": level.apply(p[kept] - p[kept][0]).tolist(),
        "orientation": attitude.as_quat(scalar_first=True).tolist(),
    }  # fmt: skip
    return window, p[kept][-1]


@pytest.mark.parametrize("frame", ["building", "level"])
def test_a_window_is_calibrated_and_says_by_what(service: Any, mapped_floor: str, walked: Any, frame: str) -> None:
    readings, p, q = walked(seed=1)
    walk = {"floor_id": mapped_floor, "orientation": q.tolist(), "position_m": p.tolist(), "position_sd_m": 0.05}
    answer = calibrate(
        service, device=f"walker {frame}", method="map_aided", reference=None, walk=walk, b_ut=readings.tolist()
    )
    assert answer.status_code == 201, answer.text
    made = answer.json()
    assert made["reference"]["floor_id"] == mapped_floor
    assert made["reference"]["map_id"]
    np.testing.assert_allclose(made["model"]["hard_iron_ut"], HARD_IRON, atol=1.5)
    window, truth = window_of(walked, frame)
    path = f"/v1/floors/{mapped_floor}/locate"
    raw = service.http.post(path, json={"window": window}).json()
    assert raw["status"] != "fix", "a hard iron of 40 uT is no window of this building"
    assert raw["calibration"] is None
    fix = service.http.post(path, json={"window": window | {"device": f"walker {frame}"}}).json()
    assert fix["calibration"] == {"id": made["id"], "device": f"walker {frame}", "version": 1}
    assert np.hypot(*(np.array(fix["estimates"]["ml"]["position_m"][:2]) - truth[:2])) < 0.5
    assert fix["status"] == "fix", fix["reason"]
    by_id = service.http.post(path, json={"window": window | {"calibration_id": made["id"]}}).json()
    assert by_id["estimates"] == fix["estimates"]


def test_a_window_in_another_frame_cannot_be_calibrated(service: Any, mapped_floor: str) -> None:
    window = {"frame": "level", "b_ut": [[20.0, 1.0, -40.0]] * 3, "displacement_m": [[k, 0, 0] for k in range(3)]}
    for more in ({"device": "phone"}, {"calibration_id": "x"}, {"orientation_frame": "level"}):
        answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": window | more})
        assert answer.status_code == 422
        assert "body" in answer.text


def test_a_track_is_calibrated_from_its_first_step_to_a_replay(service: Any, mapped_floor: str, walked: Any) -> None:
    readings, p, q = walked(seed=2)
    walk = {"floor_id": mapped_floor, "orientation": q.tolist(), "position_m": p.tolist(), "position_sd_m": 0.05}
    calibrate(service, device="tracked", method="map_aided", reference=None, walk=walk, b_ut=readings.tolist())
    asked = {
        "floor_ids": [mapped_floor], "frame": "body", "device": "tracked", "seed": 3,
        "options": {"particles": 1000, "noise_ut": 0.3},
    }  # fmt: skip
    made = service.http.post("/v1/tracks", json=asked)
    assert made.status_code == 201, made.text
    track = made.json()
    assert track["calibration"]["device"] == "tracked"
    readings, p, q = walked(seed=7)
    steps = [
        {"number": k, "t_s": 0.1 * k, "b_ut": readings[k].tolist(), "displacement_m": (p[k] - p[0]).tolist(),
         "orientation": q[k].tolist()}
        for k in range(250)
    ]  # fmt: skip
    answer = service.http.post(f"/v1/tracks/{track['id']}/steps", json={"steps": steps})
    assert answer.status_code == 200, answer.text
    estimate = answer.json()["estimate"]
    assert estimate["state"] == "converged", estimate
    assert np.hypot(*(np.array(estimate["position_m"][:2]) - p[249][:2])) < 0.5
    replayed = service.http.post(f"/v1/tracks/{track['id']}/replay").text.strip().splitlines()[-1]
    assert '"equal":true' in replayed


def test_unknown_and_foreign_calibrations_are_not_found(
    service: Any, stranger: dict[str, str], new_floor: Callable[..., str], walked: Any, mapped_floor: str
) -> None:
    made = calibrate(service, device="mine").json()
    assert service.http.get(f"/v1/calibrations/{made['id']}", headers=stranger).status_code == 404
    assert service.http.get("/v1/calibrations", headers=stranger).json()["items"] == []
    data = body_table(*walked())
    for asked in ({"calibration_id": "nope"}, {"device": "nobody"}, {"calibration_id": made["id"], "device": "other"}):
        answer = service.http.post(f"/v1/floors/{new_floor()}/surveys", params=asked, content=data)
        assert answer.status_code == (422 if len(asked) == 2 else 404)
    window, _ = window_of(walked, "building")
    answer = service.http.post(f"/v1/floors/{mapped_floor}/locate", json={"window": window | {"device": "nobody"}})
    assert answer.status_code == 404


def test_scopes(service: Any, key_with: Callable[..., dict[str, str]]) -> None:
    asked = {"device": "scoped", "reference": PLACE, "b_ut": turned()}
    for scope, status in (("map:read", 403), ("survey:write", 201), ("locate", 201)):
        assert service.http.post("/v1/calibrations", json=asked, headers=key_with(scope)).status_code == status
        assert service.http.get("/v1/calibrations", headers=key_with(scope)).status_code == 200


@pytest.mark.slow
@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)  # half a minute that no database has a part in
def test_a_phone_is_calibrated_by_a_walk_nobody_told_the_way_of(
    service: Any, building: str, mapped_floor: str, walked: Any
) -> None:
    readings, p, q = walked(seed=3, n=500, tilt_rad=0.15)
    kept = slice(None, None, 3)
    start = Rotation.from_quat(q[0], scalar_first=True).as_euler("ZYX")[0]
    level = Rotation.from_euler("z", -start)
    walk = {
        "building_id": building,
        "orientation": (level * Rotation.from_quat(q[kept], scalar_first=True)).as_quat(scalar_first=True).tolist(),
        "displacement_m": level.apply(p[kept] - p[0]).tolist(),
    }
    answer = calibrate(
        service, device="lost", method="map_aided", reference=None, walk=walk, b_ut=readings[kept].tolist()
    )
    assert answer.status_code == 201, answer.text
    made = answer.json()
    assert made["reference"]["floor_id"] == mapped_floor
    assert np.hypot(*(np.array(made["reference"]["ended_at_m"]) - p[kept][-1, :2])) < 0.6
    np.testing.assert_allclose(made["model"]["hard_iron_ut"], HARD_IRON, atol=3.0)
    flat = {**walk, "displacement_m": [[0.0, 0.0, 0.0]] * len(p[kept])}
    answer = calibrate(
        service, device="lost", method="map_aided", reference=None, walk=flat, b_ut=readings[kept].tolist()
    )
    assert answer.status_code == 422, "standing still tells nothing"


@pytest.mark.parametrize("known", [True, False])
def test_a_map_without_directions_calibrates_nothing(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes], walked: Any, known: bool
) -> None:
    floor = new_floor()
    service.http.post(f"/v1/floors/{floor}/surveys", params={"frame": "level"}, content=walk_csv(1))
    service.run_jobs()
    readings, p, q = walked(seed=3, n=100)
    way = {"position_m": p.tolist()} if known else {"displacement_m": (p - p[0]).tolist()}
    walk = {"floor_id": floor, "orientation": q.tolist()} | way
    answer = calibrate(service, device="x", method="map_aided", reference=None, walk=walk, b_ut=readings.tolist())
    assert answer.status_code == 422, answer.text
    assert "direction" in answer.text


def test_drift_and_equivalence(service: Any) -> None:
    made = [
        calibrate(service, device="drifting", b_ut=np.add(turned(seed=k), [0.5 * k, 0, 0]).tolist(),
                  measured_at=f"2026-03-{2 + 7 * k:02d}T12:00:00Z").json()
        for k in range(3)
    ]  # fmt: skip
    told = service.http.get("/v1/calibrations:drift", params={"device": "drifting"})
    assert told.status_code == 200, told.text
    drift = told.json()
    assert drift["calibration_ids"] == [each["id"] for each in made]
    rate = next(value for name, value in drift["rate_per_day"].items() if "x" in name and "ut" in name)
    assert rate == pytest.approx(0.5 / 7.0, rel=0.15)
    assert drift["drifting"]
    assert drift["p_same"] < 0.01
    same = calibrate(service, device="steady").json()
    again = calibrate(service, device="steady too", b_ut=turned(seed=5)).json()
    path = "/v1/calibrations:compare"
    alike = service.http.get(path, params={"first_id": same["id"], "second_id": again["id"]}).json()
    assert (alike["verdict"], alike["worst_ut"] < 0.2) == ("equivalent", True)
    unlike = service.http.get(
        path, params={"first_id": same["id"], "second_id": made[2]["id"], "tolerance_ut": 0.5}
    ).json()  # fmt: skip
    assert unlike["verdict"] == "different"
    assert unlike["worst_ut"] == pytest.approx(1.0, abs=0.25)
    for asked, status in (({"device": "steady"}, 422), ({"device": "nobody"}, 404)):
        assert service.http.get("/v1/calibrations:drift", params=asked).status_code == status
    assert service.http.get(path, params={"first_id": same["id"], "second_id": "nope"}).status_code == 404
