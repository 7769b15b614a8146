"""A track's WebSocket against a real server: 50 Hz, lost connections, faults, and a client that does not read."""

import asyncio
import json
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Subprotocol

from app.api import auth
from app.api.track_stream import MOST_AHEAD_BYTES
from app.db.tables import Key, utc_now
from app.main import create_app, first_start
from app.services import key_ring
from app.services.manage_keys import create_key, revoke_key
from app.settings import Settings

KEY, STRANGER, READER = "isd_stream", "isd_stranger", "isd_reader"
Steps = list[dict[str, Any]]


class Served:
    """The application behind uvicorn, in a thread of its own."""

    def __init__(self, folder: Path) -> None:
        self.settings = Settings(data_dir=folder, database_url=None, blob_url=None, admin_key=KEY)
        first_start(self.settings)
        self.app = create_app(self.settings)
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        config = uvicorn.Config(
            self.app, host="127.0.0.1", port=self.port, log_level="warning", ws_max_size=2**20,
            timeout_graceful_shutdown=5,
        )  # fmt: skip
        self.server = uvicorn.Server(config)
        self.thread = threading.Thread(target=self.server.run, daemon=True)
        self.http = httpx.Client(
            base_url=f"http://127.0.0.1:{self.port}", headers={"Authorization": f"Bearer {KEY}"}, timeout=60
        )
        self.building = ""

    def start(self) -> None:
        self.thread.start()
        deadline = time.monotonic() + 60
        while not self.server.started and time.monotonic() < deadline:
            time.sleep(0.02)
        assert self.server.started

    def stop(self) -> None:
        self.http.close()
        self.server.should_exit = True
        self.thread.join(timeout=30)

    def new_track(self, **more: Any) -> str:
        body = {"building_id": self.building, "frame": "level", "seed": 7, "options": {"particles": 500}, **more}
        answer = self.http.post("/v1/tracks", json=body)
        assert answer.status_code == 201, answer.text
        return str(answer.json()["id"])

    def stream(self, track: str, key: str | None = KEY, **more: Any) -> connect:
        headers = {} if key is None else {"Authorization": f"Bearer {key}"}
        url = f"ws://127.0.0.1:{self.port}/v1/tracks/{track}/stream"
        return connect(url, additional_headers={**headers, **more.pop("headers", {})}, proxy=None, **more)


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory, put_hall: Any) -> Iterator[Served]:
    served = Served(tmp_path_factory.mktemp("stream"))
    context = served.app.state.context
    with context.transaction() as session:
        create_key(session, organisation="another", name="stranger", scopes=["admin"], secret=STRANGER)
        create_key(session, organisation="default", name="reader", scopes=["map:read"], secret=READER)
        served.building, _ = put_hall(session, context.blobs)
    served.start()
    yield served
    served.stop()


async def read(stream: Any) -> dict[str, Any]:
    told: dict[str, Any] = json.loads(await asyncio.wait_for(stream.recv(), 30))
    return told


async def read_until(stream: Any, next_step: int) -> list[dict[str, Any]]:
    """Answers up to the one that acknowledges what is before `next_step`."""
    answers = [await read(stream)]
    while answers[-1].get("next_step") != next_step:
        answers.append(await read(stream))
    return answers


def steps_message(steps: Steps, **more: Any) -> str:
    return json.dumps({"type": "steps", "steps": steps, **more})


def step_message(step: dict[str, Any]) -> str:
    return json.dumps({"type": "step", **step})


def test_a_stream_is_refused_in_good_order_while_the_database_is_away(served: Served) -> None:
    track = served.new_track()
    context = served.app.state.context
    with context.engine.begin() as connection:
        connection.exec_driver_sql("ALTER TABLE track RENAME TO away")

    async def scenario() -> None:
        with pytest.raises(InvalidStatus) as refused:
            async with served.stream(track):
                pass
        assert refused.value.response.status_code == 503
        assert json.loads(refused.value.response.body or b"")["type"].endswith("/unavailable")
        assert refused.value.response.headers["Retry-After"] == "5"

    try:
        asyncio.run(scenario())
    finally:
        with context.engine.begin() as connection:
            connection.exec_driver_sql("ALTER TABLE away RENAME TO track")


def test_fifty_steps_a_second_are_answered_as_they_come(served: Served, hall_steps: Callable[..., Steps]) -> None:
    """One step a message, as a device takes them; what is answered is the same as by POST, bit for bit."""
    steps, track = hall_steps(count=100), served.new_track()

    async def run() -> list[dict[str, Any]]:
        async with served.stream(track) as stream:
            ready = await read(stream)
            assert (ready["type"], ready["track_id"], ready["next_step"], ready["status"]) == (
                "ready", track, 0, "active",
            )  # fmt: skip
            reading = asyncio.create_task(read_until(stream, 100))
            for step in steps:
                await stream.send(step_message(step))
                await asyncio.sleep(0.02)
            return await reading

    answers = asyncio.run(run())
    assert {each["type"] for each in answers} == {"estimate"}
    assert sum(each["accepted"] for each in answers) == 100
    assert answers[-1]["estimate"]["step"] == 99
    assert served.http.get(f"/v1/tracks/{track}").json()["estimate"] == answers[-1]["estimate"]
    straight = served.new_track()
    served.http.post(f"/v1/tracks/{straight}/steps", json={"steps": steps})
    ways = [served.http.get(f"/v1/tracks/{each}/path").json()["points"] for each in (track, straight)]
    assert ways[0] == ways[1], "batches do not matter"


def test_a_client_that_lost_its_connection_goes_on_by_number(served: Served, hall_steps: Callable[..., Steps]) -> None:
    steps, track, straight = hall_steps(count=200), served.new_track(), served.new_track()

    async def run() -> None:
        done = 0
        for lost_at in (37, 90, 140):
            async with served.stream(track) as stream:
                ready = await read(stream)
                assert ready["next_step"] >= done, "what was acknowledged is stored"
                for k in range(ready["next_step"], lost_at):
                    await stream.send(step_message(steps[k]))
                answer = await read(stream)
                done = answer["next_step"]
                stream.transport.abort()  # no farewell: as a phone that leaves the network
        async with served.stream(track) as stream:
            ready = await read(stream)
            again = max(ready["next_step"] - 20, 0)
            await stream.send(steps_message(steps[again:]))
            answer = await read(stream)
            assert answer["next_step"] == 200
            assert answer["duplicates"] >= 20 - max(20 - ready["next_step"], 0)

    asyncio.run(run())
    served.http.post(f"/v1/tracks/{straight}/steps", json={"steps": steps})
    ways = [served.http.get(f"/v1/tracks/{each}/path").json()["points"] for each in (track, straight)]
    assert ways[0] == ways[1]


def test_two_connections_take_turns(served: Served, hall_steps: Callable[..., Steps]) -> None:
    steps, track = hall_steps(count=60), served.new_track()

    async def run() -> None:
        async with served.stream(track) as one, served.stream(track) as two:
            await read(one)
            await read(two)
            for k in range(0, 60, 10):
                await asyncio.gather(*(each.send(steps_message(steps[k : k + 10])) for each in (one, two)))
                told = [await read(one), await read(two)]
                assert [each["next_step"] for each in told] == [k + 10, k + 10]
                assert sum(each["accepted"] for each in told) == 10

    asyncio.run(run())


def test_a_faulty_message_is_told_and_spoils_no_other(served: Served, hall_steps: Callable[..., Steps]) -> None:
    steps, track = hall_steps(count=40), served.new_track()
    faulty: list[tuple[str | bytes, str]] = [
        ("{", "/body"), (b"\xff\xfe", "/body"), ("[]", "/body/type"), ('{"type": "hello"}', "/body/type"),
        (steps_message([]), "/body/steps"), (step_message({**steps[5], "t_s": -9.0}), "/body/steps/0/t_s"),
        (step_message({**steps[5], "number": "x"}), "/body/steps/0/number"), ("[" * 100_000, "/body"),
        (step_message({**steps[5], "b_ut": [9000, 0, 0]}), "/body/steps/0/b_ut"),
        (steps_message(steps[:1] * 501), "/body/steps"),
    ]  # fmt: skip

    async def run() -> None:
        async with served.stream(track) as stream:
            await read(stream)
            await stream.send(steps_message(steps[:5]))
            assert (await read(stream))["next_step"] == 5
            for message, where in faulty:
                await stream.send(message)
                told = await read(stream)
                assert (told["type"], told["problem"]["status"]) == ("problem", 422), (message[:50], told)
                assert told["problem"]["errors"][0]["location"] == where, (message[:50], told)
            good = [step_message(step) for step in steps[5:15]]
            for message in [
                *good[:5],
                step_message({**steps[10], "t_s": -9.0}),
                *good[5:],
            ]:  # many at once: joined, parted where one is bad
                await stream.send(message)
            answers = await read_until(stream, 15)
            assert sum(each["type"] == "problem" for each in answers) == 1

    asyncio.run(run())
    assert [each["number"] for each in served.http.get(f"/v1/tracks/{track}/steps").json()["steps"]] == list(range(15))


def test_a_message_that_is_too_large_ends_the_connection(served: Served) -> None:
    track = served.new_track()

    async def run() -> int | None:
        async with served.stream(track) as stream:
            await read(stream)
            await stream.send("x" * (2**20 + 1))
            with pytest.raises(ConnectionClosed):
                await read(stream)
            return stream.close_code

    assert asyncio.run(run()) == 1009


def test_who_may_not_is_refused_before_it_is_opened(served: Served) -> None:
    track, ended = served.new_track(), served.new_track()
    served.http.post(f"/v1/tracks/{ended}/end")
    for to, key, headers, status, kind in (
        (track, None, {}, 401, "unauthorised"),
        (track, "isd_unknown", {}, 401, "unauthorised"),
        (track, READER, {}, 403, "forbidden"),
        (track, STRANGER, {}, 404, "not-found"),
        ("nothing", KEY, {}, 404, "not-found"),
        (ended, KEY, {}, 409, "conflict"),
        (track, KEY, {"Origin": "https://elsewhere.example"}, 403, "forbidden"),
    ):

        async def refused(to: str, key: str | None, headers: dict[str, str]) -> Any:
            with pytest.raises(InvalidStatus) as refusal:
                async with served.stream(to, key, headers=headers):
                    pass
            return refusal.value.response

        answer = asyncio.run(refused(to, key, headers))
        assert answer.status_code == status
        assert answer.headers["content-type"] == "application/problem+json"
        assert json.loads(answer.body)["type"].endswith(kind)


def test_a_browser_brings_its_key_as_a_subprotocol(served: Served) -> None:
    track = served.new_track()

    async def run() -> str | None:
        protocols = [Subprotocol("isodyn.v1"), Subprotocol(f"bearer.{KEY}")]
        ours = {"Origin": f"http://127.0.0.1:{served.port}"}
        async with served.stream(track, None, subprotocols=protocols, headers=ours) as stream:
            assert (await read(stream))["type"] == "ready"
            return stream.subprotocol

    assert asyncio.run(run()) == "isodyn.v1", "the key is not said again"


@pytest.mark.parametrize("why", ["ended", "removed", "revoked"])
def test_a_stream_ends_with_its_reason(served: Served, hall_steps: Callable[..., Steps], why: str) -> None:
    steps, track = hall_steps(count=20), served.new_track()
    context, key = served.app.state.context, KEY
    if why == "revoked":
        with context.transaction() as session:
            key = create_key(session, organisation="default", name="short", scopes=["locate"])

    async def run() -> tuple[dict[str, Any], int | None]:
        async with served.stream(track, key) as stream:
            await read(stream)
            await stream.send(steps_message(steps[:5]))
            await read(stream)
            if why == "ended":
                served.http.post(f"/v1/tracks/{track}/end")
            elif why == "removed":
                served.http.delete(f"/v1/tracks/{track}")
            else:
                identity = context.keys.recognise(key)
                with context.transaction() as session:
                    revoke_key(session, identity.key_id)
                await asyncio.sleep(2.1)
            await stream.send(steps_message(steps[5:10]))
            told = await read(stream)
            with pytest.raises(ConnectionClosed):
                await read(stream)
            return told, stream.close_code

    told, code = asyncio.run(run())
    assert told["type"] == "problem"
    assert (told["problem"]["status"], code) == {
        "ended": (409, 4409), "removed": (404, 4404), "revoked": (401, 4401),
    }[why]  # fmt: skip


def test_a_stream_on_which_nothing_comes_ends_with_its_key(served: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(auth, "RECHECK_S", 0.2)
    monkeypatch.setattr(key_ring, "RECENT_S", 0.1)
    track, context = served.new_track(), served.app.state.context
    with context.transaction() as session:
        key = create_key(session, organisation="default", name="idle", scopes=["locate"])

    async def run() -> tuple[dict[str, Any], int | None]:
        async with served.stream(track, key) as stream:
            await read(stream)
            with context.transaction() as session:
                session.query(Key).filter_by(name="idle").one().expires_at = utc_now()
            told = await read(stream)
            with pytest.raises(ConnectionClosed):
                await read(stream)
            return told, stream.close_code

    told, code = asyncio.run(run())
    assert (told["problem"]["status"], code) == (401, 4401)


def test_a_client_that_does_not_read_is_slowed_down_and_loses_nothing(
    served: Served, hall_steps: Callable[..., Steps], monkeypatch: pytest.MonkeyPatch
) -> None:
    """While the server is kept from following, what it reads ahead stays bounded, and sending comes to a halt."""
    steps, track = hall_steps(count=600), served.new_track()
    follower, held = served.app.state.context.follower, threading.Event()
    follow = follower.follow
    sizes: list[int] = []

    async def slow(*asked: Any) -> Any:
        sizes.append(len(asked[2]))
        while not held.is_set():
            await asyncio.sleep(0.01)
        return await follow(*asked)

    monkeypatch.setattr(follower, "follow", slow)
    pad = " " * 60_000  # of white space, which JSON allows: messages that fill the sockets' buffers

    async def run() -> None:
        async with served.stream(track, compression=None, write_limit=2**16) as stream:
            await read(stream)
            came = 0

            async def send_all() -> None:
                nonlocal came
                for step in steps:
                    await stream.send(step_message(step) + pad)
                    came += 1

            sending = asyncio.create_task(send_all())
            await asyncio.sleep(1.5)
            assert not sending.done(), "the client is made to wait"
            halted = came
            await asyncio.sleep(0.3)
            assert came == halted
            held.set()
            reading = asyncio.create_task(read_until(stream, 600))
            await sending
            assert (await reading)[-1]["next_step"] == 600

    asyncio.run(run())
    assert max(sizes) <= MOST_AHEAD_BYTES / 60_000 + 2
    assert [e["number"] for e in served.http.get(f"/v1/tracks/{track}/steps").json()["steps"]] == list(range(600))


def test_a_stream_that_is_faster_than_it_may_be_waits(
    served: Served, hall_steps: Callable[..., Steps], monkeypatch: pytest.MonkeyPatch
) -> None:
    steps, track = hall_steps(count=20), served.new_track()
    waits = iter([0.2, 0.2, 0.0])
    monkeypatch.setattr(served.app.state.context.step_rate, "take", lambda track_id, steps: next(waits, 0.0))

    async def run() -> float:
        async with served.stream(track) as stream:
            await read(stream)
            start = time.monotonic()
            await stream.send(steps_message(steps))
            assert (await read(stream))["next_step"] == 20
            return time.monotonic() - start

    assert asyncio.run(run()) >= 0.4
