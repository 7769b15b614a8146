"""Asking for work: atomic with the caller's rows, one waiting rebuild per floor, on both databases."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime

import pytest
from sqlalchemy import Engine, delete, func, select, text
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Floor, Job, Map, Worker
from app.errors import NotFound
from app.jobs import JobQueue
from app.jobs.queue import claim_generation


def a_map(session: Session, floor: Floor) -> Map:
    row = Map(organisation_id=floor.organisation_id, floor_id=floor.id, status="accepted", spec={}, survey_ids=[])
    session.add(row)
    return row


def engine_entries(engine: Engine, name: str) -> list[tuple[str, str, str]]:
    table = "dbos.workflow_status" if engine.dialect.name == "postgresql" else "workflow_status"
    query = f"SELECT status, queue_name, queue_partition_key FROM {table} WHERE workflow_uuid = :name"
    with engine.connect() as connection:
        return [tuple(row) for row in connection.execute(text(query), {"name": name})]


@pytest.fixture
def slots(sessions: sessionmaker[Session]) -> Iterator[None]:
    """A live worker with slots for everybody: what is enqueued is admitted at once."""
    with sessions.begin() as session:
        session.add(Worker(id="patient", state="live", beat=datetime.now(UTC), slots=1000))
    yield
    with sessions.begin() as session:
        session.execute(delete(Worker).where(Worker.id == "patient"))


@pytest.mark.usefixtures("slots")
def test_a_rebuild_is_a_row_and_an_entry(
    engine: Engine, sessions: sessionmaker[Session], queue: JobQueue, floor: Floor
) -> None:
    with sessions.begin() as session:
        job = queue.enqueue_rebuild(session, session.get_one(Floor, floor.id))
    assert (job.kind, job.status, job.progress, job.workflow_id) == ("rebuild", "accepted", 0, f"rebuild:{floor.id}:1")
    assert engine_entries(engine, job.workflow_id) == [("ENQUEUED", "floors", floor.id)]


@pytest.mark.usefixtures("slots")
def test_rolled_back_it_leaves_neither(
    engine: Engine, sessions: sessionmaker[Session], queue: JobQueue, floor: Floor
) -> None:
    with sessions() as session:
        rebuild = queue.enqueue_rebuild(session, session.get_one(Floor, floor.id))
        build = queue.enqueue_build(session, a_map(session, floor))
        names = [rebuild.workflow_id, build.workflow_id]
        session.rollback()
    with sessions() as session:
        assert session.scalars(select(Job).where(Job.floor_id == floor.id)).all() == []
    assert [engine_entries(engine, name) for name in names] == [[], []]


def test_uploads_share_the_waiting_rebuild(sessions: sessionmaker[Session], queue: JobQueue, floor: Floor) -> None:
    def upload(_: int) -> str:
        with sessions.begin() as session:
            return queue.enqueue_rebuild(session, session.get_one(Floor, floor.id)).id

    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(upload, range(24)))) == 1
    with sessions.begin() as session:  # it starts
        claim_generation(session, floor.id, 1)
    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(upload, range(24)))) == 1
    with sessions() as session:
        jobs = session.scalars(select(Job).where(Job.floor_id == floor.id).order_by(Job.id)).all()
    assert [job.workflow_id.rsplit(":", 1)[1] for job in jobs] == ["1", "2"]


@pytest.mark.usefixtures("slots")
def test_a_build_per_map(engine: Engine, sessions: sessionmaker[Session], queue: JobQueue, floor: Floor) -> None:
    with sessions.begin() as session:
        row = a_map(session, floor)
        job = queue.enqueue_build(session, row)
        assert queue.enqueue_build(session, row) is job
        assert (job.map_id, job.kind, job.workflow_id) == (row.id, "build", f"build:{row.id}")
    assert engine_entries(engine, job.workflow_id) == [("ENQUEUED", "floors", floor.id)]


def test_cancelling_a_waiting_rebuild_ends_it_and_the_next_upload_gets_a_new_one(
    sessions: sessionmaker[Session], queue: JobQueue, floor: Floor
) -> None:
    with sessions.begin() as session:
        first = queue.enqueue_rebuild(session, session.get_one(Floor, floor.id))
    with sessions.begin() as session:
        first = queue.request_cancel(session, session.get_one(Job, first.id))
        assert (first.status, first.cancel_requested) == ("dismissed", True)
        assert first.finished_at is not None
    with sessions.begin() as session:
        second = queue.enqueue_rebuild(session, session.get_one(Floor, floor.id))
    assert second.id != first.id
    assert second.status == "accepted"


def test_cancelling_a_waiting_build_ends_its_map(
    sessions: sessionmaker[Session], queue: JobQueue, floor: Floor
) -> None:
    with sessions.begin() as session:
        row = a_map(session, floor)
        job = queue.enqueue_build(session, row)
    with sessions.begin() as session:
        queue.request_cancel(session, session.get_one(Job, job.id))
    with sessions() as session:
        assert session.get_one(Map, row.id).status == "dismissed"


def test_cancelling_a_running_job_sets_the_flag_only(
    sessions: sessionmaker[Session], queue: JobQueue, floor: Floor
) -> None:
    with sessions.begin() as session:
        job = queue.enqueue_rebuild(session, session.get_one(Floor, floor.id))
        job.status = "running"
    with sessions.begin() as session:
        job = queue.request_cancel(session, session.get_one(Job, job.id))
        assert (job.status, job.cancel_requested) == ("running", True)


@pytest.mark.parametrize("status", ["successful", "failed", "dismissed"])
def test_cancelling_a_job_that_ended_changes_nothing(
    sessions: sessionmaker[Session], queue: JobQueue, floor: Floor, status: str
) -> None:
    with sessions.begin() as session:
        job = queue.enqueue_rebuild(session, session.get_one(Floor, floor.id))
        job.status = status
    with sessions.begin() as session:
        job = queue.request_cancel(session, session.get_one(Job, job.id))
        assert (job.status, job.cancel_requested) == (status, False)


def test_a_floor_that_is_gone_is_not_found(sessions: sessionmaker[Session], queue: JobQueue, floor: Floor) -> None:
    with sessions.begin() as session:
        gone = session.get_one(Floor, floor.id)
        session.delete(gone)
    with sessions() as session, pytest.raises(NotFound, match=floor.id):
        queue.enqueue_rebuild(session, gone)
    with sessions() as session:
        assert session.scalar(select(func.count()).select_from(Job).where(Job.floor_id == floor.id)) == 0
