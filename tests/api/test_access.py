"""Keys, scopes, and that an organisation sees nothing of another: a matrix over every route there is."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.routing import APIRoute

OPEN = {"/healthz", "/readyz"}
LOCATING = ("/locate", "/locate:batch", "/replay")
OF_DEVICES = ("/v1/tracks", "/v1/calibrations", "/v1/attitudes", "/v1/reference-field")
OUTLINE = {"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, 5], [0, 5], [0, 0]]]}
BODIES: dict[str, Any] = {
    "/v1/buildings/{building_id}/floors": {"name": "x", "ordinal": 1},
    "/v1/floors/{floor_id}/maps": {},
    "/v1/maps/{map_id}/field": {"points_m": [[0, 0, 0]]},
    "/v1/surveys/{survey_id}": {"included": True},
    "/v1/floors/{floor_id}/outline": OUTLINE,
    "/v1/buildings/{building_id}/floors:import": {"type": "FeatureCollection", "features": []},
    "/v1/buildings/{building_id}": {},
    "/v1/floors/{floor_id}": {},
    "/v1/tracks/{track_id}/steps": {"steps": [{"number": 0, "t_s": 0.0}]},
    "/v1/calibrations": {"device": "x", "reference": {"magnitude_ut": 50.0}, "b_ut": [[50.0, 0.0, 0.0]] * 2},
    "/v1/attitudes": {
        "t_s": [0.0, 0.1],
        "gyro_rad_per_s": [[0, 0, 0]] * 2,
        "accelerometer_m_per_s2": [[0, 0, 9.8]] * 2,
        "reference": {"kind": "none"},
    },
}
WINDOW = {"window": {"frame": "norm", "b_ut": [50.0], "displacement_m": [[0, 0, 0]]}}
QUERIES = {
    "/v1/maps/{map_id}/export": {"format": "csv"},
    "/v1/floors/{floor_id}/plan": {"metres_per_pixel": "0.1"},
}


def _routes(app: Any) -> list[tuple[str, str]]:
    schema = app.openapi()
    return sorted((method.upper(), path) for path, item in schema["paths"].items() for method in item)


@pytest.fixture(scope="module")
def ids(service: Any, building: str, mapped_floor: str, active_map: str) -> dict[str, str]:
    survey = service.http.get(f"/v1/floors/{mapped_floor}/surveys").json()["items"][0]["id"]
    job = service.http.get("/v1/jobs", params={"floor_id": mapped_floor}).json()["items"][0]["id"]
    track = service.http.post("/v1/tracks", json={"floor_ids": [mapped_floor], "frame": "norm"}).json()["id"]
    readings = [[50.0 * float(c) for c in row] for row in _sphere(200)]
    calibration = service.http.post(
        "/v1/calibrations",
        json={"device": "phone", "method": "ellipsoid", "reference": {"magnitude_ut": 50.0}, "b_ut": readings},
    ).json()["id"]
    return {
        "calibration_id": calibration,
        "track_id": track,
        "building_id": building,
        "floor_id": mapped_floor,
        "map_id": active_map,
        "survey_id": survey,
        "job_id": job,
    }


def _sphere(n: int) -> np.ndarray:
    """Directions all over the sphere, not quite of one length."""
    rng = np.random.default_rng(0)
    v = rng.normal(size=(n, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True) + rng.normal(0, 0.001, (n, 3))


def _call(http: Any, method: str, path: str, ids: dict[str, str], headers: dict[str, str]) -> Any:
    url = re.sub(r"{(\w+)}", lambda name: ids[name[1]], path)
    arguments: dict[str, Any] = {"headers": headers, "params": QUERIES.get(path)}
    if path.endswith(("/surveys", "floor_id}/replay")) and method == "POST":
        arguments["content"] = b"t_s\n"
    elif method in ("POST", "PATCH", "PUT"):
        body = {"queries": [WINDOW]} if path.endswith(":batch") else WINDOW if path.endswith("locate") else None
        arguments["json"] = BODIES.get(path, body)
    return http.request(method, url, **arguments)


def test_every_object_of_another_organisation_is_not_found(
    service: Any, ids: dict[str, str], stranger: dict[str, str]
) -> None:
    checked = 0
    for method, path in _routes(service.app):
        if "{" not in path:
            continue
        answer = _call(service.http, method, path, ids, stranger)
        assert answer.status_code == 404, f"{method} {path} answered {answer.status_code}: {answer.text[:200]}"
        assert not any(value in answer.text.replace(answer.request.url.path, "") for value in ()), path
        checked += 1
    assert checked >= 25, "the matrix covers the contract"


def test_lists_of_another_organisation_are_empty(service: Any, ids: dict[str, str], stranger: dict[str, str]) -> None:
    for path in ("/v1/buildings", "/v1/jobs", "/v1/tracks", "/v1/calibrations"):
        assert service.http.get(path).json()["items"]
        assert service.http.get(path, headers=stranger).json()["items"] == []


def test_every_route_but_health_needs_a_key(service: Any, ids: dict[str, str]) -> None:
    for method, path in _routes(service.app):
        answer = _call(service.http, method, path, ids, {"Authorization": "Bearer isd_unknown"})
        assert (answer.status_code == 200) if path in OPEN else (answer.status_code == 401), (method, path)
        if path not in OPEN:
            assert answer.headers["www-authenticate"] == "Bearer"


def test_a_key_does_only_what_its_scopes_say(
    service: Any, ids: dict[str, str], key_with: Callable[..., dict[str, str]]
) -> None:
    locating, reading = key_with("locate"), key_with("map:read")
    for method, path in _routes(service.app):
        if path in OPEN:
            continue
        answer = _call(service.http, method, path, ids, locating)
        may = path.endswith(LOCATING) or path.startswith(OF_DEVICES)
        assert (answer.status_code != 403) == may, (method, path, answer.text)
        if method != "GET" and not path.endswith(("/field", "/attitudes")):
            assert _call(service.http, method, path, ids, reading).status_code == 403, (method, path)


def test_lists_are_paged_by_an_opaque_cursor(service: Any, key_with: Callable[..., dict[str, str]]) -> None:
    made = [service.http.post("/v1/buildings", json={"name": f"B{k}"}).json()["id"] for k in range(5)]
    seen, url = [], "/v1/buildings?limit=2"
    while url:
        page = service.http.get(url).json()
        assert len(page["items"]) <= 2
        seen += [item["id"] for item in page["items"]]
        url = page["links"].get("next")
    assert len(seen) == len(set(seen))
    assert [each for each in seen if each in made] == made
    backwards, url = [], "/v1/buildings?limit=2&order=newest"
    while url:
        page = service.http.get(url).json()
        backwards += [item["id"] for item in page["items"]]
        url = page["links"].get("next")
    assert backwards == seen[::-1]
    assert service.http.get("/v1/buildings", params={"cursor": "'; drop"}).status_code == 422


def test_a_repeated_request_creates_once(service: Any) -> None:
    headers, body = {"Idempotency-Key": "one"}, {"name": "Once"}
    first = service.http.post("/v1/buildings", json=body, headers=headers)
    again = service.http.post("/v1/buildings", json=body, headers=headers)
    assert first.json() == again.json()
    assert again.headers["idempotent-replayed"] == "true"
    other = service.http.post("/v1/buildings", json={"name": "Twice"}, headers=headers)
    assert other.status_code == 409


def test_problems_are_problem_documents(service: Any) -> None:
    for answer, status in (
        (service.http.get("/v1/nothing"), 404),
        (service.http.put("/v1/buildings"), 405),
        (service.http.post("/v1/buildings", json={"name": ""}), 422),
        (service.http.post("/v1/buildings", content=b"{", headers={"Content-Type": "application/json"}), 422),
        (service.http.get("/v1/jobs/" + "x" * 65), 422),
    ):
        assert answer.status_code == status
        assert answer.headers["content-type"] == "application/problem+json"
        problem = answer.json()
        assert problem["status"] == status
        assert problem["type"].startswith("https://")
        assert problem["detail"]


def test_metrics_count_by_route_never_by_id(service: Any, ids: dict[str, str]) -> None:
    service.http.get(f"/v1/floors/{ids['floor_id']}")
    text = service.http.get("/metrics").text
    assert 'route="/v1/floors/{floor_id}"' in text
    assert ids["floor_id"] not in text


def test_a_waiting_job_can_be_cancelled_and_events_end(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes]
) -> None:
    floor = new_floor()
    job = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(1)).json()["job"]
    cancelled = service.http.delete(f"/v1/jobs/{job['id']}").json()
    assert cancelled["status"] == "dismissed"
    events = service.http.get(f"/v1/jobs/{job['id']}/events")
    assert events.headers["content-type"].startswith("text/event-stream")
    assert '"dismissed"' in events.text
    later = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(2)).json()["job"]
    assert later["id"] != job["id"]
    service.run_jobs()


@pytest.mark.parametrize("path", ["/", "/view"])
def test_the_front_door_leads_to_the_page(service: Any, path: str) -> None:
    answer = service.http.get(path, follow_redirects=True, headers={"Accept": "text/html"})
    assert answer.status_code == 200
    assert "key" in answer.text.lower()


def test_all_routes_are_described(service: Any) -> None:
    described = {path for _, path in _routes(service.app)}
    served = {route.path for route in service.app.routes if isinstance(route, APIRoute) and route.include_in_schema}
    assert served <= described
