"""The server dies in mid-stream: no acknowledged step is lost, and the track goes on as if nothing had been."""

import asyncio
import json
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

from app.blobs import open_blob_store
from app.db.engine import create_database_engine, session_factory
from app.settings import Settings

Steps = list[dict[str, Any]]


@pytest.fixture
def building(server: Any, put_hall: Any) -> str:
    """A hall with a map, put into the running server's database."""
    settings = Settings(data_dir=server.folder / "var", database_url=None, blob_url=None)
    engine = create_database_engine(settings.resolved_database_url)
    with session_factory(engine).begin() as session:
        building_id, _ = put_hall(session, open_blob_store(settings.resolved_blob_url))
    engine.dispose()
    return str(building_id)


def new_track(server: Any, building: str) -> str:
    body = {"building_id": building, "frame": "level", "seed": 7, "options": {"particles": 500}}
    answer = server.http.post("/v1/tracks", json=body)
    assert answer.status_code == 201, answer.text
    return str(answer.json()["id"])


async def stream_until_killed(server: Any, track: str, steps: Steps, kill_at: int) -> tuple[int, int]:
    """Send steps one by one at 100 Hz, and kill the server once `kill_at` is acknowledged: the number waited for when
    the stream began, and the last one acknowledged."""
    headers = {"Authorization": server.http.headers["authorization"]}
    url = f"ws://127.0.0.1:{server.port}/v1/tracks/{track}/stream"
    acknowledged, most = -1, kill_at + 40
    async with connect(url, additional_headers=headers, proxy=None, open_timeout=60) as stream:
        first = json.loads(await stream.recv())["next_step"]

        async def send() -> None:
            with suppress(ConnectionClosed):
                for step in steps[first:most]:  # so that the kill comes before the end
                    await stream.send(json.dumps({"type": "step", **step}))
                    await asyncio.sleep(0.01)

        sending = asyncio.create_task(send())
        with suppress(ConnectionClosed):
            while acknowledged < len(steps):
                acknowledged = json.loads(await asyncio.wait_for(stream.recv(), 60))["next_step"]
                if acknowledged >= kill_at:
                    await asyncio.to_thread(server.kill)
                    kill_at = 10**9
        sending.cancel()
        with suppress(asyncio.CancelledError):
            await sending
    return first, acknowledged


@pytest.mark.timeout(240)
def test_kill_9_in_mid_stream_loses_no_acknowledged_step(
    server: Any, building: str, hall_steps: Callable[..., Steps]
) -> None:
    steps = hall_steps(count=200)
    track, undisturbed = new_track(server, building), new_track(server, building)
    acknowledged = 0
    for kill_at in (60, 130, 10**9):
        first, last = asyncio.run(stream_until_killed(server, track, steps, kill_at))
        assert first >= acknowledged, "what was acknowledged is there after the kill"
        acknowledged = last
        if kill_at < 200:
            assert last < 200, "the kill came in the middle"
            server.start()
    assert acknowledged == 200
    assert server.http.get(f"/v1/tracks/{track}/steps").json()["steps"] == steps
    server.http.post(f"/v1/tracks/{undisturbed}/steps", json={"steps": steps})
    ways = [server.http.get(f"/v1/tracks/{each}/path").json()["points"] for each in (track, undisturbed)]
    assert ways[0] == ways[1], "bit for bit"
    end = json.loads(server.http.post(f"/v1/tracks/{track}/replay").text.splitlines()[-1])
    assert end["equal"]
