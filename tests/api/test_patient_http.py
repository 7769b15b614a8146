"""Clients that stop in the middle, on a real server at a real port."""

import socket
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import uvicorn

import app.api.patient_http as patient_http
from app.api.patient_http import PatientHttp

ANSWER_BYTES = 32 * 2**20  # far more than the kernel's buffers hold


async def answer(scope: Any, receive: Any, send: Any) -> None:
    await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", b"%d" % ANSWER_BYTES)]})
    await send({"type": "http.response.body", "body": bytes(ANSWER_BYTES)})


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[uvicorn.Server]:
    monkeypatch.setattr(patient_http, "HEADERS_S", 1.0)
    monkeypatch.setattr(patient_http, "ANSWER_S", 2.0)
    made = uvicorn.Server(uvicorn.Config(answer, port=0, http=PatientHttp, lifespan="off", log_config=None))
    thread = threading.Thread(target=made.run, daemon=True)
    thread.start()
    until(lambda: made.started)
    yield made
    made.should_exit = True
    thread.join(20)
    assert not thread.is_alive()


def until(true: Callable[[], Any]) -> None:
    give_up = time.monotonic() + 20.0
    while not true():
        assert time.monotonic() < give_up
        time.sleep(0.01)


def connect(server: uvicorn.Server) -> socket.socket:
    client = socket.create_connection(server.servers[0].sockets[0].getsockname(), timeout=20)
    until(lambda: server.server_state.connections)
    return client


def test_a_client_that_takes_nothing_of_its_answer_is_hung_up_on(server: uvicorn.Server) -> None:
    with connect(server) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: x\r\n\r\n")
        until(lambda: not server.server_state.connections)
    assert not server.server_state.tasks, "nothing waits for it any more"


def test_a_client_that_does_not_finish_its_headers_is_hung_up_on(server: uvicorn.Server) -> None:
    with connect(server) as client:
        client.sendall(b"GET / HTTP/1.1\r\n")
        assert client.recv(1) == b""


def test_a_client_that_takes_its_answer_slowly_gets_all_of_it(server: uvicorn.Server) -> None:
    with connect(server) as client:
        client.sendall(b"GET / HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n")
        got, pauses = 0, 0
        while data := client.recv(2**20):
            got += len(data)
            if got > 2**21 * (pauses + 1) and pauses < 6:  # together longer than it would be waited for
                pauses += 1
                time.sleep(0.4)
    assert got > ANSWER_BYTES
