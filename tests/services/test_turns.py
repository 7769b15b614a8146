"""Work in turns: in order of arrival, refused when it would wait too long, not done when nobody waits any more."""

import asyncio
import time
from collections.abc import Iterator
from threading import Event

import pytest

from app.errors import Overloaded
from app.services.turns import Turns


@pytest.fixture
def turns() -> Iterator[Turns]:
    made = Turns(1, "turn", 0.5)
    yield made
    made.shutdown()


def test_what_would_wait_too_long_is_refused_at_once_and_told_when(turns: Turns) -> None:
    for _ in range(30):
        turns.submit(time.sleep, 0.02).result()
    enough = Event()
    held = [turns.submit(enough.wait, 60) for _ in range(100)]
    with pytest.raises(Overloaded, match="100 others wait already") as refused:
        asyncio.run(turns.run(lambda: None))
    assert refused.value.retry_after_s == pytest.approx(turns.expected_wait_s)
    assert refused.value.retry_after_s > 0.5
    enough.set()
    assert all(each.result() for each in held)
    assert asyncio.run(turns.run(lambda: "again")) == "again", "it recovers at once"


def test_one_slow_work_does_not_close_the_door(turns: Turns) -> None:
    """The first of all, which loads what the others find loaded."""
    turns.submit(time.sleep, 0.7).result()
    enough = Event()
    turns.submit(enough.wait, 60)
    turns.check()
    enough.set()


def test_what_work_takes_is_known_soon_after_a_start(turns: Turns) -> None:
    for _ in range(2):
        turns.submit(time.sleep, 0.6).result()
    enough = Event()
    held = [turns.submit(enough.wait, 60) for _ in range(3)]
    try:
        with pytest.raises(Overloaded):
            turns.check()
    finally:
        enough.set()
    assert all(each.result() for each in held)


def test_nobody_waits_longer_than_may_be_when_nothing_is_known_yet(turns: Turns) -> None:
    done = []

    async def scenario() -> None:
        enough = Event()
        turns.submit(enough.wait, 60)
        late = asyncio.create_task(turns.run(lambda: done.append("late")))
        part = asyncio.create_task(turns.run(lambda: done.append("part"), admitted=True))
        await asyncio.sleep(0.6)
        enough.set()
        with pytest.raises(Overloaded, match="did not come"):
            await late
        await part

    asyncio.run(scenario())
    assert done == ["part"]


def test_whoever_comes_while_the_process_starts_waits() -> None:
    """Compiling may take a minute, once: it says nothing of what follows."""
    turns = Turns(1, "turn", 0.1, patient=True)

    async def scenario() -> None:
        enough = Event()
        turns.submit(enough.wait, 60)
        early = [asyncio.create_task(turns.run(lambda: "answer")) for _ in range(3)]
        await asyncio.sleep(0.3)
        enough.set()
        assert await asyncio.gather(*early) == ["answer"] * 3
        turns.hurry()
        turns.check()

    asyncio.run(scenario())
    turns.shutdown()


def test_work_is_not_done_for_a_client_that_has_gone(turns: Turns) -> None:
    done = []

    async def scenario() -> None:
        enough = Event()
        turns.submit(enough.wait, 60)

        async def gone() -> bool:
            return True

        waiting = asyncio.create_task(turns.run(lambda: done.append(1), gone))
        await asyncio.sleep(0.1)
        enough.set()
        with pytest.raises(Overloaded, match="gone"):
            await waiting

    asyncio.run(scenario())
    assert done == []


def test_no_thread_waits_for_an_event_loop_that_has_stopped(turns: Turns, monkeypatch: pytest.MonkeyPatch) -> None:
    """It would wait for ever, and with it the process that is to end."""
    monkeypatch.setattr("app.services.turns._TOLD_WITHIN_S", 0.1)
    enough, loop = Event(), asyncio.new_event_loop()

    async def gone() -> bool:
        return False

    try:
        turns.submit(enough.wait, 60)
        waiting = loop.create_task(turns.run(lambda: "done", gone))
        loop.run_until_complete(asyncio.sleep(0.1))
        enough.set()
        assert turns.submit(lambda: "next").result(10) == "next"
        with pytest.raises(Overloaded, match="stopping"):
            loop.run_until_complete(waiting)
    finally:
        loop.run_until_complete(loop.shutdown_default_executor())
        loop.close()


def test_a_fault_in_the_work_is_the_callers(turns: Turns) -> None:
    with pytest.raises(ZeroDivisionError):
        asyncio.run(turns.run(lambda: 1 // 0))
    assert asyncio.run(turns.run(lambda: 1)) == 1
