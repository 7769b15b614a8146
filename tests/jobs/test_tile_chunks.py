"""Tiles offered to other workers: each taken once, brought to whoever asked, and no job lost with who took them."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import func, select, update
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Job, TileChunk
from app.jobs.tile_chunks import Chunk, ChunkBoard, bring_chunk, delete_stale_chunks, take_chunk

if TYPE_CHECKING:
    from conftest import Crew, Site

ORDER, LATER = "a" * 64, "b" * 64


@pytest.fixture
def job_id(site: "Site", sessions: sessionmaker[Session]) -> Iterator[str]:
    """A job that runs, as far as its row says."""
    _, job_id = site.upload(site.floor())

    def to(status: str) -> None:
        with sessions.begin() as session:
            session.execute(update(Job).where(Job.id == job_id).values(status=status))

    to("running")
    yield job_id
    to("dismissed")
    ChunkBoard(sessions, job_id).withdraw()


def take(sessions: sessionmaker[Session], worker_id: str = "somebody") -> Chunk | None:
    with sessions.begin() as session:
        return take_chunk(session, worker_id)


def bring(sessions: sessionmaker[Session], chunk: Chunk | None, fits_sha256: str) -> bool:
    assert chunk is not None
    with sessions.begin() as session:
        return bring_chunk(session, chunk, fits_sha256)


def test_chunks_are_taken_from_the_end_and_brought(job_id: str, sessions: sessionmaker[Session]) -> None:
    board = ChunkBoard(sessions, job_id)
    assert take(sessions) is None
    board.offer(ORDER, 3)
    board.begin(0)
    chunk = take(sessions)
    assert chunk == Chunk(job_id, ORDER, 2)
    assert board.taken() == {2: None}
    assert bring(sessions, chunk, "c" * 64)
    board.begin(1)
    assert take(sessions) is None
    assert board.taken() == {2: "c" * 64}
    board.withdraw()
    assert board.taken() == {}
    assert not bring(sessions, chunk, "c" * 64)


def test_a_later_order_takes_the_place_of_the_one_before(job_id: str, sessions: sessionmaker[Session]) -> None:
    board = ChunkBoard(sessions, job_id)
    board.offer(ORDER, 2)
    chunk = take(sessions)
    board.offer(LATER, 2)
    assert board.taken() == {}
    assert not bring(sessions, chunk, "c" * 64)
    assert take(sessions) == Chunk(job_id, LATER, 1)


def test_no_two_workers_take_the_same_chunk(job_id: str, sessions: sessionmaker[Session]) -> None:
    ChunkBoard(sessions, job_id).offer(ORDER, 40)
    with ThreadPoolExecutor(4) as pool:
        taken = list(pool.map(lambda number: take(sessions, f"worker-{number % 4}"), range(44)))
    assert sorted(chunk.number for chunk in taken if chunk) == list(range(40))


def test_another_version_and_a_job_that_ended_offer_nothing(job_id: str, sessions: sessionmaker[Session]) -> None:
    ChunkBoard(sessions, job_id).offer(ORDER, 2)
    with sessions.begin() as session:
        session.execute(update(TileChunk).where(TileChunk.number == 1).values(version="0.0.0"))
    assert take(sessions) == Chunk(job_id, ORDER, 0)
    with sessions.begin() as session:
        session.execute(update(TileChunk).values(taken_by=None))
        assert delete_stale_chunks(session) == 0
        session.execute(update(Job).where(Job.id == job_id).values(status="failed"))
    assert take(sessions) is None
    with sessions.begin() as session:
        assert delete_stale_chunks(session) == 2
        assert session.scalar(select(func.count()).select_from(TileChunk)) == 0


def test_a_worker_with_a_free_slot_helps_and_its_end_costs_no_job(crew: "Crew", site: "Site") -> None:
    crew.environment["ISODYN_WORKER_PROCESSES"] = "1"
    crew.hire(lease_ttl_s=30.0)
    alone = site.floor(chunks=2, sleep_s=1.5)
    _, job_id = site.upload(alone)
    assert site.wait(job_id).status == "successful"
    assert crew.diary(event="brought", floor_id=alone.id)[0]["taken"] == []

    crew.hire(data_dir="elsewhere", lease_ttl_s=30.0)
    helped = site.floor(chunks=5, chunk_s=0.1, sleep_s=60.0)
    _, job_id = site.upload(helped)
    assert site.wait(job_id).status == "successful"
    brought = crew.diary(event="brought", floor_id=helped.id)[0]["brought"]
    assert brought == {str(number): f"chunk {number}" for number in range(5)}

    deserted = site.floor(chunks=1, kill_helper=True, sleep_s=60.0)
    _, job_id = site.upload(deserted)
    assert site.wait(job_id).status == "successful"
    assert len(crew.diary(event="chunk starts", floor_id=deserted.id)) == 1
    assert len(crew.diary(event="fit starts", floor_id=deserted.id)) == 1
