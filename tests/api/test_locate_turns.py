"""Many windows at once: few are searched at one time, the others wait in order, and nobody is held up by a batch."""

import gc
import os
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from threading import Event
from typing import Any

import pytest
from sqlalchemy import event

from app.db.tables import Floor
from app.main import MOST_SEARCHES

SEARCH_THREADS = min(os.cpu_count() or 1, MOST_SEARCHES)
BODY: dict[str, Any] = {
    "window": {
        "frame": "level",
        "noise_ut": 0.5,
        "b_ut": [[19.8, 2.1, -43.0], [19.1, 2.6, -43.4], [18.2, 3.0, -44.1]],
        "displacement_m": [[0, 0, 0], [0.6, 0, 0], [1.2, 0, 0]],
    }
}


@pytest.fixture(scope="module", autouse=True)
def floor_in_memory(service: Any, mapped_floor: str) -> None:
    assert service.http.post(f"/v1/floors/{mapped_floor}/locate", json=BODY).status_code == 200


@pytest.fixture(scope="module")
def clients() -> Iterator[ThreadPoolExecutor]:
    with ThreadPoolExecutor(8) as pool:
        yield pool


@contextmanager
def occupied(service: Any, threads: int) -> Iterator[Event]:
    """That many of the search threads busy until the block or the event says otherwise."""
    enough, begun = Event(), [Event() for _ in range(threads)]
    for each in begun:
        service.context.searches.submit(lambda each=each: (each.set(), enough.wait(60)))
    assert all(each.wait(10) for each in begun)
    try:
        yield enough
    finally:
        enough.set()


def test_a_window_waits_for_a_free_thread_and_holds_up_nobody_else(
    service: Any, mapped_floor: str, clients: ThreadPoolExecutor
) -> None:
    with occupied(service, SEARCH_THREADS) as enough:
        waiting = [clients.submit(service.http.post, f"/v1/floors/{mapped_floor}/locate", json=BODY) for _ in range(4)]
        assert not wait(waiting, timeout=0.5).done
        assert service.http.get("/healthz").status_code == 200
        assert service.http.get(f"/v1/floors/{mapped_floor}").status_code == 200
        enough.set()
        answers = [each.result(timeout=30) for each in waiting]
    assert [answer.status_code for answer in answers] == [200] * 4
    timings = [answer.json()["timing_ms"] for answer in answers]
    assert all(timing["total"] >= 500 > timing["search"] > 0 for timing in timings), timings


def test_a_single_window_comes_between_those_of_a_batch(
    service: Any, mapped_floor: str, clients: ThreadPoolExecutor
) -> None:
    batch_began, looked_up = Event(), []

    def note(*arguments: Any) -> None:
        if "active_map_id" in arguments[2] and "organisation_id" in arguments[2]:  # not what keeps maps warm
            looked_up.append(time.perf_counter())
            batch_began.set()

    def ask(path: str, body: dict[str, Any]) -> tuple[int, float]:
        return service.http.post(path, json=body).status_code, time.perf_counter()

    event.listen(service.context.engine, "before_cursor_execute", note)
    try:
        with occupied(service, SEARCH_THREADS - 1):
            batch: Future[tuple[int, float]] = clients.submit(
                ask, f"/v1/floors/{mapped_floor}/locate:batch", {"queries": [BODY] * 100}
            )
            assert batch_began.wait(30)
            status, at = ask(f"/v1/floors/{mapped_floor}/locate", BODY)
            batch_status, batch_at = batch.result(timeout=120)
    finally:
        event.remove(service.context.engine, "before_cursor_execute", note)
    assert (status, batch_status) == (200, 200)
    assert len(looked_up) == 101
    assert at < batch_at
    assert sum(looked < at for looked in looked_up) < 60, "the single window waited for most of the batch"


def test_a_replay_takes_its_turn_window_by_window(
    service: Any, mapped_floor: str, clients: ThreadPoolExecutor, walk_csv: Any
) -> None:
    def ask(path: str, **body: Any) -> tuple[int, int, float]:
        answer = service.http.post(f"/v1/floors/{mapped_floor}/{path}", **body)
        return answer.status_code, len(answer.text.splitlines()), time.perf_counter()

    with occupied(service, SEARCH_THREADS) as enough:
        replayed = clients.submit(ask, "replay?every_m=1", content=walk_csv(9))
        assert not wait([replayed], timeout=1.0).done, "it waits like any window"
        single = clients.submit(ask, "locate", json=BODY)
        assert not wait([single], timeout=0.5).done
        assert service.http.get("/healthz").status_code == 200
        enough.set()
        status, _, at = single.result(timeout=60)
        replay_status, lines, replayed_at = replayed.result(timeout=120)
    assert (status, replay_status, lines > 50) == (200, 200, True)
    assert at < replayed_at, "the single window waited for all of the replay"


def test_what_another_process_changes_counts_at_once(service: Any, mapped_floor: str, active_map: str) -> None:
    """Nothing about floors and their active maps is remembered from one window to the next."""

    def answered_by() -> list[str]:
        return list(service.http.post(f"/v1/floors/{mapped_floor}/locate", json=BODY).json()["map_ids"])

    def point_to(map_id: str | None) -> None:
        with service.context.transaction() as session:
            session.get_one(Floor, mapped_floor).active_map_id = map_id

    assert answered_by() == [active_map]
    point_to(None)
    try:
        assert answered_by() == []
    finally:
        point_to(active_map)
    assert answered_by() == [active_map]


def test_once_warm_the_garbage_collector_leaves_the_application_alone(service: Any) -> None:
    """To look through every module and kernel again and again would stop all searches each time."""
    for thread in threading.enumerate():
        if thread.name == "warm-up":
            thread.join(timeout=120)
    assert gc.get_freeze_count() > 100_000
