"""What every answer tells a browser, on every route; who has a document already is told so."""

from pathlib import Path
from typing import Any

import pytest
from fastapi.routing import APIRoute
from starlette.testclient import TestClient

from app.main import create_app, first_start
from app.settings import Settings

ALWAYS = ("X-Content-Type-Options", "X-Frame-Options", "Referrer-Policy", "Content-Security-Policy",
          "Cross-Origin-Opener-Policy", "Cross-Origin-Resource-Policy", "Permissions-Policy")  # fmt: skip
UNTAGGED = {
    "/healthz": "changes without a trace, and is tiny",
    "/readyz": "the same",
    "/metrics": "the same",
    "/v1/jobs/{job_id}/events": "a stream",
    "/v1/tracks/{track_id}/steps": "a stream",
    "/docs/{name}": "tested with the page",
}


def get_routes(service: Any) -> list[str]:
    routes = _all_routes(service.app)
    return sorted({route.path for route in routes if isinstance(route, APIRoute) and "GET" in route.methods})


def _all_routes(app: Any) -> list[Any]:
    found, todo = [], list(app.routes)
    while todo:
        route = todo.pop()
        found.append(route)
        inner = getattr(route, "original_router", None) or getattr(route, "router", None)
        todo += list(getattr(inner, "routes", ()))
    return found


@pytest.fixture(scope="module")
def ids(service: Any, building: str, mapped_floor: str, active_map: str) -> dict[str, str]:
    survey = service.http.get(f"/v1/floors/{mapped_floor}/surveys").json()["items"][0]["id"]
    job = service.http.get("/v1/jobs").json()["items"][0]["id"]
    track = service.http.post("/v1/tracks", json={"building_id": building, "frame": "level"}).json()["id"]
    return {"building_id": building, "floor_id": mapped_floor, "map_id": active_map, "survey_id": survey,
            "job_id": job, "track_id": track}  # fmt: skip


ASKED = {
    "/v1/reference-field": "?latitude_deg=48&longitude_deg=11",
    "/v1/maps/{map_id}/export": "?format=csv",
    "/v1/maps/{map_id}/heatmap.png": "?layer=sd",
}
"""Where a route needs to be told something."""


def test_every_document_has_a_tag_or_a_reason_for_none(service: Any, ids: dict[str, str]) -> None:
    untagged, seen = {}, 0
    for path in get_routes(service):
        if path in UNTAGGED or path in ("/", "/view"):
            continue
        url = path.format_map({**ids, "calibration_id": "x", "name": "x"}) + ASKED.get(path, "")
        answer = service.http.get(url)
        if answer.status_code in (404, 409, 422):  # nothing of the kind is there; tested where there is
            continue
        assert answer.status_code == 200, (url, answer.text)
        seen += 1
        if "ETag" not in answer.headers:
            untagged[path] = answer.headers
            continue
        again = service.http.get(url, headers={"If-None-Match": answer.headers["ETag"]})
        assert (again.status_code, again.content) == (304, b""), url
        same = ("ETag", "Cache-Control", "Vary", *ALWAYS)
        assert [again.headers.get(name) for name in same] == [answer.headers.get(name) for name in same], url
        assert answer.headers["Cache-Control"].startswith("private"), url
        assert service.http.get(url, headers={"If-None-Match": '"another"'}).content == answer.content, url
    assert not untagged
    assert seen > 20


def test_head_is_get_without_the_document(service: Any, ids: dict[str, str]) -> None:
    for url in (f"/v1/floors/{ids['floor_id']}", "/v1/jobs", f"/v1/maps/{ids['map_id']}/export?format=npz"):
        got, head = service.http.get(url), service.http.head(url)
        assert (head.status_code, head.content) == (200, b"")
        assert head.headers["Content-Length"] == str(len(got.content))
        assert head.headers["ETag"] == got.headers["ETag"]
    assert service.http.head("/v1/floors/none").status_code == 404


@pytest.mark.parametrize("url", ["/", "/healthz", "/v1/buildings", "/v1/none", "/docs", "/openapi.json", "/view/",
                                 "/view/assets/page.js", "/view/session"])  # fmt: skip
def test_every_answer_is_strict(service: Any, url: str) -> None:
    answer = service.http.get(url, follow_redirects=False)
    assert all(name in answer.headers for name in ALWAYS), answer.headers
    policy = answer.headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors" in policy or "frame-ancestors" in answer.headers["X-Frame-Options"].lower()
    assert "server" not in answer.headers
    assert "Access-Control-Allow-Origin" not in answer.headers
    if url.startswith("/v1/"):
        assert "Authorization" in answer.headers["Vary"]
        assert policy.startswith("default-src 'none'; frame-ancestors 'none'")


def test_a_map_as_a_page_may_run_its_own_scripts_and_load_nothing(service: Any, active_map: str) -> None:
    policy = service.http.get(f"/v1/maps/{active_map}/view.html").headers["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "http" not in policy


def test_a_lost_update_is_refused(service: Any, ids: dict[str, str]) -> None:
    for url, change in ((f"/v1/floors/{ids['floor_id']}", {"name": "First"}),
                        (f"/v1/surveys/{ids['survey_id']}", {"excluded_s": [[0.0, 0.5]]}),
                        (f"/v1/buildings/{ids['building_id']}", {"name": "First"})):  # fmt: skip
        seen = {"If-Match": service.http.get(url).headers["ETag"]}
        assert service.http.patch(url, json=change, headers=seen).status_code == 200
        late = service.http.patch(url, json=change, headers=seen)
        assert late.status_code == 412
        assert late.json()["type"].endswith("/changed")
        assert service.http.patch(url, json=change, headers={"If-Match": "*"}).status_code == 200
        assert service.http.patch(url, json=change).status_code == 200


def test_other_origins_and_tls_are_told_of_where_settings_say_so(tmp_path: Path) -> None:
    settings = Settings(
        data_dir=tmp_path, admin_key="isd_admin-of-origins", cors_origins="https://maps.example", hsts_s=600
    )
    first_start(settings)
    with TestClient(create_app(settings), base_url="https://testserver") as http:
        asked = {"Origin": "https://maps.example", "Access-Control-Request-Method": "PATCH",
                 "Access-Control-Request-Headers": "authorization,if-match"}  # fmt: skip
        allowed = http.options("/v1/buildings", headers=asked)
        assert allowed.status_code == 200
        assert allowed.headers["Access-Control-Allow-Origin"] == "https://maps.example"
        assert "Access-Control-Allow-Credentials" not in allowed.headers
        refused = http.options("/v1/buildings", headers={**asked, "Origin": "https://evil.example"})
        assert "Access-Control-Allow-Origin" not in refused.headers
        assert http.get("/healthz").headers["Strict-Transport-Security"] == "max-age=600"
