"""Every request has an id and one line in the log, and neither says more than it should."""

import logging
import re
from collections.abc import Callable
from typing import Any

import pytest
from starlette.testclient import WebSocketDenialResponse

from app.errors import Overloaded

ADMIN = "isd_admin-of-the-first-organisation"
LOGGER = "app.api.access_log"
MADE = re.compile(r"[0-9a-f]{32}")


@pytest.fixture
def lines(caplog: pytest.LogCaptureFixture) -> Callable[[], list[Any]]:
    """What the access log has said since."""
    caplog.set_level(logging.DEBUG, LOGGER)
    return lambda: [record for record in caplog.records if record.name == LOGGER]


def test_a_sane_id_is_kept_and_any_other_made_anew(service: Any) -> None:
    kept = service.http.get("/v1/buildings", headers={"X-Request-ID": "my-app.2026_01"})
    assert kept.headers["X-Request-ID"] == "my-app.2026_01"
    for told in ("", "two words", "x" * 65, 'a"b', "ä".encode("latin-1")):
        made = service.http.get("/v1/buildings", headers={b"X-Request-ID": told if told else b""})
        assert MADE.fullmatch(made.headers["X-Request-ID"])
    assert service.http.get("/healthz").headers["X-Request-ID"] != service.http.get("/healthz").headers["X-Request-ID"]


@pytest.mark.parametrize("path", ["/v1/buildings/none", "/nowhere", "/v1/buildings?limit=x"])
def test_a_problem_document_names_its_request(service: Any, path: str) -> None:
    answer = service.http.get(path, headers={"X-Request-ID": "asked"})
    assert answer.status_code >= 400
    assert answer.json()["request_id"] == answer.headers["X-Request-ID"] == "asked"


def test_a_fault_of_ours_names_its_request_and_is_an_error(service: Any, lines: Any, monkeypatch: Any) -> None:
    def fail(*_: object) -> None:
        raise RuntimeError("broken")

    monkeypatch.setattr("app.api.buildings.list_page", fail)
    answer = service.http.get("/v1/buildings", headers={"X-Request-ID": "asked"})
    assert answer.status_code == 500
    assert answer.json()["request_id"] == answer.headers["X-Request-ID"] == "asked"
    assert [(line.levelname, line.status) for line in lines()] == [("ERROR", 500)]


def test_a_busy_server_warns(service: Any, lines: Any, monkeypatch: Any) -> None:
    """Nothing failed, and nobody is to be woken for each of many."""

    def refuse(*_: object) -> None:
        raise Overloaded("busy")

    monkeypatch.setattr("app.api.buildings.list_page", refuse)
    assert service.http.get("/v1/buildings").status_code == 503
    assert [(line.levelname, line.status) for line in lines()] == [("WARNING", 503)]


def test_a_line_has_the_template_and_who_asked(service: Any, building: str, lines: Any) -> None:
    service.http.get(f"/v1/buildings/{building}?secret=42", headers={"X-Request-ID": "asked"})
    (line,) = lines()
    assert re.fullmatch(r"GET /v1/buildings/{building_id} 200 \d+\.\d ms", line.getMessage())
    assert line.levelname == "INFO"
    assert (line.bytes_in, line.duration_ms > 0) == (0, True)
    assert line.bytes_out > 0
    assert len(line.key_id) == len(line.organisation_id) == 36
    told = " ".join(str(value) for value in vars(line).values())
    assert building not in told
    assert "secret" not in told


def test_the_page_asks_the_api_within_its_own_request(service: Any, building: str, lines: Any) -> None:
    origin = {"Origin": "http://testserver"}
    service.http.post("/view/session", data={"key": ADMIN}, headers=origin, follow_redirects=False)
    answer = service.http.get(f"/view/v1/buildings/{building}", headers={"X-Request-ID": "asked"})
    assert answer.status_code == 200, answer.text
    signed_in, asked = lines()
    assert (signed_in.route, signed_in.key_id) == ("/view/session", None)
    assert (asked.route, len(asked.key_id)) == ("/view/v1/buildings/{building_id}", 36)
    assert answer.headers.get_list("X-Request-ID") == ["asked"]


def test_a_refused_stream_has_its_line(service: Any, lines: Any) -> None:
    with pytest.raises(WebSocketDenialResponse) as refused, service.http.websocket_connect("/v1/tracks/none/stream"):
        pass
    (line,) = lines()
    assert (line.method, line.route, line.status) == ("WEBSOCKET", "/v1/tracks/{track_id}/stream", 404)
    assert refused.value.json()["request_id"] == refused.value.headers["X-Request-ID"]


def test_probes_are_not_worth_a_line(service: Any, lines: Any) -> None:
    service.http.get("/healthz")
    service.http.get("/metrics")
    assert {line.levelname for line in lines()} == {"DEBUG"}


def test_a_refused_key_is_not_in_the_log(service: Any, lines: Any, caplog: Any) -> None:
    service.http.get("/v1/buildings?cursor=isd_query", headers={"Authorization": "Bearer isd_wrong"})
    (line,) = lines()
    assert (line.levelname, line.status, line.key_id) == ("INFO", 401, None)
    assert not any("isd_" in str(value) for value in vars(line).values())
