"""Every change writes a row that says who, what, when and from where, in its transaction; and nothing else does."""

import json
import re
from collections.abc import Callable
from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import select

from app.db.tables import Audit, utc_now
from app.services.audit_log import prune
from tests.api.calls import BODIES, picture, routes

CHANGES_NOTHING = {
    *(f"POST /v1/{of}/locate{batch}" for of in ("buildings/{building_id}", "floors/{floor_id}")
      for batch in ("", ":batch")),
    "POST /v1/floors/{floor_id}/replay", "POST /v1/tracks/{track_id}/replay", "POST /v1/maps/{map_id}/field",
    "POST /v1/attitudes",
    "POST /v1/tracks/{track_id}/steps",  # each batch is a row of the track already, and the track's maker is here
}  # fmt: skip


def changes(walk: bytes) -> list[tuple[str, str, dict[str, Any]]]:
    """Every call that changes something, in an order in which it can; the action it is; and the request."""
    of_track = {"floor_ids": ["{floor_id}"], "frame": "norm"}
    readings = {"reference": {"magnitude_ut": 50.0}, "method": "ellipsoid"}
    return [
        ("POST /v1/buildings", "building.create", {"json": {"name": "Tower"}}),
        ("PATCH /v1/buildings/{building_id}", "building.change", {"json": {"name": "Tall tower"}}),
        ("POST /v1/buildings/{building_id}/floors", "floor.create", {"json": {"name": "Top", "ordinal": 9}}),
        ("PATCH /v1/floors/{floor_id}", "floor.change", {"json": {"height_m": 3.0}}),
        ("PUT /v1/floors/{floor_id}/outline", "floor.change", {"json": BODIES["/v1/floors/{floor_id}/outline"]}),
        ("POST /v1/buildings/{building_id}/floors:import", "building.import", {"json": {
            "type": "FeatureCollection", "features": [{"type": "Feature", "feature_type": "level",
            "properties": {"ordinal": 3}, "geometry": BODIES["/v1/floors/{floor_id}/outline"]}]}}),
        ("PUT /v1/floors/{floor_id}/plan", "floor.change", {"params": {"metres_per_pixel": 1}, "content": picture()}),
        ("DELETE /v1/floors/{floor_id}/plan", "floor.change", {}),
        ("POST /v1/floors/{floor_id}/surveys", "survey.upload", {"content": walk}),
        ("PATCH /v1/surveys/{survey_id}", "survey.change", {"json": {"excluded_s": [[0, 1]]}}),
        ("POST /v1/floors/{floor_id}/maps", "map.build", {"json": {"activate": False}}),
        ("DELETE /v1/jobs/{job_id}", "job.cancel", {}),
        ("POST /v1/maps/{map_id}/activate", "map.activate", {}),
        ("POST /v1/tracks", "track.create", {"json": of_track}),
        ("POST /v1/tracks/{track_id}/end", "track.end", {}),
        ("DELETE /v1/tracks/{track_id}", "track.delete", {}),
        ("DELETE /v1/surveys/{survey_id}", "survey.delete", {}),
        ("POST /v1/calibrations", "calibration.create", {"json": {"device": "ball", **readings, "b_ut": _ball()}}),
        ("POST /v1/keys", "key.create", {"json": {"name": "k", "scopes": ["locate"]}}),
        ("POST /v1/keys/{key_id}:rotate", "key.rotate", {}),
        ("DELETE /v1/keys/{key_id}", "key.revoke", {}),
    ]  # fmt: skip


def _ball() -> list[list[float]]:
    import numpy as np

    v = np.random.default_rng(0).normal(size=(100, 3))
    return np.round(50.0 * v / np.linalg.norm(v, axis=1, keepdims=True), 3).tolist()  # type: ignore[no-any-return]


def test_every_call_that_changes_something_is_known(service: Any) -> None:
    """Whoever adds one says here what its row in the log is, or that it changes nothing."""
    writing = {f"{method} {path}" for method, path in routes(service.app) if method != "GET"}
    assert writing == CHANGES_NOTHING | {operation for operation, _, _ in changes(b"")}


def test_every_change_is_in_the_log(service: Any, walk_csv: Callable[..., bytes]) -> None:
    ids: dict[str, str] = {}
    seen: set[str] = set()
    for operation, action, request in changes(walk_csv(3)):
        method, path = operation.split()
        if "json" in request:
            request = {"json": json.loads(_filled(json.dumps(request["json"]), ids))}
        if action == "map.activate":
            service.run_jobs()
            ids["map_id"] = service.http.get(f"/v1/floors/{ids['floor_id']}").json()["active_map_id"]
        answer = service.http.request(method, _filled(path, ids), **request)
        assert answer.status_code < 300, f"{operation}: {answer.status_code} {answer.text}"
        told = answer.json() if answer.content else {}
        for kind in ("survey", "map", "job"):
            if kind in told:
                ids[f"{kind}_id"] = told[kind]["id"] if told[kind] else ids[f"{kind}_id"]
        known = set(ids.values())
        if "id" in told:
            ids[f"{action.partition('.')[0]}_id"] = told["id"]
        rows = [row for row in service.http.get("/v1/audit?limit=200").json()["items"] if row["id"] not in seen]
        seen |= {row["id"] for row in rows}
        (row,) = [row for row in rows if row["action"] == action]
        assert row["actor"] == "admin (settings)"
        assert row["key_id"]
        assert row["address"] == "testclient"
        assert row["object_id"] in known.union(ids.values())
        assert "isd_" not in json.dumps(rows), "never a secret"


def _filled(told: str, ids: dict[str, str]) -> str:
    return re.sub(r"{(\w+_id)}", lambda part: ids[part[1]], told)


def test_nothing_is_logged_of_what_was_not_done(
    service: Any, building: str, stranger: dict[str, str], key_with: Callable[..., dict[str, str]]
) -> None:
    reading = key_with("map:read")

    def rows() -> int:
        return service.row_counts()["audit"]  # type: ignore[no-any-return]

    before = rows()
    refused = [
        service.http.post("/v1/buildings", json={"name": ""}),
        service.http.post("/v1/buildings", json={"name": "x"}, headers=reading),
        service.http.post("/v1/buildings", json={"name": "x"}, headers={"Authorization": "Bearer isd_x"}),
        service.http.patch(f"/v1/buildings/{building}", json={"name": "x"}, headers=stranger),
    ]
    assert [answer.status_code for answer in refused] == [422, 403, 401, 404]
    key = {"Idempotency-Key": "once-in-the-log"}
    assert rows() == before
    for _ in range(2):
        assert service.http.post("/v1/buildings", json={"name": "Twice"}, headers=key).status_code == 201
    assert rows() == before + 1
    text = service.http.get("/metrics").text
    assert re.search(r'isodyn_http_requests_total{method="POST",route="/v1/buildings",status="403"} [1-9]', text)


def test_the_log_is_filtered_and_paged(service: Any, building: str) -> None:
    for k in range(5):
        service.http.patch(f"/v1/buildings/{building}", json={"name": f"House {k}"})
    url, seen = f"/v1/audit?object={building}&action=building.change&limit=2", []
    while url:
        page = service.http.get(url).json()
        seen += page["items"]
        url = page["links"].get("next")
    assert len(seen) >= 5
    assert seen == sorted(seen, key=lambda row: row["id"])
    assert {row["object_id"] for row in seen} == {building}
    assert seen[-1]["details"] == {"fields": ["name"]}
    after = service.http.get("/v1/audit", params={"since": seen[-1]["at"], "object": building}).json()["items"]
    assert [row["id"] for row in after] == [seen[-1]["id"]]
    mine = service.http.get("/v1/audit", params={"actor": seen[0]["key_id"], "limit": 1}).json()["items"]
    assert mine[0]["key_id"] == seen[0]["key_id"]
    assert service.http.get("/v1/audit", params={"actor": "nobody"}).json()["items"] == []
    assert service.http.get("/v1/audit", params={"since": "yesterday"}).status_code == 422


def test_a_change_that_fails_leaves_no_row(service: Any, building: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The row and the change are one transaction."""
    from app.api import buildings

    def fail(row: Any) -> Any:
        raise RuntimeError("after the row was added")

    before = service.row_counts()["audit"]
    monkeypatch.setattr(buildings, "show_building", fail)
    assert service.http.patch(f"/v1/buildings/{building}", json={"name": "never"}).status_code == 500
    assert service.row_counts()["audit"] == before


def test_old_rows_are_pruned(service: Any, building: str) -> None:
    with service.context.transaction() as session:
        old = session.scalars(select(Audit).order_by(Audit.id)).first()
        old.at = utc_now() - timedelta(days=401)
        old_id = old.id
    before = service.row_counts()["audit"]
    with service.context.transaction() as session:
        assert prune(session, 400) == 1
    assert service.row_counts()["audit"] == before - 1
    with service.context.transaction() as session:
        assert session.get(Audit, old_id) is None
