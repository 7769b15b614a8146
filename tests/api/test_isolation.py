"""Nobody sees or touches what is not theirs: every route, every reference in a query or a body, and every list; for
another organisation, and for a key of the same one that is limited to another building."""

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pytest
from starlette.testclient import WebSocketDenialResponse

from tests.api.calls import OUTLINE, WINDOW, call, routes

NAMES = ("House", "Cellar", "secret walk", "a lift", "phone", "spare")
OF_ALL = "/v1/calibrations"
"""Belong to the whole organisation: keys limited to buildings are refused whatever they name."""


@dataclass(frozen=True)
class Other:
    """Somebody who has a building, a floor with a map, a survey and a track of their own."""

    who: str
    headers: dict[str, str]
    building: str
    floor: str
    survey: str

    @property
    def is_limited(self) -> bool:
        return self.who == "limited"


@pytest.fixture(scope="module", params=["another organisation", "limited"])
def other(
    request: pytest.FixtureRequest, service: Any, ids: dict[str, str], stranger: dict[str, str],
    key_with: Callable[..., dict[str, str]], walk_csv: Callable[..., bytes],
) -> Other:  # fmt: skip
    limited = request.param == "limited"
    maker = {} if limited else stranger
    building = service.http.post("/v1/buildings", json={"name": "Barn"}, headers=maker).json()["id"]
    headers = key_with("admin", building_ids=[building]) if limited else stranger
    floor = service.http.post(
        f"/v1/buildings/{building}/floors", json={"name": "Loft", "ordinal": 0}, headers=headers
    ).json()["id"]
    sent = service.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(9), headers=headers).json()
    service.run_jobs()
    return Other(request.param, headers, building, floor, sent["survey"]["id"])


@pytest.fixture(scope="module", autouse=True)
def named(service: Any, ids: dict[str, str], walk_csv: Callable[..., bytes]) -> None:
    """What is not theirs has names that would be noticed."""
    service.http.patch(f"/v1/floors/{ids['floor_id']}", json={"name": "Cellar", "auto_build": False})
    service.http.post(
        f"/v1/floors/{ids['floor_id']}/surveys", params={"name": "secret walk"}, content=walk_csv(7)
    )  # fmt: skip


def says_nothing(answer: Any, ids: dict[str, str], asked: str) -> None:
    """The answer names nothing that was not in the request."""
    for told in (*NAMES, *ids.values()):
        assert told in asked or told not in answer.text, f"{asked} told {told}: {answer.text[:300]}"


def test_every_object_of_others_is_not_found(service: Any, ids: dict[str, str], other: Other) -> None:
    checked = 0
    for method, path in routes(service.app):
        if "{" not in path:
            continue
        answer = call(service.http, method, path, ids, other.headers)
        wanted = 403 if other.is_limited and path.startswith(OF_ALL) else 404
        assert answer.status_code == wanted, f"{method} {path} answered {answer.status_code}: {answer.text[:200]}"
        asked = re.sub(r"{(\w+)}", lambda name: ids[name[1]], path)
        says_nothing(answer, ids, asked)
        checked += 1
    assert checked >= 45, "the matrix covers the contract"


def test_lists_hold_nothing_of_others(service: Any, ids: dict[str, str], other: Other) -> None:
    lists = 0
    for method, path in routes(service.app):
        if method != "GET" or "{" in path or ":" in path:
            continue
        answer = service.http.get(path, headers=other.headers)
        if answer.status_code == 200 and isinstance(answer.json(), dict) and "items" in answer.json():
            assert service.http.get(path).json()["items"], path
            says_nothing(answer, ids, path)
            lists += 1
    assert lists == (4 if other.is_limited else 6)  # neither calibrations nor the log for a limited key
    mine = service.http.get("/v1/buildings", headers=other.headers).json()["items"]
    assert [each["id"] for each in mine] == [other.building]


def references(app: Any) -> set[tuple[str, str]]:
    """Every parameter and member of a body that may hold an object's id: its operation and its name."""
    schema = app.openapi()
    found = set()
    for path, item in schema["paths"].items():
        for method, operation in item.items():
            names = {each["name"] for each in operation.get("parameters", ()) if each["in"] == "query"}
            for content in operation.get("requestBody", {}).get("content", {}).values():
                names |= _members(schema, content.get("schema", {}))
            found |= {(f"{method.upper()} {path}", name) for name in names if _refers(name)}
    return found


def _refers(name: str) -> bool:
    return name.endswith(("_id", "_ids")) or name in ("replaces", "object", "actor")


def _members(schema: Any, part: Any, seen: frozenset[str] = frozenset()) -> set[str]:
    """Names of members, at any depth."""
    if isinstance(part, list):
        return set().union(*(_members(schema, each, seen) for each in part)) if part else set()
    if not isinstance(part, dict):
        return set()
    names = set(part["properties"]) if isinstance(part.get("properties"), dict) else set()
    name = str(part.get("$ref", "")).rpartition("/")[2]
    if name and name not in seen:
        names |= _members(schema, schema["components"]["schemas"][name], seen | {name})
    return names | set().union(*(_members(schema, each, seen) for key, each in part.items() if key != "examples"))


def cases(ids: dict[str, str], other: Other) -> dict[tuple[str, str], tuple[dict[str, Any], int | None]]:
    """A request of one's own with somebody else's id for each reference; and the status, None for an empty list."""
    track = {"floor_ids": [other.floor], "frame": "norm"}
    attitude = {"t_s": [0.0, 0.1], "gyro_rad_per_s": [[0, 0, 0]] * 2, "accelerometer_m_per_s2": [[0, 0, 9.8]] * 2}
    turned = {"device": "x", "b_ut": [[50.0, 0, 0], [0, 50.0, 0]]}
    walk = {"orientation": [[1, 0, 0, 0]] * 2, "displacement_m": [[0, 0, 0], [1, 0, 0]]}
    located = {"floor_ids": [ids["floor_id"]]}
    somewhere = [[1, 1, 1]] * 2
    read = {"magnetometer_ut": [[50.0, 0, 0]] * 2}
    calibration, floor, building = ids["calibration_id"], ids["floor_id"], ids["building_id"]
    # Limited keys may name calibrations of their organisation, and do nothing else with them (docs/keys.md).
    named, of_all = (200, 403) if other.is_limited else (404, 404)
    return {
        ("POST /v1/tracks", "building_id"): ({"json": {"building_id": building, "frame": "norm"}}, 404),
        ("POST /v1/tracks", "floor_ids"): ({"json": track | {"floor_ids": [floor]}}, 404),
        ("POST /v1/tracks", "calibration_id"): (
            {"json": track | {"frame": "body", "calibration_id": calibration}}, 201 if other.is_limited else 404
        ),
        ("GET /v1/tracks", "building_id"): ({"params": {"building_id": building}}, None),
        ("GET /v1/jobs", "floor_id"): ({"params": {"floor_id": floor}}, None),
        ("GET /v1/audit", "object"): ({"params": {"object": building}}, 403 if other.is_limited else None),
        ("GET /v1/audit", "actor"): ({"params": {"actor": ids["key_id"]}}, 403 if other.is_limited else None),
        ("POST /v1/keys", "building_ids"): (
            {"json": {"name": "x", "scopes": ["locate"], "building_ids": [building]}}, 403 if other.is_limited else 404
        ),
        ("POST /v1/buildings/{building_id}/locate", "floor_ids"): ({"json": WINDOW | located}, 404),
        ("POST /v1/buildings/{building_id}/locate:batch", "floor_ids"): (
            {"json": {"queries": [WINDOW | located]}}, 404
        ),
        ("POST /v1/floors/{floor_id}/locate", "floor_ids"): ({"json": WINDOW | located}, 422),
        ("POST /v1/floors/{floor_id}/locate:batch", "floor_ids"): ({"json": {"queries": [WINDOW | located]}}, 422),
        **{
            (f"POST /v1/{where}/locate{batch}", "calibration_id"): (
                {"json": {"queries": [body]} if batch else body}, named
            )
            for where in ("buildings/{building_id}", "floors/{floor_id}")
            for batch in ("", ":batch")
            for body in ({"window": {"frame": "body", "b_ut": [[20.0, 0, -40.0]], "displacement_m": [[0, 0, 0]],
                                     "orientation": [[1, 0, 0, 0]], "calibration_id": calibration}},)
        },
        ("POST /v1/floors/{floor_id}/maps", "survey_ids"): ({"json": {"survey_ids": [ids["survey_id"]]}}, 422),
        ("POST /v1/floors/{floor_id}/surveys", "replaces"): (
            {"params": {"replaces": ids["survey_id"]}, "content": b"t_s\n"}, 404
        ),
        ("POST /v1/floors/{floor_id}/surveys", "calibration_id"): (
            {"params": {"calibration_id": calibration}, "content": b"t_s\n"}, 422 if other.is_limited else 404
        ),
        ("POST /v1/floors/{floor_id}/replay", "calibration_id"): (
            {"params": {"calibration_id": calibration}, "content": b"t_s\n"}, 422 if other.is_limited else 404
        ),
        ("GET /v1/surveys/{survey_id}/consistency", "map_id"): ({"params": {"map_id": ids["map_id"]}}, 404),
        ("GET /v1/reference-field", "building_id"): ({"params": {"building_id": building}}, 404),
        ("POST /v1/attitudes", "building_id"): (
            {"json": attitude | read | {"reference": {"kind": "wmm", "building_id": building}}}, 404
        ),
        ("POST /v1/attitudes", "floor_id"): (
            {"json": attitude | read | {"reference": {"kind": "map", "floor_id": floor, "position_m": somewhere}}},
            404,
        ),
        ("POST /v1/attitudes", "calibration_id"): (
            {"json": attitude | read | {"reference": {"kind": "learned"}, "calibration_id": calibration}}, named
        ),
        ("POST /v1/calibrations", "building_id"): (
            {"json": turned | {"reference": {"building_id": building}}}, of_all
        ),
        ("POST /v1/calibrations", "floor_id"): (
            {"json": turned | {"method": "map_aided", "walk": walk | {"floor_id": floor}}}, of_all
        ),
        ("GET /v1/calibrations:compare", "first_id"): (
            {"params": {"first_id": calibration, "second_id": calibration}}, of_all
        ),
        ("GET /v1/calibrations:compare", "second_id"): (
            {"params": {"first_id": calibration, "second_id": calibration}}, of_all
        ),
    }  # fmt: skip


def test_no_reference_reaches_what_is_not_theirs(service: Any, ids: dict[str, str], other: Other) -> None:
    own = {"building_id": other.building, "floor_id": other.floor, "survey_id": other.survey}
    for (operation, name), (request, status) in cases(ids, other).items():
        method, path = operation.split()
        url = re.sub(r"{(\w+)}", lambda part: own[part[1]], path)
        answer = service.http.request(method, url, headers=other.headers, **request)
        assert answer.status_code == (status or 200), f"{operation} {name}: {answer.status_code} {answer.text[:300]}"
        if status is None:
            assert answer.json()["items"] == [], operation
        says_nothing(answer, ids, f"{url} {request} phone")  # what a calibration is of is told with it


def test_every_reference_there_is_has_a_case(service: Any, ids: dict[str, str], other: Other) -> None:
    assert references(service.app) == set(cases(ids, other))


def test_a_repeated_request_is_not_answered_to_others(service: Any, ids: dict[str, str], other: Other) -> None:
    url, body = f"/v1/buildings/{ids['building_id']}/floors", {"name": "Vault", "ordinal": 7}
    key = {"Idempotency-Key": f"vault-{other.is_limited}"}
    assert service.http.post(url, json=body, headers=key).status_code == 201
    assert service.http.post(url, json=body, headers=key).headers["idempotent-replayed"] == "true"
    answer = service.http.post(url, json=body, headers=key | other.headers)
    assert answer.status_code == 404
    assert "Vault" not in answer.text
    again = service.http.post(f"/v1/buildings/{other.building}/floors", json=body, headers=key | other.headers)
    assert again.status_code == 201, "their own keys are their own"


def test_a_known_etag_opens_nothing(service: Any, ids: dict[str, str], other: Other) -> None:
    for url in (f"/v1/floors/{ids['floor_id']}", f"/v1/maps/{ids['map_id']}/quality"):
        tag = {"If-None-Match": service.http.get(url).headers["etag"]}
        assert service.http.get(url, headers=tag).status_code == 304
        assert service.http.get(url, headers=tag | other.headers).status_code == 404


def test_a_track_of_others_has_no_stream(service: Any, ids: dict[str, str], other: Other) -> None:
    service.http.post(f"/v1/tracks/{ids['track_id']}/steps", json={"steps": []})  # it is in memory
    with (
        pytest.raises(WebSocketDenialResponse) as refused,
        service.http.websocket_connect(f"/v1/tracks/{ids['track_id']}/stream", headers=dict(other.headers)),
    ):
        pass
    assert refused.value.status_code == 404
    assert "a lift" not in refused.value.text


def test_metrics_are_for_the_operator(
    service: Any, other: Other, key_with: Callable[..., dict[str, str]], ids: dict[str, str]
) -> None:
    assert service.http.get("/metrics").status_code == 200
    assert service.http.get("/metrics", headers=key_with("map:write")).status_code == 403
    refused = service.http.get("/metrics", headers=other.headers)
    assert refused.status_code == 403
    says_nothing(refused, ids, "/metrics")


def test_the_page_shows_nothing_of_others(service: Any, ids: dict[str, str], other: Other) -> None:
    http = service.http
    key = other.headers["Authorization"].removeprefix("Bearer ")
    here = {"Origin": "http://testserver", "Authorization": ""}
    signed = http.post("/view/session", data={"key": key}, headers=here, follow_redirects=False)
    assert signed.status_code == 303
    here["Cookie"] = f"isodyn_view={signed.cookies['isodyn_view']}"
    http.cookies.clear()
    shown = http.get("/view/content", headers=here)
    assert [each["name"] for each in shown.json()["buildings"]] == ["Barn"]
    says_nothing(shown, ids, "")
    for asked in ({"building": ids["building_id"]}, {"floor": ids["floor_id"]}, {"map": ids["map_id"]}):
        poster = http.get("/view/poster.png", params=asked, headers=here)
        assert poster.status_code in (200, 204)
        assert poster.content == http.get("/view/poster.png", headers=here).content or poster.status_code == 204
    for path in (f"/v1/floors/{ids['floor_id']}", f"/v1/maps/{ids['map_id']}/heatmap.png"):
        answer = http.get(f"/view{path}", headers=here)
        assert answer.status_code == 404
        says_nothing(answer, ids, path)
    outline = f"/view/v1/floors/{ids['floor_id']}/outline"
    assert http.put(outline, json=OUTLINE, headers=here).status_code == 404
