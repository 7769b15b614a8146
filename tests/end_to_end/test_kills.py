"""Processes die without warning: nothing acknowledged is lost, nothing half-written is seen."""

import os
import signal
import socket
import time
from collections.abc import Callable
from typing import Any

import pytest

MAP = {"resolution_m": 0.1}  # fine enough that the fit is running when the kill comes


def _build(server: Any, floor: str) -> tuple[str, str]:
    answer = server.http.post(f"/v1/floors/{floor}/maps", json=MAP)
    assert answer.status_code == 202, answer.text
    return answer.json()["map"]["id"], answer.json()["job"]["id"]


def _floor_with_surveys(server: Any, walk_csv: Callable[[int], bytes]) -> str:
    building = server.http.post("/v1/buildings", json={"name": "House"}).json()["id"]
    body = {"name": "G", "ordinal": 0, "auto_build": False}
    floor = server.http.post(f"/v1/buildings/{building}/floors", json=body).json()["id"]
    for seed in (1, 2, 3):
        assert server.http.post(f"/v1/floors/{floor}/surveys", content=walk_csv(seed)).status_code == 202
    return str(floor)


@pytest.mark.slow
@pytest.mark.parametrize("victim", ["everything", "worker and fit"])
def test_a_fit_survives_kill_9_and_its_map_is_identical(
    server: Any, walk_csv: Callable[[int], bytes], victim: str
) -> None:
    floor = _floor_with_surveys(server, walk_csv)
    undisturbed, job = _build(server, floor)
    assert server.wait_for(job)["status"] == "successful"
    disturbed, job = _build(server, floor)
    assert server.wait_for(job, "running")["status"] == "running", "the kill must come in the middle"
    if victim == "everything":
        server.kill()
        server.start()
    else:
        workers = set(server.pids()) - {server.process.pid}
        assert len(workers) >= 2, "the worker and its fit"
        for pid in workers:
            os.kill(pid, signal.SIGKILL)
    assert server.wait_for(job)["status"] == "successful"
    maps = [server.http.get(f"/v1/maps/{each}").json() for each in (undisturbed, disturbed)]
    assert maps[0]["sha256"] == maps[1]["sha256"]
    assert maps[1]["active"]


@pytest.mark.slow
def test_kill_9_during_an_upload_leaves_no_half_survey(server: Any, walk_csv: Callable[[int], bytes]) -> None:
    floor = server.new_floor()
    data = walk_csv(1)
    with socket.create_connection(("127.0.0.1", server.port)) as connection:
        head = f"POST /v1/floors/{floor}/surveys HTTP/1.1\r\nHost: x\r\nAuthorization: Bearer isd_end-to-end\r\n"
        connection.sendall(f"{head}Content-Length: {len(data)}\r\n\r\n".encode() + data[: len(data) // 2])
        time.sleep(0.3)
        server.kill()
    server.start()
    assert server.http.get(f"/v1/floors/{floor}/surveys").json()["items"] == []
    answer = server.http.post(f"/v1/floors/{floor}/surveys", content=data)
    assert answer.status_code == 202
    assert server.wait_for(answer.json()["job"]["id"])["status"] == "successful"


@pytest.mark.slow
def test_a_stream_of_uploads_with_kills_loses_nothing_acknowledged(
    server: Any, walk_csv: Callable[[int], bytes]
) -> None:
    floor = server.new_floor()
    data = walk_csv(1).decode().splitlines()
    acknowledged = []
    for k in range(12):
        content = "\n".join([data[0], *data[1 + 40 * k : 400 + 40 * k]]).encode()
        answer = server.http.post(f"/v1/floors/{floor}/surveys", content=content)
        assert answer.status_code == 202, answer.text
        acknowledged.append(answer.json()["survey"]["id"])
        if k in (3, 8):
            server.kill()
            server.start()
    kept = [each["id"] for each in server.http.get(f"/v1/floors/{floor}/surveys").json()["items"]]
    assert kept == acknowledged
    server.wait_for(answer.json()["job"]["id"])
    active = server.http.get(f"/v1/floors/{floor}").json()["active_map_id"]
    assert server.http.get(f"/v1/maps/{active}").json()["survey_ids"] == acknowledged


def test_ctrl_c_ends_everything(server: Any) -> None:
    pids = server.pids(b"workers")
    assert pids
    assert server.stop() in (0, 130, -signal.SIGINT)
    for _ in range(100):
        if not any(os.path.exists(f"/proc/{pid}") for pid in pids):  # noqa: PTH110
            return
        time.sleep(0.1)
    raise AssertionError("the worker outlived the server")
