"""The compose file's topology by processes: its Caddyfile with TLS, two web processes, two workers, PostgreSQL, S3."""

import json
import os
import shutil
import signal
import ssl
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import pytest
from websockets.sync.client import connect

from tests.s3_server import BUCKET, Server, free_port

CADDYFILE = Path(__file__).parents[2] / "deploy" / "compose" / "Caddyfile"
KEY = "isd_of-the-topology"
TRACE = "ab" * 16

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("caddy") is None, reason="no caddy: apt-get install caddy"),
]


class Installation:
    """Its processes by name, and a client that comes through the proxy and trusts its certificate."""

    def __init__(self, folder: Path, database_url: str) -> None:
        self.folder = folder
        self.processes: dict[str, subprocess.Popen[bytes]] = {}
        self.clients: list[httpx.Client] = []
        self.metrics_ports: list[int] = []
        self.site = f"localhost:{free_port()}"
        self.environment = {
            **os.environ,
            "ISODYN_DATABASE_URL": database_url,
            "ISODYN_BLOB_URL": f"s3://{BUCKET}/{uuid4().hex}",
            "ISODYN_DATA_DIR": str(folder),
            "ISODYN_ADMIN_KEY": KEY,
            "ISODYN_LOG_FORMAT": "json",
            "HOME": str(folder),
            "XDG_DATA_HOME": str(folder),
        }

    def run(self, name: str, *command: str, **environment: str) -> None:
        with (self.folder / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                command, env=self.environment | environment, stdout=log, stderr=log, start_new_session=True
            )

    def isodyn(self, name: str, *command: str, **environment: str) -> None:
        self.run(name, sys.executable, "-m", "app.cli", *command, **environment)

    def start(self) -> None:
        self.isodyn("migrate", "migrate")
        assert self.processes.pop("migrate").wait(120) == 0, self.log("migrate")
        ports = [str(free_port()) for _ in range(2)]
        for k, port in enumerate(ports):
            self.isodyn(f"api-{k}", "serve", "--no-worker", "--port", port)
            self.metrics_ports.append(free_port())
            self.isodyn(f"worker-{k}", "worker", ISODYN_WORKER_METRICS_PORT=str(self.metrics_ports[k]))
        caddyfile = self.folder / "Caddyfile"
        caddyfile.write_text(CADDYFILE.read_text().replace("admin off", "admin off\nauto_https disable_redirects"))
        self.run(
            "proxy", "caddy", "run", "--adapter", "caddyfile", "--config", str(caddyfile),
            ISODYN_SITE=self.site, ISODYN_UPSTREAMS=f"to {' '.join(f'127.0.0.1:{port}' for port in ports)}",
        )  # fmt: skip
        for port in ports:
            patiently(lambda port=port: httpx.get(f"http://127.0.0.1:{port}/readyz").status_code == 200)  # type: ignore[misc]
        root = self.folder / "caddy/pki/authorities/local/root.crt"
        patiently(root.exists)
        self.tls = ssl.create_default_context(cafile=root)
        self.http = self.client()
        patiently(lambda: self.http.get("/readyz").status_code == 200)

    def client(self) -> httpx.Client:
        """A client of its own: with its own cookies."""
        bearer = {"Authorization": f"Bearer {KEY}"}
        made = httpx.Client(base_url=f"https://{self.site}", headers=bearer, verify=self.tls, timeout=60)
        self.clients.append(made)
        return made

    def kill(self, name: str) -> None:
        process = self.processes.pop(name)
        with suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()

    def log(self, name: str) -> str:
        return (self.folder / f"{name}.log").read_text()

    def wait_for(self, job: dict[str, Any]) -> None:
        def ended() -> bool:
            told = self.http.get(f"/v1/jobs/{job['id']}").json()
            assert told["status"] in ("accepted", "running", "successful"), told
            return bool(told["status"] == "successful")

        patiently(ended)


def patiently(found: Callable[[], bool], seconds: float = 120) -> None:
    deadline = time.monotonic() + seconds
    while True:
        with suppress(httpx.TransportError):
            if found():
                return
        assert time.monotonic() < deadline
        time.sleep(0.1)


@pytest.fixture
def installation(tmp_path: Path, postgres_url: str, s3: Server) -> Iterator[Installation]:
    made = Installation(tmp_path, postgres_url)
    try:
        made.start()
        yield made
    finally:
        for client in made.clients:
            client.close()
        for name in list(made.processes):
            made.kill(name)


@pytest.mark.postgres
@pytest.mark.s3
def test_everything_works_through_the_proxy_and_outlives_a_web_process_and_a_worker(
    installation: Installation, hall_steps: Callable[..., list[dict[str, Any]]]
) -> None:
    http = installation.http
    building = http.post("/v1/buildings", json={"name": "House"}).json()["id"]
    floor = http.post(f"/v1/buildings/{building}/floors", json={"name": "G", "ordinal": 0}).json()["id"]
    traced = {"X-Request-ID": "asked", "traceparent": f"00-{TRACE}-{'cd' * 8}-01"}

    upload = http.post(f"/v1/floors/{floor}/surveys", content=walk(0.0), headers=traced)
    assert upload.status_code == 202, upload.text
    assert upload.headers["x-request-id"] == "asked"
    installation.wait_for(upload.json()["job"])
    api, worker = (installation.log(f"{kind}-0") + installation.log(f"{kind}-1") for kind in ("api", "worker"))
    assert [line for line in api.splitlines() if '"asked"' in line and TRACE in line]
    assert [line for line in worker.splitlines() if '"asked"' in line and upload.json()["job"]["id"] in line]

    window = {"frame": "building", "noise_ut": 0.5, "b_ut": [[18.0, 3.0, -42.0]] * 3,
              "displacement_m": [[0, 0, 0], [0.5, 0, 0], [1, 0, 0]]}  # fmt: skip
    assert http.post(f"/v1/buildings/{building}/locate", json={"window": window}).status_code == 200
    assert http.get("/metrics").status_code == 404

    track = http.post("/v1/tracks", json={"building_id": building, "frame": "level"}).json()["id"]
    stream(installation, track, hall_steps(count=20)[:10])

    page = installation.client()
    sign_in(installation, page)
    assert {page.get("/view/content").status_code for _ in range(20)} == {200}

    installation.kill("api-0")
    assert {installation.client().get("/v1/buildings").status_code for _ in range(20)} == {200}
    stream(installation, track, hall_steps(count=20)[10:])
    if page.get("/view/content").status_code == 401:  # it was in the memory of the one that died
        sign_in(installation, page)
    assert page.get("/view/content").status_code == 200

    upload = http.post(f"/v1/floors/{floor}/surveys", content=walk(0.3))
    installation.kill("worker-0")
    installation.wait_for(upload.json()["job"])
    metrics = f"http://127.0.0.1:{installation.metrics_ports[1]}/metrics"
    patiently(lambda: "isodyn_workers_taken_over_total 1.0" in httpx.get(metrics).text)
    assert 'isodyn_jobs_ended_total{kind="rebuild",outcome="published"}' in httpx.get(metrics).text


def test_a_stranger_who_says_he_is_a_proxy_is_not_believed(tmp_path: Path) -> None:
    alone, port = Installation(tmp_path, f"sqlite:///{tmp_path / 'isodyn.db'}"), free_port()
    alone.environment["ISODYN_BLOB_URL"] = f"file://{tmp_path / 'blobs'}"
    address = f"http://127.0.0.1:{port}"
    try:
        alone.isodyn(
            "api", "serve", "--no-worker", "--port", str(port), ISODYN_TRUSTED_PROXIES="192.0.2.1,2001:db8::/32"
        )
        patiently(lambda: httpx.get(f"{address}/readyz").status_code == 200)
        answer = httpx.post(
            f"{address}/view/session", data={"key": KEY}, headers={"Origin": address, "X-Forwarded-Proto": "https"}
        )
        assert answer.status_code == 303, answer.text
        assert "Secure" not in answer.headers["set-cookie"]
    finally:
        alone.kill("api")


def walk(offset_m: float) -> bytes:
    """A few lanes of 8 m."""
    rows = [
        (0.25 * k if lane % 2 == 0 else 8 - 0.25 * k, 0.5 * lane + offset_m) for lane in range(8) for k in range(32)
    ]
    lines = [f"{0.2 * k},{x},{y},1.2,{18 + x % 3},{3 + y % 2},{-42 + (x + y) % 4}" for k, (x, y) in enumerate(rows)]
    return "\n".join(["t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut", *lines, ""]).encode()


def sign_in(installation: Installation, page: httpx.Client) -> None:
    page.headers.pop("Authorization", None)
    page.get("/view/")
    origin = {"Origin": f"https://{installation.site}"}
    answer = page.post("/view/session", data={"key": KEY}, headers=origin)
    assert answer.status_code == 303, answer.text
    (cookie,) = (each for each in answer.headers.get_list("set-cookie") if each.startswith("isodyn_view="))
    assert "; Secure" in cookie
    assert "isodyn_process" in page.cookies


def stream(installation: Installation, track: str, steps: list[dict[str, Any]]) -> None:
    """Send steps over a WebSocket through the proxy, until they are stored."""
    bearer = {"Authorization": f"Bearer {KEY}"}
    address = f"wss://{installation.site}/v1/tracks/{track}/stream"
    with connect(address, ssl=installation.tls, additional_headers=bearer, open_timeout=60) as socket:
        assert json.loads(socket.recv(60))["next_step"] == steps[0]["number"]
        socket.send(json.dumps({"type": "steps", "steps": steps}))
        while (told := json.loads(socket.recv(60)))["next_step"] <= steps[-1]["number"]:
            assert told["type"] == "estimate", told
