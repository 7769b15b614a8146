"""Tiles offered to other workers: each taken once, brought to whoever asked, and no job lost with who took them."""

import json
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import delete, text, update
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import FolderBlobStore
from app.db.tables import Job, TileChunk
from app.jobs.tile_chunks import Chunk, ChunkBoard, bring_chunk, discard_stale_chunks, take_chunk
from workers.builder import DEFAULT_BUILDER, load_builder
from workers.helper import Helper
from workers.slots import Slots
from workers.workflows import WorkflowContext

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
    with sessions.begin() as session:
        session.execute(delete(TileChunk))


@pytest.fixture
def board(sessions: sessionmaker[Session], blob_store: FolderBlobStore, job_id: str) -> ChunkBoard:
    return ChunkBoard(sessions, blob_store, job_id)


def take(sessions: sessionmaker[Session], worker_id: str = "somebody") -> Chunk | None:
    with sessions.begin() as session:
        return take_chunk(session, worker_id)


def bring(sessions: sessionmaker[Session], chunk: Chunk | None, fits_sha256: str) -> bool:
    assert chunk is not None
    with sessions.begin() as session:
        return bring_chunk(session, chunk, fits_sha256)


def test_chunks_are_taken_from_the_end_and_brought(
    board: ChunkBoard, blob_store: FolderBlobStore, job_id: str, sessions: sessionmaker[Session]
) -> None:
    order_sha256, fits_sha256 = blob_store.put(b"order"), blob_store.put(b"fits")
    assert take(sessions) is None
    board.offer(order_sha256, 3)
    board.begin(0)
    chunk = take(sessions)
    assert chunk is not None
    assert chunk[1:] == (2, order_sha256, job_id)
    assert board.taken() == {2: None}
    assert bring(sessions, chunk, fits_sha256)
    board.begin(1)
    assert take(sessions) is None
    assert board.taken() == {2: fits_sha256}
    board.withdraw()
    assert board.taken() == {}
    assert not bring(sessions, chunk, fits_sha256)
    assert list(blob_store.stored()) == []


def test_a_later_order_takes_the_place_of_the_one_before(
    board: ChunkBoard, blob_store: FolderBlobStore, sessions: sessionmaker[Session]
) -> None:
    fits_sha256 = blob_store.put(b"fits")
    board.offer(ORDER, 2)
    first, second = take(sessions), take(sessions)
    bring(sessions, first, fits_sha256)
    board.offer(LATER, 2)
    assert board.taken() == {}
    assert not bring(sessions, second, "c" * 64)
    assert not blob_store.exists(fits_sha256)
    later = take(sessions)
    assert later is not None
    assert (later.number, later.order_sha256) == (1, LATER)


def test_offers_of_one_job_are_not_confused_while_the_database_is_away(
    board: ChunkBoard, sessions: sessionmaker[Session], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.jobs.tile_chunks.AWAY_S", 0.0)
    board.offer(ORDER, 2)
    chunk = take(sessions)
    with sessions.begin() as session:
        session.execute(text("ALTER TABLE tile_chunk RENAME TO away"))
    try:
        board.withdraw()
        board.offer(LATER, 2)
        board.begin(0)
        assert board.taken() == {}
    finally:
        with sessions.begin() as session:
            session.execute(text("ALTER TABLE away RENAME TO tile_chunk"))
    assert bring(sessions, chunk, "c" * 64)  # the rows of the first offer are there still
    assert board.taken() == {}


def test_a_database_that_is_away_is_not_asked_at_every_look(
    board: ChunkBoard, sessions: sessionmaker[Session], caplog: pytest.LogCaptureFixture
) -> None:
    board.offer(ORDER, 2)
    with sessions.begin() as session:
        session.execute(text("ALTER TABLE tile_chunk RENAME TO away"))
    try:
        for _ in range(100):
            assert board.taken() == {}
    finally:
        with sessions.begin() as session:
            session.execute(text("ALTER TABLE away RENAME TO tile_chunk"))
    assert len([each for each in caplog.records if "not shared" in each.message]) == 1


def test_no_two_workers_take_the_same_chunk(board: ChunkBoard, sessions: sessionmaker[Session]) -> None:
    board.offer(ORDER, 40)
    with ThreadPoolExecutor(4) as pool:
        taken = list(pool.map(lambda number: take(sessions, f"worker-{number % 4}"), range(44)))
    assert sorted(chunk.number for chunk in taken if chunk) == list(range(40))


def test_another_version_and_a_job_that_ended_offer_nothing(
    board: ChunkBoard, blob_store: FolderBlobStore, job_id: str, sessions: sessionmaker[Session]
) -> None:
    order_sha256 = blob_store.put(b"order")
    board.offer(order_sha256, 2)
    with sessions.begin() as session:
        session.execute(update(TileChunk).where(TileChunk.number == 1).values(version="0.0.0"))
    chunk = take(sessions)
    assert chunk is not None
    assert chunk.number == 0
    assert take(sessions) is None
    with sessions.begin() as session:
        session.execute(update(TileChunk).values(taken_by=None))
    assert discard_stale_chunks(sessions, blob_store) == 0
    with sessions.begin() as session:
        session.execute(update(Job).where(Job.id == job_id).values(status="failed"))
    assert take(sessions) is None
    assert discard_stale_chunks(sessions, blob_store) == 2
    assert list(blob_store.stored()) == []


@pytest.mark.parametrize("database_url", ["sqlite"], indirect=True)  # no database has a part in it
def test_a_helper_that_fails_leaves_the_chunks_to_others(
    board: ChunkBoard, site: "Site", blob_store: FolderBlobStore, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ISODYN_TEST_DIARY", str(tmp_path / "diary"))
    board.offer(blob_store.put(json.dumps({"floor_id": "f", "fail_chunk": True}).encode()), 40)
    builder, blob_url = load_builder(DEFAULT_BUILDER), f"file://{tmp_path / 'blobs'}"
    context = WorkflowContext(
        site.sessions, site.queue, blob_url, builder, "tests.jobs.fake_builder", Slots(2), "somebody"
    )
    stop = threading.Event()
    helping = threading.Thread(target=Helper(context).run, args=(stop,))
    helping.start()
    deadline = time.monotonic() + 30.0
    while not (tmp_path / "diary").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(1.5)  # for three more looks
    stop.set()
    helping.join()
    assert 1 <= len(board.taken()) <= 2  # one a slot


@pytest.mark.parametrize("database_url", [pytest.param("postgres", marks=pytest.mark.postgres)], indirect=True)
def test_a_worker_with_a_free_slot_helps_and_its_end_costs_no_job(crew: "Crew", site: "Site") -> None:
    crew.environment["ISODYN_WORKER_PROCESSES"] = "1"
    crew.hire(lease_ttl_s=30.0)
    alone = site.floor(chunks=2, sleep_s=1.5)
    _, job_id = site.upload(alone)
    assert site.wait(job_id).status == "successful"
    assert crew.diary(event="brought", floor_id=alone.id)[0]["taken"] == []

    crew.hire(data_dir="elsewhere", lease_ttl_s=30.0)
    site.wait_for_workers(2)
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
