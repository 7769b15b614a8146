"""Keys and scopes over every route there is; lists, repeated requests and problems. Isolation: `test_isolation`."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from fastapi.routing import APIRoute

from app.db.tables import Key, utc_now
from tests.api.calls import call, picture, routes

OPEN = {"/healthz", "/readyz"}
LOCATING = ("/locate", "/locate:batch", "/replay")
OF_DEVICES = ("/v1/tracks", "/v1/calibrations", "/v1/attitudes", "/v1/reference-field")


def test_the_same_objects_are_found_by_their_owner(service: Any, ids: dict[str, str]) -> None:
    """So that it is not for a wrong address that others find nothing."""
    service.http.put(f"/v1/floors/{ids['floor_id']}/plan", params={"metres_per_pixel": 1}, content=picture())
    for method, path in routes(service.app):
        if "{" in path and method == "GET":
            answer = call(service.http, method, path, ids, {})
            assert answer.status_code == 200, f"{path} answered {answer.status_code}: {answer.text[:200]}"


def test_every_route_but_health_needs_a_key(service: Any, ids: dict[str, str]) -> None:
    for method, path in routes(service.app):
        answer = call(service.http, method, path, ids, {"Authorization": "Bearer isd_unknown"})
        assert (answer.status_code == 200) if path in OPEN else (answer.status_code == 401), (method, path)
        if path not in OPEN:
            assert answer.headers["www-authenticate"] == "Bearer"


def test_a_key_does_only_what_its_scopes_say(
    service: Any, ids: dict[str, str], key_with: Callable[..., dict[str, str]]
) -> None:
    locating, reading = key_with("locate"), key_with("map:read")
    for method, path in routes(service.app):
        if path in OPEN:
            continue
        answer = call(service.http, method, path, ids, locating)
        may = path.endswith(LOCATING) or path.startswith(OF_DEVICES)
        assert (answer.status_code != 403) == may, (method, path, answer.text)
        if method != "GET" and not path.endswith(("/field", "/attitudes")):
            assert call(service.http, method, path, ids, reading).status_code == 403, (method, path)


def scope_table(app: Any) -> str:
    """Which scopes open which call, as docs/keys.md shows it; by what the application itself checks."""
    rows = []
    for route in sorted((each for each in _served(app) if each.include_in_schema), key=lambda each: each.path):
        needs = [each.call for each in route.dependant.dependencies if hasattr(each.call, "any_of")]
        scopes = " or ".join(f"`{scope}`" for scope in needs[0].any_of) if needs else "none: no key is needed"
        limited = "no" if needs and needs[0].unlimited else "" if needs else "yes"
        if route.path == "/metrics":
            scopes, limited = "`admin` of the organisation `default`, or the key of `ISODYN_METRICS_KEY`", "no"
        rows += [f"| `{method} {route.path}` | {scopes} | {limited} |" for method in sorted(route.methods)]
    return "\n".join(rows)


def test_the_guide_says_which_scope_opens_what(service: Any) -> None:
    table = scope_table(service.app)
    assert table in (Path(__file__).parents[2] / "docs/keys.md").read_text(), f"put this there:\n{table}"


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
    described = {path for _, path in routes(service.app)}
    served = {route.path for route in _served(service.app) if route.include_in_schema}
    assert served == described


def _served(app: Any) -> list[Any]:
    """Every endpoint; FastAPI keeps those of an included router with that router."""
    every = [*app.routes, *(each for route in app.routes if hasattr(route, "original_router")
                            for each in route.original_router.routes)]  # fmt: skip
    return [route for route in every if isinstance(route, APIRoute)]


def test_whoever_is_not_recognised_is_told_the_same(service: Any, key_with: Callable[..., dict[str, str]]) -> None:
    """A key that never was, one that was revoked and one that has expired cannot be told apart."""
    told = set()
    revoked, expired = key_with("map:read", name="revoked"), key_with("map:read", name="expired")
    with service.context.transaction() as session:
        session.query(Key).filter_by(name="revoked").one().revoked_at = utc_now()
        session.query(Key).filter_by(name="expired").one().expires_at = utc_now()
    for headers in (revoked, expired, {"Authorization": "Bearer isd_guess"}, {"Authorization": "Bearer eyJ.e30.x"}):
        answer = service.http.get("/v1/buildings", headers=headers)
        assert answer.status_code == 401
        said = {name: value for name, value in answer.json().items() if name != "request_id"}
        told.add((str(said), answer.headers["www-authenticate"]))
    assert len(told) == 1
