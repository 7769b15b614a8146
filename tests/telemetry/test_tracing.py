"""Traces as a collector gets them: from real processes, by OTLP over HTTP, decoded by OpenTelemetry's own protocol."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest
from opentelemetry.proto.collector.trace.v1.trace_service_pb2 import ExportTraceServiceRequest

from app.blobs import open_blob_store
from tests.s3_server import free_port
from workers.fit_process import FitProcesses

KEY = "isd_of-the-traced"
TRACE, PARENT = "ab" * 16, "cd" * 8


class Collector:
    """What was sent: spans as (service, span)."""

    def __init__(self) -> None:
        self.spans: list[tuple[str, Any]] = []
        self.may_answer, self.waited_in_vain = threading.Event(), False
        self.may_answer.set()
        collector = self

        class Receive(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                collector.waited_in_vain |= not collector.may_answer.wait(8.0)  # less than a sender waits
                body = self.rfile.read(int(self.headers["content-length"]))
                assert self.path == "/v1/traces"
                for resource in ExportTraceServiceRequest.FromString(body).resource_spans:
                    named = {each.key: each.value.string_value for each in resource.resource.attributes}
                    for scope in resource.scope_spans:
                        collector.spans += [(named["service.name"], span) for span in scope.spans]
                self.send_response(200)
                self.end_headers()

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Receive)
        self.url = f"http://127.0.0.1:{self._server.server_port}"
        self._thread = threading.Thread(target=self._server.serve_forever, daemon=True)
        self._thread.start()

    def wait_for(self, service: str, name: str) -> Any:
        """The first span of this name."""
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            for sent_by, span in list(self.spans):
                if (sent_by, span.name) == (service, name):
                    return span
            time.sleep(0.05)
        raise AssertionError(f"no span {name!r} of {service}: {sorted({(s, e.name) for s, e in self.spans})}")

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


@pytest.fixture
def collector() -> Iterator[Collector]:
    collector = Collector()
    yield collector
    collector.close()


@pytest.fixture
def serve(tmp_path: Path) -> Iterator[Callable[..., httpx.Client]]:
    """Start `isodyn serve` with more of environment: a client of it."""
    started: list[subprocess.Popen[bytes]] = []
    clients: list[httpx.Client] = []

    def start(**environment: str) -> httpx.Client:
        port = free_port()
        environment |= {"ISODYN_DATA_DIR": str(tmp_path), "ISODYN_ADMIN_KEY": KEY, "ISODYN_LOG_FORMAT": "json"}
        with (tmp_path / "log").open("wb") as log:
            started.append(
                subprocess.Popen(
                    [sys.executable, "-m", "app.cli", "serve", "--port", str(port)],
                    env={**os.environ, **environment}, stdout=log, stderr=log,
                )
            )  # fmt: skip
        http = httpx.Client(base_url=f"http://127.0.0.1:{port}", headers={"Authorization": f"Bearer {KEY}"}, timeout=60)
        clients.append(http)
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            try:
                http.get("/healthz")
                return http
            except httpx.TransportError:
                time.sleep(0.05)
        raise AssertionError((tmp_path / "log").read_text())

    yield start
    for http in clients:
        http.close()
    for process in started:
        process.terminate()
        process.wait(40)


def attributes(span: Any) -> dict[str, str]:
    return {each.key: each.value.string_value or str(each.value.int_value) for each in span.attributes}


def test_a_request_its_statements_and_its_job_are_one_story(
    collector: Collector, serve: Callable[..., httpx.Client], tmp_path: Path
) -> None:
    http = serve(OTEL_EXPORTER_OTLP_ENDPOINT=collector.url, OTEL_BSP_SCHEDULE_DELAY="200")
    building = http.post("/v1/buildings", json={"name": "House"}).json()["id"]
    floor = http.post(f"/v1/buildings/{building}/floors", json={"name": "G", "ordinal": 0}).json()["id"]
    rows = "\n".join(f"{k},{0.1 * k},0,1.2,{20 + 0.01 * k},3,-42" for k in range(60))
    upload = http.post(
        f"/v1/floors/{floor}/surveys", content=f"t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut\n{rows}\n",
        headers={"traceparent": f"00-{TRACE}-{PARENT}-01", "X-Request-ID": "asked"},
    )  # fmt: skip
    assert upload.status_code == 202, upload.text
    request = collector.wait_for("isodyn-api", "POST /v1/floors/{floor_id}/surveys")
    assert (request.trace_id.hex(), request.parent_span_id.hex()) == (TRACE, PARENT)
    assert attributes(request)["http.response.status_code"] == "202"
    put = collector.wait_for("isodyn-api", "blob put")
    assert (put.trace_id, put.parent_span_id) == (request.trace_id, request.span_id)
    statement = collector.wait_for("isodyn-api", "INSERT")
    assert "?" in attributes(statement)["db.query.text"]
    fit = collector.wait_for("isodyn-worker", "job fit")
    assert {(link.trace_id.hex(), link.span_id) for link in fit.links} == {(TRACE, request.span_id)}
    within = collector.wait_for("isodyn-fit", "blob get")
    assert within.trace_id == fit.trace_id != request.trace_id
    collector.wait_for("isodyn-worker", "job publish")
    job = http.get(f"/v1/jobs/{upload.json()['job']['id']}").json()
    assert job["status"] == "successful", job
    log = (tmp_path / "log").read_text().splitlines()
    assert [line for line in log if "the job ended" in line and '"request_id": "asked"' in line and job["id"] in line]
    told = str([span for _, span in collector.spans])
    assert not [word for word in (building, "House", KEY) if word in told]


@pytest.mark.slow
def test_a_collector_that_is_slow_does_not_hold_up_a_fit(
    collector: Collector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", collector.url)
    monkeypatch.setenv("ISODYN_TEST_DIARY", str(tmp_path / "diary"))
    blobs = f"file://{tmp_path / 'blobs'}"
    open_blob_store(blobs)
    collector.may_answer.clear()
    fits = FitProcesses()
    plan = {"floor_id": "f", "map_id": "m", "surveys": [], "sleep_s": 0.05}
    assert fits.run("tests.jobs.fake_builder", {"plan": plan}, blobs, lambda _fraction, _message: None)
    collector.may_answer.set()
    collector.wait_for("isodyn-fit", "blob put")
    fits.close()
    assert not collector.waited_in_vain


def test_traces_without_what_sends_them_are_a_clear_error(tmp_path: Path) -> None:
    hide = "import sys; sys.modules['opentelemetry.sdk'] = None; from app.cli import main; main()"
    environment = {**os.environ, "ISODYN_DATA_DIR": str(tmp_path), "ISODYN_OTEL": "1"}
    command = [sys.executable, "-c", hide, "serve", "--port", str(free_port())]
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=60)
    assert run.returncode == 2
    assert "pip install 'isodyn[otel]'" in run.stderr
    assert "Traceback" not in run.stderr
