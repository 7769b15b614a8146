"""Keys over HTTP: made, limited, rotated and revoked by an admin of their organisation."""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import event

from app.api import auth
from app.db.tables import Key
from app.services import key_ring


def headers_of(secret: str) -> dict[str, str]:
    return {"Authorization": f"Bearer {secret}"}


def make(service: Any, **more: Any) -> dict[str, Any]:
    answer = service.http.post("/v1/keys", json={"name": "robot", "scopes": ["map:read"]} | more)
    assert answer.status_code == 201, answer.text
    made: dict[str, Any] = answer.json()
    return made


@pytest.fixture(scope="module", autouse=True)
def soon(request: pytest.FixtureRequest) -> Any:
    """A shorter memory, so that tests wait less; `tests/services/test_manage_keys.py` shows that it is the bound."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(key_ring, "RECENT_S", 0.1)
        yield


def ends(service: Any, headers: dict[str, str]) -> None:
    """Wait until the key is refused."""
    until = time.monotonic() + 20
    while service.http.get("/v1/buildings", headers=headers).status_code != 401:
        assert time.monotonic() < until
        time.sleep(0.02)


def test_a_key_is_shown_once_and_kept_as_a_hash(service: Any) -> None:
    made = make(service, scopes=["map:read", "locate"])
    assert made["secret"].startswith("isd_")
    assert made["scopes"] == ["locate", "map:read"]
    assert service.http.get("/v1/buildings", headers=headers_of(made["secret"])).status_code == 200
    listed = service.http.get("/v1/keys").text
    assert made["id"] in listed
    assert made["secret"] not in listed
    assert "sha256" not in listed
    repeated = {"Idempotency-Key": "again"}
    first, second = (
        service.http.post("/v1/keys", json={"name": "x", "scopes": ["locate"]}, headers=repeated) for _ in range(2)
    )
    assert first.json()["id"] != second.json()["id"], "an answer that could be given again would have to be kept"


def test_a_key_ends_at_its_time(service: Any) -> None:
    soon = (datetime.now(UTC) + timedelta(seconds=1.0)).isoformat()
    headers = headers_of(make(service, expires_at=soon)["secret"])
    assert service.http.get("/v1/buildings", headers=headers).status_code == 200
    ends(service, headers)
    passed = {"name": "x", "scopes": ["locate"], "expires_at": "2020-01-01T00:00:00Z"}
    refused = service.http.post("/v1/keys", json=passed)
    assert refused.status_code == 422
    assert "has passed" in refused.json()["detail"]


def test_a_rotated_key_goes_on_for_the_overlap(service: Any) -> None:
    made = make(service, scopes=["map:read"])
    answer = service.http.post(f"/v1/keys/{made['id']}:rotate", json={"overlap_s": 1.0})
    assert answer.status_code == 201
    new = answer.json()
    assert (new["name"], new["scopes"], new["building_ids"]) == (made["name"], made["scopes"], None)
    for secret in (made["secret"], new["secret"]):
        assert service.http.get("/v1/buildings", headers=headers_of(secret)).status_code == 200
    ends(service, headers_of(made["secret"]))
    assert service.http.get("/v1/buildings", headers=headers_of(new["secret"])).status_code == 200
    assert service.http.post(f"/v1/keys/{made['id']}:rotate").status_code == 409, "it has ended"


def test_a_key_that_ends_keeps_its_span_when_it_is_rotated(service: Any) -> None:
    made = make(service, expires_at=(datetime.now(UTC) + timedelta(days=30)).isoformat())
    new = service.http.post(f"/v1/keys/{made['id']}:rotate").json()
    span = datetime.fromisoformat(new["expires_at"]) - datetime.fromisoformat(new["created_at"])
    assert abs(span - timedelta(days=30)) < timedelta(minutes=1)
    (old,) = [each for each in service.http.get("/v1/keys?limit=200").json()["items"] if each["id"] == made["id"]]
    left = datetime.fromisoformat(old["expires_at"]) - datetime.now(UTC)
    assert timedelta(hours=23) < left < timedelta(hours=24)


def test_a_revoked_key_is_useless(service: Any) -> None:
    made = make(service)
    headers = headers_of(made["secret"])
    assert service.http.get("/v1/buildings", headers=headers).status_code == 200
    for _ in range(2):
        assert service.http.delete(f"/v1/keys/{made['id']}").status_code == 204
    ends(service, headers)
    (row,) = [each for each in service.http.get("/v1/keys?limit=200").json()["items"] if each["id"] == made["id"]]
    assert row["revoked_at"] is not None


def test_events_of_a_job_end_with_the_key(
    service: Any, new_floor: Callable[..., str], walk_csv: Callable[..., bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(auth, "RECHECK_S", 0.2)
    job = service.http.post(f"/v1/floors/{new_floor()}/surveys", content=walk_csv(1)).json()["job"]["id"]
    made = make(service)
    url, headers = f"/v1/jobs/{job}/events", headers_of(made["secret"])
    with ThreadPoolExecutor(1) as pool:
        events = pool.submit(service.http.get, url, headers=headers)
        with pytest.raises(TimeoutError):
            events.result(timeout=1.0)
        service.http.delete(f"/v1/keys/{made['id']}")
        told = events.result(timeout=30)
    assert told.text.count("event: status") == 1
    assert '"accepted"' in told.text
    service.http.delete(f"/v1/jobs/{job}")


def test_when_keys_were_used_is_written_down_apart(service: Any) -> None:
    made = make(service)
    assert service.http.get("/v1/buildings", headers=headers_of(made["secret"])).status_code == 200

    def last_used() -> str | None:
        rows = service.http.get("/v1/keys?limit=200").json()["items"]
        return next(each["last_used_at"] for each in rows if each["id"] == made["id"])

    assert last_used() is None, "no request waits for it"
    service.context.keys.note_uses()
    first = last_used()
    assert first is not None
    service.context.keys.note_uses()  # not used since
    assert last_used() == first


def test_a_limited_key_makes_no_building_and_no_wider_key(
    service: Any, ids: dict[str, str], key_with: Callable[..., dict[str, str]]
) -> None:
    headers = key_with("admin", building_ids=[ids["building_id"]])
    refused = service.http.post("/v1/buildings", json={"name": "x"}, headers=headers)
    assert refused.status_code == 403
    assert "limited to buildings" in refused.json()["detail"]
    elsewhere = service.http.post("/v1/buildings", json={"name": "Annex"}).json()["id"]
    for wider in ({}, {"building_ids": None}, {"building_ids": [ids["building_id"], elsewhere]}):
        body = {"name": "x", "scopes": ["admin"], **wider}
        assert service.http.post("/v1/keys", json=body, headers=headers).status_code == 403
    body = {"name": "x", "scopes": ["admin"], "building_ids": [ids["building_id"]]}
    made = [service.http.post("/v1/keys", json=body, headers=headers) for _ in range(2)]
    assert [answer.status_code for answer in made] == [201, 201]
    for beyond in ([elsewhere], sorted((ids["building_id"], elsewhere))):
        make(service, building_ids=beyond)
    looked: list[int] = []

    def count(_session: object, _row: object) -> None:
        looked.append(1)

    event.listen(Key, "load", count)
    url, listed = "/v1/keys?limit=1&order=newest", []
    while url and len(listed) < 2:
        looked.clear()
        page = service.http.get(url, headers=headers).json()
        assert len(looked) <= 3, "no more keys are loaded than a page has, the next, and the one that asks"
        listed += page["items"]
        url = page["links"].get("next")
    event.remove(Key, "load", count)
    assert [each["id"] for each in listed] == [answer.json()["id"] for answer in reversed(made)]
    every = service.http.get("/v1/keys?limit=200", headers=headers).json()["items"]
    assert all(each["building_ids"] == [ids["building_id"]] for each in every)
