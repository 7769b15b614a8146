"""SIGTERM while it is used: what was begun is answered, streams are told to come again, and nothing is lost."""

import asyncio
import contextlib
import signal
import socket
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import httpx
import pytest
import websockets

from app.blobs import FolderBlobStore
from app.db.engine import create_database_engine, session_factory
from tests.end_to_end.test_track_kills import new_track

KEY = {"Authorization": "Bearer isd_end-to-end"}


@pytest.fixture
def building(server: Any, put_hall: Any) -> str:
    """The server, with a hall that has a map."""
    engine = create_database_engine(f"sqlite:///{server.folder / 'var' / 'isodyn.db'}")
    with session_factory(engine).begin() as session:
        ids: tuple[str, str] = put_hall(session, FolderBlobStore(server.folder / "var" / "blobs"))
    engine.dispose()
    return ids[0]


def test_a_server_that_is_told_to_stop_finishes_what_it_began(
    server: Any, building: str, walk_csv: Callable[[int], bytes], hall_steps: Any
) -> None:
    floor, url = server.new_floor(), str(server.http.base_url)
    track = new_track(server, building)
    acknowledged: list[str] = []
    stopping = threading.Event()

    def upload(first: int) -> None:
        with httpx.Client(base_url=url, headers=KEY, timeout=60) as http:
            rows = walk_csv(first).splitlines(keepends=True)
            for count in range(20, len(rows)):
                try:
                    answer = http.post(f"/v1/floors/{floor}/surveys", content=b"".join(rows[:count]))
                except httpx.ConnectError:
                    assert stopping.is_set()
                    return
                except httpx.RemoteProtocolError:  # closed between two requests
                    assert stopping.is_set()
                    return
                assert answer.status_code == 202, answer.text
                acknowledged.append(answer.json()["survey"]["id"])

    async def stream() -> tuple[int, str]:
        address = url.replace("http", "ws", 1) + f"/v1/tracks/{track}/stream"
        async with websockets.connect(address, additional_headers=KEY) as socket_:
            await socket_.recv()
            connected.set()
            with contextlib.suppress(websockets.ConnectionClosed):
                await socket_.recv()
        return socket_.close_code or 0, socket_.close_reason or ""

    connected = threading.Event()
    with ThreadPoolExecutor(4) as clients:
        uploads = [clients.submit(upload, seed) for seed in (1, 2)]
        streaming = clients.submit(lambda: asyncio.run(stream()))
        assert connected.wait(30)
        # Half a request, that is sent on after the signal.
        begun = socket.create_connection(("127.0.0.1", server.port))
        begun.sendall(b"POST /v1/buildings HTTP/1.1\r\nHost: x\r\nContent-Type: application/json\r\n"
                      b"Authorization: Bearer isd_end-to-end\r\nContent-Length: 16\r\n\r\n")  # fmt: skip
        while len(acknowledged) < 4 and not any(each.done() for each in uploads):
            time.sleep(0.05)
        stopping.set()
        server.process.send_signal(signal.SIGTERM)
        code, _ = streaming.result(30)
        begun.sendall(b'{"name": "Late"}')
        assert begun.recv(65536).startswith(b"HTTP/1.1 201")
        begun.close()
        for each in uploads:
            each.result(60)
    assert code in (1001, 1012)
    assert server.process.wait(40) == 0
    assert not server.pids(), "no process is left"
    log = (server.folder / "server.log").read_text()
    assert "Traceback" not in log, log
    server.start()
    kept = {each["id"] for page in (server.http.get(f"/v1/floors/{floor}/surveys?limit=200").json(),)
            for each in page["items"]}  # fmt: skip
    assert set(acknowledged) <= kept
    assert any(each["name"] == "Late" for each in server.http.get("/v1/buildings?limit=100").json()["items"])
