"""More than a real server can do: what it takes on is answered, the rest is refused at once, and it stays well."""

import asyncio
import socket
import time
from collections import Counter
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.blobs import FolderBlobStore
from app.db.engine import create_database_engine, session_factory
from app.db.tables import Floor
from tests.end_to_end.conftest import KEY, Server

WINDOW: dict[str, Any] = {
    "window": {
        "frame": "level", "noise_ut": 0.5,
        "b_ut": [[20.0 + 0.1 * k, 2.0, -43.0] for k in range(60)],
        "displacement_m": [[0.1 * k, 0, 0] for k in range(60)],
    }
}  # fmt: skip
HEADERS = {"Authorization": f"Bearer {KEY}"}


@pytest.fixture
def narrow(tmp_path: Path, put_hall: Any) -> Any:
    """A server with little patience, and a hall to be searched: the server and the building's id."""
    server = Server(tmp_path)
    server.environment |= {
        "ISODYN_MAX_WAIT_S": "0.1", "ISODYN_BODY_MEMORY_BYTES": str(16 * 2**20), "ISODYN_MAX_REQUESTS": "100",
        "ISODYN_MAX_UPLOAD_WAIT_S": "1",
    }  # fmt: skip
    server.start()
    engine = create_database_engine(f"sqlite:///{server.folder / 'var' / 'isodyn.db'}")
    with session_factory(engine).begin() as session:
        building, floor = put_hall(session, FolderBlobStore(server.folder / "var" / "blobs"))
        session.get_one(Floor, floor).auto_build = False
    engine.dispose()
    yield server, building, floor
    server.http.close()
    server.kill()


def memory_bytes(pid: int) -> int:
    resident = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
    return 1024 * int(resident.split()[1])


class Load:
    """Clients that ask again as soon as they are answered, or refused."""

    def __init__(self, url: str) -> None:
        self.http = httpx.AsyncClient(base_url=url, headers=HEADERS, timeout=60, trust_env=False,
                                      limits=httpx.Limits(max_connections=None))  # fmt: skip
        self.statuses: Counter[tuple[str, int]] = Counter()
        self.taken_s: dict[tuple[str, int], list[float]] = {}
        self.end = 0.0

    async def ask(self, kind: str, method: str, path: str, **more: Any) -> None:
        while time.monotonic() < self.end:
            start = time.monotonic()
            try:
                answer = await self.http.request(method, path, **more)
                status = answer.status_code
            except httpx.TransportError:  # a connection that was idle too long, or its body not read
                continue
            if status in (429, 503):
                assert answer.json()["type"].endswith("/too-many" if status == 429 else "/overloaded"), answer.text
                assert int(answer.headers["Retry-After"]) >= 1
            self.statuses[kind, status] += 1
            self.taken_s.setdefault((kind, status), []).append(time.monotonic() - start)
            if status in (429, 503):
                await asyncio.sleep(0.02)

    async def run(self, seconds: float, building: str, floor: str, searching: int, uploading: int) -> None:
        self.end = time.monotonic() + seconds
        unreadable = b"t_s,x_m\n" + b"1,2\n" * 800_000
        tasks = [self.ask("locate", "POST", f"/v1/buildings/{building}/locate", json=WINDOW) for _ in range(searching)]
        tasks += [self.ask("upload", "POST", f"/v1/floors/{floor}/surveys", content=unreadable)
                  for _ in range(uploading)]  # fmt: skip
        tasks += [self.ask("health", "GET", "/healthz"), self.ask("ready", "GET", "/readyz")]
        async with self.http, asyncio.TaskGroup() as all_of_them:
            for task in tasks:
                all_of_them.create_task(task)

    def told(self) -> str:
        lines = []
        for key, taken in sorted(self.taken_s.items()):
            taken.sort()
            lines.append(f"{key[0]:>8} {key[1]}: {len(taken):6}, p50 {1e3 * taken[len(taken) // 2]:7.1f} ms, "
                         f"p99 {1e3 * taken[int(0.99 * (len(taken) - 1))]:7.1f} ms")  # fmt: skip
        return "\n".join(lines)


def press(narrow: Any, seconds: float, searching: int, uploading: int) -> None:
    server, building, floor = narrow
    assert server.http.post(f"/v1/buildings/{building}/locate", json=WINDOW).status_code == 200
    before = memory_bytes(server.process.pid)
    load = Load(str(server.http.base_url))
    asyncio.run(load.run(seconds, building, floor, searching, uploading))
    grown = memory_bytes(server.process.pid) - before
    print(f"\n{load.told()}\nmemory grew by {grown / 2**20:.0f} MiB")
    kinds = {kind: {status for of, status in load.statuses if of == kind} for kind, _ in load.statuses}
    assert kinds["locate"] == {200, 503}
    assert kinds["upload"] <= {422, 429, 503}, "one organisation's, which hold half of the room at most"
    assert 422 in kinds["upload"]
    assert kinds["health"] == kinds["ready"] == {200}
    assert grown < 300 * 2**20
    assert server.http.post(f"/v1/buildings/{building}/locate", json=WINDOW).status_code == 200, "at once well again"
    assert "Traceback" not in (server.folder / "server.log").read_text()


def test_a_server_under_pressure_answers_what_it_can_and_refuses_the_rest(narrow: Any) -> None:
    press(narrow, 3.0, 40, 6)


@pytest.mark.slow
def test_three_times_what_it_can_do_for_a_while(narrow: Any) -> None:
    press(narrow, 20.0, 90, 8)


def test_requests_that_two_servers_might_read_differently_are_refused(narrow: Any) -> None:
    server, _, _ = narrow
    head = b"POST /v1/buildings HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer " + KEY.encode() + b"\r\n"
    hidden = b"0\r\n\r\nGET /v1/buildings HTTP/1.1\r\nHost: x\r\n\r\n"
    for told in (
        b"Content-Length: 5\r\nTransfer-Encoding: chunked\r\n\r\n" + hidden,
        b"Transfer-Encoding: chunked, identity\r\n\r\n" + hidden,
        b"Content-Length: 5\r\nContent-Length: 6\r\n\r\n{}   ",
        b"Content-Length : 5\r\n\r\n{}   ",
        b"X: " + b"x" * 200_000,
    ):
        with socket.create_connection(("127.0.0.1", server.port), 20) as client:
            try:
                client.sendall(head + told)
                answer = client.recv(65536)
            except ConnectionError:
                answer = b""
        assert answer == b"" or answer.startswith(b"HTTP/1.1 400"), answer
    assert server.http.get("/v1/buildings").status_code == 200
