"""Limits of keys, organisations and the process: what is refused, how it says so, and that it ends."""

import asyncio
import gzip
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from sqlalchemy import event
from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.testclient import TestClient

import app.api.body as body_module
from app.api.admission import Admission, BodyMemory
from app.api.auth import recognised
from app.api.body import BodyLimit, upload
from app.api.context import Context
from app.api.key_limits import KeyLimits
from app.db.tables import Building, Floor, Key, Survey
from app.errors import Overloaded, QuotaExceeded, TooMany
from app.main import create_app, first_start
from app.services.manage_keys import create_key
from app.settings import Settings
from tests.api.conftest import make_walk_csv
from tests.services.test_file_readers import large_parquet

ADMIN, OTHER = "isd_the-admin-of-limits", "isd_another-key-of-it"
ELSEWHERE = "isd_a-key-of-another-organisation"


@pytest.fixture(scope="module")
def context(database_url: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Context, TestClient]]:
    """A service with narrow limits."""
    settings = Settings(
        data_dir=tmp_path_factory.mktemp("data"), database_url=database_url, admin_key=ADMIN, max_buildings=3,
        max_floors_per_building=2, max_surveys_per_floor=2, max_surveys=3, max_requests_per_s=50.0,
        max_requests_per_key=5, max_keys=4, parse_memory_bytes=2**28,
    )  # fmt: skip
    first_start(settings)
    application = create_app(settings)
    made: Context = application.state.context
    with made.transaction() as session:
        create_key(session, organisation="default", name="other", scopes=["admin"], secret=OTHER)
    with TestClient(application, headers={"Authorization": f"Bearer {ADMIN}"}) as http:
        yield made, http


@pytest.fixture
def http(context: tuple[Context, TestClient]) -> TestClient:
    context[0].key_limits._uses.clear()  # a full bucket for every test
    return context[1]


def add(http: TestClient, path: str, **body: Any) -> Any:
    return http.post(path, json=body)


def is_quota(answer: Any, words: str) -> bool:
    told = answer.json()
    return bool(answer.status_code == 409 and told["type"].endswith("/quota") and words in told["detail"])


def test_an_organisation_may_keep_so_much(context: tuple[Context, TestClient], http: TestClient) -> None:
    building = add(http, "/v1/buildings", name="A").json()["id"]
    floors = [add(http, f"/v1/buildings/{building}/floors", name="F", ordinal=k, auto_build=False).json()["id"]
              for k in (0, 1)]  # fmt: skip
    assert is_quota(add(http, f"/v1/buildings/{building}/floors", name="F", ordinal=2), "2 floors")
    level = {"type": "Feature", "feature_type": "level", "properties": {"ordinal": 7, "name": {"en": "Roof"}},
             "geometry": {"type": "Polygon", "coordinates": [[[0, 0], [9, 0], [9, 9], [0, 0]]]}}  # fmt: skip
    answer = add(http, f"/v1/buildings/{building}/floors:import", type="FeatureCollection", features=[level])
    assert is_quota(answer, "2 floors")
    for name in ("B", "C"):
        assert add(http, "/v1/buildings", name=name).status_code == 201
    assert is_quota(add(http, "/v1/buildings", name="D"), "3 buildings")

    counted: list[str] = []

    def note(_c: object, _u: object, statement: str, *_: object) -> None:
        if "count(" in statement and "survey.organisation_id =" in statement:
            counted.append(statement)

    event.listen(context[0].engine, "before_cursor_execute", note)

    def upload(floor: str, seed: int, query: str = "") -> Any:
        counted.clear()
        return http.post(f"/v1/floors/{floor}/surveys{query}", content=make_walk_csv(seed, 4.0, 3.0))

    first = upload(floors[0], 1).json()["survey"]["id"]
    assert upload(floors[0], 2).status_code == 202
    assert len(counted) == 1, "all surveys of the organisation are counted once an upload"
    assert is_quota(upload(floors[0], 3), "2 surveys")
    assert upload(floors[0], 1).status_code == 200, "what is there already may be sent again"
    assert counted == []
    assert upload(floors[0], 3, f"?replaces={first}").status_code == 202, "one comes, one goes"
    assert len(counted) == 1
    assert upload(floors[1], 4).status_code == 202
    assert is_quota(upload(floors[1], 5), "3 surveys")
    blobs = sum(1 for _ in http.app.state.context.blobs.stored())  # type: ignore[attr-defined]
    assert is_quota(upload(floors[1], 6), "3 surveys")
    assert sum(1 for _ in http.app.state.context.blobs.stored()) == blobs, "nothing of it is stored"  # type: ignore[attr-defined]
    survey = http.get(f"/v1/floors/{floors[1]}/surveys").json()["items"][0]["id"]
    assert http.delete(f"/v1/surveys/{survey}").status_code == 204
    assert upload(floors[1], 5).status_code == 202
    event.remove(context[0].engine, "before_cursor_execute", note)


def test_a_file_that_takes_more_memory_than_it_may_is_refused_and_nothing_else(
    context: tuple[Context, TestClient], http: TestClient
) -> None:
    made, _ = context
    building = http.get("/v1/buildings").json()["items"][0]["id"]
    floor = http.get(f"/v1/buildings/{building}/floors").json()["items"][0]["id"]
    before = sum(1 for _ in made.blobs.stored()), len(http.get(f"/v1/floors/{floor}/surveys").json()["items"])
    survey = http.get(f"/v1/floors/{floor}/surveys").json()["items"][0]["id"]
    url = f"/v1/floors/{floor}/surveys?replaces={survey}"
    refused = http.post(f"{url}&format=parquet", content=large_parquet(1_990_000))
    assert refused.status_code == 422
    assert refused.json()["type"].endswith("/unreadable-survey")
    assert any(word in refused.json()["detail"] for word in ("memory", "malloc", "ended the process"))
    assert before == (
        sum(1 for _ in made.blobs.stored()), len(http.get(f"/v1/floors/{floor}/surveys").json()["items"]),
    )  # fmt: skip
    assert http.post(url, content=make_walk_csv(77, 4.0, 3.0)).status_code == 202


def test_so_many_keys_may_live(context: tuple[Context, TestClient], http: TestClient) -> None:
    made = [add(http, "/v1/keys", name="k", scopes=["locate"]) for _ in range(2)]
    assert [answer.status_code for answer in made] == [201, 201]
    assert is_quota(add(http, "/v1/keys", name="k", scopes=["locate"]), "4 keys")
    first, second = (answer.json()["id"] for answer in made)
    assert is_quota(add(http, f"/v1/keys/{first}:rotate", overlap_s=60), "4 keys")
    rotated = add(http, f"/v1/keys/{first}:rotate", overlap_s=0)
    assert rotated.status_code == 201, "one comes, one goes"
    with context[0].transaction() as session:
        owner = session.query(Floor.organisation_id).limit(1).scalar()
        session.add(Key(organisation_id=owner, name="s", sha256="0" * 64, scopes=[], issuer="i", subject="anna"))
    assert http.delete(f"/v1/keys/{second}").status_code == 204
    last = add(http, "/v1/keys", name="k", scopes=["locate"])
    assert last.status_code == 201
    for key in (rotated, last):
        assert http.delete(f"/v1/keys/{key.json()['id']}").status_code == 204


def test_survey_files_may_take_so_many_bytes(context: tuple[Context, TestClient], http: TestClient) -> None:
    made, _ = context
    with made.transaction() as session:
        floor = session.query(Floor).first()
        assert floor is not None
        size = sum(survey.raw_bytes or 0 for survey in session.query(Survey))
        assert size > 0
        exact = replace(made.quotas, survey_bytes=size)
        exact.check_surveys(session, floor.organisation_id)
        for quotas, coming_bytes in ((exact, 1), (replace(made.quotas, survey_bytes=size - 1), 0)):
            with pytest.raises(QuotaExceeded, match="would be more than"):
                quotas.check_surveys(session, floor.organisation_id, coming_bytes=coming_bytes)


def test_a_key_that_asks_too_often_is_told_when_it_may(http: TestClient) -> None:
    answers = [http.get("/v1/buildings") for _ in range(2)]
    left = [int(each.headers["RateLimit"].split(";")[1].removeprefix("r=")) for each in answers]
    assert left[0] == 499
    assert 498 <= left[1] <= 499
    assert answers[0].headers["RateLimit-Policy"] == '"requests";q=500;w=10'
    limits: KeyLimits = http.app.state.context.key_limits  # type: ignore[attr-defined]
    (use,) = limits._uses.values()
    use.left = -50.0
    refused = http.get("/v1/buildings")
    assert refused.status_code == 429
    assert refused.json()["type"].endswith("/too-many")
    assert refused.headers["Retry-After"] in ("1", "2")
    other = {"Authorization": f"Bearer {OTHER}"}
    assert http.get("/v1/buildings", headers=other).status_code == 200, "other keys are not affected"
    assert use.requests == 0, "the refused one has ended, too"


def test_a_batch_counts_as_its_windows(http: TestClient) -> None:
    building = http.get("/v1/buildings").json()["items"][0]["id"]
    window = {"frame": "norm", "noise_ut": 0.5, "b_ut": [48.0, 49.0, 50.0],
              "displacement_m": [[0, 0, 0], [1, 0, 0], [2, 0, 0]]}  # fmt: skip
    before = http.post(f"/v1/buildings/{building}/locate", json={"window": window})
    batch = http.post(f"/v1/buildings/{building}/locate:batch", json={"queries": [{"window": window}] * 20})
    assert batch.status_code == 200, batch.text
    left = [int(each.headers["RateLimit"].split(";")[1].removeprefix("r=")) for each in (before, batch)]
    assert 15 <= left[0] - left[1] <= 20


def limits(**more: Any) -> tuple[KeyLimits, list[float]]:
    now = [100.0]
    return KeyLimits(**{"per_s": 2.0, "requests": 3, "streams": 2, **more}, clock=lambda: now[0]), now


def test_a_bucket_empties_and_fills() -> None:
    made, now = limits()
    for _ in range(20):
        scope: dict[str, Any] = {}
        made.begin("a", scope)
        made.end(scope)
    with pytest.raises(TooMany) as refused:
        made.begin("a", {})
    assert refused.value.retry_after_s == pytest.approx(0.5)
    made.begin("b", {})
    now[0] += 0.5
    made.end(scope := {"isodyn.key": made._uses["a"]})
    made.begin("a", scope)
    assert made.headers(scope)[1] == (b"ratelimit", b'"requests";r=0;t=10')


def test_so_many_requests_and_streams_are_open_at_one_time() -> None:
    made, _ = limits()
    open_ones: list[dict[str, Any]] = [{} for _ in range(3)]
    for scope in open_ones:
        made.begin("a", scope)
    refused: dict[str, Any] = {}
    with pytest.raises(TooMany, match="3 requests open"):
        made.begin("a", refused)
    made.end(refused)
    made.end(open_ones[0])
    made.begin("a", {})
    with made.stream("a"), made.stream("a"):
        with pytest.raises(TooMany, match="2 streams open"), made.stream("a"):
            pass
        with made.stream("b"):
            pass
    with made.stream("a"):
        pass


Messages = list[dict[str, Any]]


async def exchange(application: Any, messages: Messages, path: str = "/v1/x", never_ends: bool = False) -> Messages:
    sent: Messages = []

    async def receive() -> dict[str, Any]:
        if not messages and never_ends:
            await asyncio.sleep(60)
        return messages.pop(0)

    async def send(message: Any) -> None:
        sent.append(message)

    await application({"type": "http", "path": path, "method": "POST", "headers": []}, receive, send)
    return sent


async def ok(scope: Any, receive: Callable[[], Any], send: Callable[[Any], Any]) -> None:
    await receive()
    await send({"type": "http.response.start", "status": 200, "headers": []})
    await send({"type": "http.response.body"})


def part(size: int, more: bool = False) -> dict[str, Any]:
    return {"type": "http.request", "body": b"x" * size, "more_body": more}


def test_a_body_that_does_not_come_is_not_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(body_module, "PATIENCE_S", 0.05)
    limit = BodyLimit(ok, 1000, BodyMemory(10_000, 1.0), lambda path: False)
    sent = asyncio.run(exchange(limit, [part(10, more=True)], never_ends=True))
    assert sent[0]["status"] == 408


def test_bodies_share_so_much_memory_and_give_it_back() -> None:
    memory = BodyMemory(200_000, 0.05)
    limit = BodyLimit(ok, 10**6, memory, lambda path: False)

    async def scenario() -> list[int]:
        statuses = [(await exchange(limit, [part(150_000)]))[0]["status"]]
        async with memory.room(100_000, "a"):
            statuses.append((await exchange(limit, [part(80_000, True), part(80_000)]))[0]["status"])
            statuses.append((await exchange(limit, [part(1000)]))[0]["status"])
        statuses.append((await exchange(limit, [part(150_000)]))[0]["status"])
        return statuses

    assert asyncio.run(scenario()) == [200, 503, 200, 200]


def test_a_packed_file_that_does_not_say_so_takes_the_memory_of_what_it_unpacks_to() -> None:
    async def scenario() -> None:
        packed = gzip.compress(bytes(50_000))
        memory, coming = BodyMemory(100_000, 0.05), [{"type": "http.request", "body": packed}] * 2
        told = [(b"content-length", str(len(packed)).encode())]

        async def receive() -> dict[str, Any]:
            return coming.pop()

        def request() -> Request:
            return Request({"type": "http", "method": "POST", "path": "/", "headers": told}, receive)

        async with memory.room(60_000, "other"):
            with pytest.raises(Overloaded):
                async with upload(request(), 50_000, memory, "a"):
                    pass
        async with upload(request(), 50_000, memory, "a") as data:
            assert data == bytes(50_000)
            with pytest.raises(Overloaded):
                memory.take(50_001)
        memory.take(100_000)

    asyncio.run(scenario())


def test_an_upload_waits_for_room_in_turn_and_not_for_ever() -> None:
    async def scenario() -> None:
        memory = BodyMemory(100, 5.0)
        order: list[str] = []

        async def upload(name: str, size: int) -> None:
            async with memory.room(size, name):
                order.append(name)
                await asyncio.sleep(0.01)

        tasks = [asyncio.create_task(upload(name, size)) for name, size in (("a", 80), ("b", 90), ("c", 10))]
        await asyncio.sleep(0)
        cancelled = asyncio.create_task(upload("never", 100))
        await asyncio.sleep(0.001)
        cancelled.cancel()
        await asyncio.gather(*tasks)
        assert order == ["a", "b", "c"], "a small one does not overtake"
        async with memory.room(10**9, "d"):
            hasty = BodyMemory(100, 0.01)
            async with hasty.room(60, "a"):
                with pytest.raises(Overloaded):
                    async with hasty.room(60, "b"):
                        pass
                async with hasty.room(40, "c"):
                    pass

    asyncio.run(scenario())


def test_uploads_of_one_organisation_leave_room_for_others() -> None:
    """Its own wait for each other, and nobody else waits for those."""

    async def scenario() -> None:
        memory, enough, order = BodyMemory(100, 0.2), asyncio.Event(), []

        async def hold(count: int, organisation_id: str) -> None:
            async with memory.room(count, organisation_id):
                order.append(organisation_id)
                await enough.wait()

        first = [asyncio.create_task(hold(20, "slow")) for _ in range(2)]
        third = asyncio.create_task(hold(20, "slow"))
        others = [asyncio.create_task(hold(30, organisation_id)) for organisation_id in ("a", "b")]
        with pytest.raises(TooMany, match="this organisation's uploads") as refused:
            await third
        assert refused.value.retry_after_s is not None
        assert order == ["slow", "slow", "a", "b"]
        with pytest.raises(Overloaded):
            await hold(30, "c")
        later = asyncio.create_task(hold(20, "slow"))
        await asyncio.sleep(0)
        enough.set()
        await asyncio.gather(*first, *others, later)
        async with memory.room(90, "slow"):
            assert order[4:] == ["slow"], "one that is alone may take more than half"
        memory.take(100)

    asyncio.run(scenario())


def test_bodies_that_do_not_come_keep_nobody_out(tmp_path: Path) -> None:
    """From somebody without a key: a request is open once its body is there."""
    settings = Settings(data_dir=tmp_path, database_url=None, blob_url=None, admin_key=ADMIN, max_requests=2)
    first_start(settings)
    application = create_app(settings)
    most = settings.body_memory_bytes // settings.max_body_bytes

    async def ask(method: str, path: str, key: str = "", body: Messages | None = None) -> int:
        coming, statuses = list(body or [part(0)]), []

        async def receive() -> dict[str, Any]:
            return coming.pop(0) if coming else await asyncio.sleep(60, {})

        async def send(message: Any) -> None:
            statuses.append(message.get("status"))

        headers = [(b"authorization", f"Bearer {key}".encode())] if key else []
        scope = {"type": "http", "http_version": "1.1", "scheme": "http", "method": method, "path": path,
                 "query_string": b"", "headers": headers, "client": ("127.0.0.1", 1)}  # fmt: skip
        await application(scope, receive, send)
        return int(statuses[0])

    async def scenario() -> None:
        unfinished = part(settings.max_body_bytes, more=True)
        held = [asyncio.create_task(ask("POST", "/v1/buildings", body=[unfinished])) for _ in range(most)]
        await asyncio.sleep(0)
        assert await ask("GET", "/v1/buildings", ADMIN) == 200
        async with application.state.context.bodies.room(settings.max_upload_bytes, "a"):
            pass
        for each in held:
            each.cancel()
        await asyncio.gather(*held, return_exceptions=True)

    asyncio.run(scenario())


def test_so_many_requests_are_open_and_health_is_answered_all_the_same() -> None:
    async def scenario() -> None:
        enough = asyncio.Event()

        async def slow(scope: Any, receive: Any, send: Any) -> None:
            if scope["path"] == "/v1/slow":
                await enough.wait()
            await ok(scope, receive, send)

        admission = Admission(slow, 2)
        held = [asyncio.create_task(exchange(admission, [part(0)], "/v1/slow")) for _ in range(2)]
        await asyncio.sleep(0)
        refused = await exchange(admission, [part(0)])
        assert refused[0]["status"] == 503
        assert (b"retry-after", b"1") in refused[0]["headers"]
        assert (await exchange(admission, [part(0)], "/healthz"))[0]["status"] == 200
        enough.set()
        assert [(await each)[0]["status"] for each in held] == [200, 200]
        assert (await exchange(admission, [part(0)]))[0]["status"] == 200

    asyncio.run(scenario())


def test_streams_of_events_take_no_room_from_requests() -> None:
    async def scenario() -> None:
        enough = asyncio.Event()

        async def slow(scope: Any, receive: Any, send: Any) -> None:
            if scope["path"].endswith("/events"):
                await enough.wait()
            await ok(scope, receive, send)

        admission = Admission(slow, 4)
        held = asyncio.create_task(exchange(admission, [part(0)], "/v1/jobs/a/events"))
        await asyncio.sleep(0)
        refused = await exchange(admission, [part(0)], "/v1/jobs/b/events")
        assert refused[0]["status"] == 503
        assert (await exchange(admission, [part(0)]))[0]["status"] == 200
        enough.set()
        assert (await held)[0]["status"] == 200
        assert (await exchange(admission, [part(0)], "/v1/jobs/b/events"))[0]["status"] == 200

    asyncio.run(scenario())


def test_a_key_is_known_however_many_slow_requests_there_are(context: tuple[Context, TestClient]) -> None:
    made, _ = context

    async def scenario() -> None:
        enough = Event()
        slow = [asyncio.create_task(run_in_threadpool(enough.wait, 60)) for _ in range(100)]
        await asyncio.sleep(0.1)
        made.keys._recent.clear()
        try:
            assert (await asyncio.wait_for(recognised(made, ADMIN), 20)).may("admin")
        finally:
            enough.set()
            await asyncio.gather(*slow)

    asyncio.run(scenario())


def test_an_upload_that_would_wait_too_long_is_refused_before_it_is_read(
    context: tuple[Context, TestClient], http: TestClient
) -> None:
    building = http.get("/v1/buildings").json()["items"][0]["id"]
    floor = http.get(f"/v1/buildings/{building}/floors").json()["items"][0]["id"]
    damaged = {"content": b"no gzip", "headers": {"Content-Encoding": "gzip"}}
    assert http.post(f"/v1/floors/{floor}/surveys", **damaged).status_code == 422
    enough = Event()
    held = [context[0].uploads.submit(enough.wait, 60) for _ in range(2100)]
    try:
        assert http.post(f"/v1/floors/{floor}/surveys", **damaged).status_code == 503
        assert http.put(f"/v1/floors/{floor}/plan?metres_per_pixel=1", **damaged).status_code == 503
    finally:
        enough.set()
    assert all(each.result() for each in held)


def test_an_organisation_that_holds_its_share_of_uploads_is_told_so_and_another_is_served(
    context: tuple[Context, TestClient], http: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, _ = context
    monkeypatch.setattr(made.bodies, "_longest_wait_s", 0.05)
    with made.transaction() as session:
        create_key(session, organisation="elsewhere", name="other", scopes=["admin"], secret=ELSEWHERE)
    here = http.get("/v1/buildings").json()["items"][0]["id"]
    floor = http.get(f"/v1/buildings/{here}/floors").json()["items"][0]["id"]
    other = {"Authorization": f"Bearer {ELSEWHERE}"}
    there = http.post("/v1/buildings", json={"name": "A"}, headers=other).json()["id"]
    theirs = http.post(f"/v1/buildings/{there}/floors", json={"name": "F", "ordinal": 0}, headers=other).json()["id"]
    with made.transaction() as session:
        organisation_id = session.get_one(Building, here).organisation_id
    half = made.settings.body_memory_bytes * 3 // 8
    assert http.portal is not None
    with http.portal.wrap_async_context_manager(made.bodies.room(half, organisation_id)):
        refused = http.post(f"/v1/floors/{floor}/surveys", content=b"no survey")
        assert refused.status_code == 429
        assert refused.json()["type"].endswith("/too-many")
        assert refused.headers["Retry-After"] == "2"
        answer = http.post(f"/v1/floors/{theirs}/surveys", content=b"no survey", headers=other)
        assert answer.status_code == 422, answer.text


def test_a_database_that_is_away_keeps_no_server_from_stopping(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path, database_url=None, blob_url=None, admin_key=ADMIN)
    first_start(settings)
    application = create_app(settings)
    made: Context = application.state.context
    with TestClient(application, headers={"Authorization": f"Bearer {ADMIN}"}) as http:
        assert http.get("/v1/buildings").status_code == 200
        made.files.start()
        with made.engine.begin() as connection:
            connection.exec_driver_sql('ALTER TABLE "key" RENAME TO away')
    assert made.files._program is None, "what comes after was done, too"


def test_an_upload_larger_than_it_may_be_is_refused_by_its_header(http: TestClient, tmp_path: Path) -> None:
    floor = http.get(f"/v1/buildings/{http.get('/v1/buildings').json()['items'][0]['id']}/floors").json()["items"][0][
        "id"
    ]
    answer = http.post(f"/v1/floors/{floor}/surveys", content=b"x", headers={"Content-Length": str(10**9)})
    assert answer.status_code == 413
