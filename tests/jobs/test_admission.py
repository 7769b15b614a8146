"""Whose job is next: fair between organisations, by priority and age within one, never two of one floor."""

from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from typing import TYPE_CHECKING

import pytest
from prometheus_client import REGISTRY
from sqlalchemy import Engine, delete, select, text, update
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Floor, Job, Map, Worker
from app.jobs import JobQueue
from app.jobs.admission import HIGH, LOW, NORMAL
from app.jobs.engine import APPLICATION_VERSION, QUEUE, open_client
from workers.builder import DEFAULT_BUILDER, load_builder
from workers.reconcile import LOST_S, Reconciler
from workers.slots import Slots
from workers.workflows import WorkflowContext

if TYPE_CHECKING:
    from conftest import Site

Hire = Callable[[int | None], None]


@pytest.fixture
def hire(sessions: sessionmaker[Session]) -> Iterator[Hire]:
    """Rows of live workers with so many slots; before and after the test there is no worker and no job."""

    def clear() -> None:
        with sessions.begin() as session:
            session.execute(delete(Worker))
            session.execute(delete(Job))

    def hire(slots: int | None) -> None:
        with sessions.begin() as session:
            count = len(session.scalars(select(Worker.id)).all())
            session.add(Worker(id=f"worker {count}", state="live", beat=datetime.now(UTC), slots=slots))

    clear()
    yield hire
    clear()


def upload(site: "Site", floors: list[Floor]) -> list[str]:
    """Rebuilds of all floors, in one transaction: the jobs' ids."""
    with site.sessions.begin() as session:
        return [site.queue.enqueue_rebuild(session, session.get_one(Floor, floor.id)).id for floor in floors]


def ask(site: "Site", floor: Floor, priority: int) -> str:
    with site.sessions.begin() as session:
        row = Map(organisation_id=floor.organisation_id, floor_id=floor.id, status="accepted", spec={}, survey_ids=[])
        session.add(row)
        return site.queue.enqueue_build(session, row, priority).id


def in_hand(site: "Site") -> list[Job]:
    with site.sessions() as session:
        waiting = select(Job).where(Job.admitted_at.is_not(None), Job.status.in_(("accepted", "running")))
        return list(session.scalars(waiting.order_by(Job.admitted_at)))


def end(site: "Site", job_id: str) -> None:
    """As the worker does it: the last state and the next admission in one transaction."""
    with site.sessions.begin() as session:
        session.get_one(Job, job_id).status = "successful"
        site.queue.admit(session)


def admit(site: "Site") -> None:
    with site.sessions.begin() as session:
        site.queue.admit(session)


def known_to_the_engine(engine: Engine) -> list[str]:
    client = open_client(engine)
    names = [entry.workflow_id for entry in client.list_workflows(status="ENQUEUED")]
    client.destroy()
    return names


def say_in_the_engine(engine: Engine, workflow_id: str, status: str) -> None:
    schema = "dbos." if engine.dialect.name == "postgresql" else ""
    with engine.begin() as connection:
        said = text(f"UPDATE {schema}workflow_status SET status = :status WHERE workflow_uuid = :name")
        connection.execute(said, {"status": status, "name": workflow_id})


def test_without_a_worker_jobs_wait_in_our_table_only(site: "Site", hire: Hire, engine: Engine) -> None:
    (job_id,) = upload(site, [site.floor()])
    name = site.job(job_id).workflow_id
    assert name not in known_to_the_engine(engine)
    hire(1)
    admit(site)
    assert name in known_to_the_engine(engine)
    assert site.job(job_id).status == "accepted"


def context_of(site: "Site") -> WorkflowContext:
    """What the reaper of a worker works with."""
    return WorkflowContext(site.sessions, site.queue, "", load_builder(DEFAULT_BUILDER), DEFAULT_BUILDER, Slots(1), "w")


def ended() -> float:
    """The rebuilds that failed, as `/metrics` of a worker counts them."""
    return REGISTRY.get_sample_value("isodyn_jobs_ended_total", {"kind": "rebuild", "outcome": "failed"}) or 0.0


def test_one_with_many_waiting_does_not_starve_the_others(site: "Site", hire: Hire) -> None:
    hire(2)
    first = upload(site, site.floors(20))
    (second,) = upload(site, [site.floor()])
    running = [job.id for job in in_hand(site)]
    assert set(running) < set(first)
    assert len(running) == 2
    end(site, running[0])
    assert second in {job.id for job in in_hand(site)}


@pytest.mark.parametrize("slots", [1, 2, 5])
def test_while_all_wait_all_have_equal_shares(site: "Site", hire: Hire, slots: int) -> None:
    for count in (40, 20, 15):
        upload(site, site.floors(count))
    hire(slots)
    admit(site)
    served: Counter[str] = Counter()
    for _ in range(30):
        job = in_hand(site)[0]
        served[job.organisation_id] += 1
        end(site, job.id)
    assert sum(served.values()) == 30
    assert max(served.values()) - min(served.values()) <= 1


def test_within_an_organisation_priority_comes_before_age(site: "Site", hire: Hire) -> None:
    floors = site.floors(5)
    rebuild, other_rebuild = upload(site, floors[:2])
    low, normal, high = (ask(site, floor, p) for floor, p in zip(floors[2:], (LOW, NORMAL, HIGH), strict=True))
    hire(1)
    order = []
    admit(site)
    while jobs := in_hand(site):
        order.append(jobs[0].id)
        end(site, jobs[0].id)
    assert order == [high, normal, rebuild, other_rebuild, low]


def test_never_two_of_one_floor(site: "Site", hire: Hire) -> None:
    hire(5)
    floor = site.floor()
    jobs = [*upload(site, [floor]), ask(site, floor, NORMAL), ask(site, floor, HIGH)]
    assert [job.id for job in in_hand(site)] == [jobs[0]]
    end(site, jobs[0])
    assert [job.id for job in in_hand(site)] == [jobs[2]]


def test_admissions_at_once_keep_to_the_slots(site: "Site", hire: Hire) -> None:
    hire(2)
    hire(1)
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda _: upload(site, site.floors(3)), range(8)))
        for _ in range(3):
            now = [job.id for job in in_hand(site)]
            assert len(now) == 3
            list(pool.map(lambda job_id: end(site, job_id), now))


def test_a_waiting_job_that_is_cancelled_makes_room(site: "Site", hire: Hire) -> None:
    hire(1)
    first, second = upload(site, site.floors(2))
    assert site.cancel(first).status == "dismissed"
    assert [job.id for job in in_hand(site)] == [second]


def test_however_many_wait_a_job_that_the_engine_gave_up_is_closed(site: "Site", hire: Hire, engine: Engine) -> None:
    """More than a statement may have parameters."""
    hire(1)
    given_up, waiting = upload(site, site.floors(2))
    with engine.begin() as connection:
        columns = "organisation_id, floor_id, kind, priority, status, progress, message, cancel_requested, created_at"
        connection.execute(
            text(
                "WITH RECURSIVE n(k) AS (SELECT 1 UNION ALL SELECT k + 1 FROM n WHERE k < 70000) "
                f"INSERT INTO job (id, workflow_id, {columns}) SELECT 'copy ' || k, 'copy ' || k, {columns} "
                "FROM n, job WHERE id = :waiting"
            ),
            {"waiting": waiting},
        )
    client = open_client(engine)
    client.cancel_workflow(site.job(given_up).workflow_id)
    before = ended()
    reconciler = Reconciler(settled_s=0.0)
    for _ in range(2):
        reconciler.look(client, context_of(site))
    client.destroy()
    assert site.job(given_up).status == "failed"
    assert ended() == before + 1
    admit(site)
    assert [job.id for job in in_hand(site)] == [waiting]


def test_a_job_that_ended_in_the_engine_only_is_closed(site: "Site", hire: Hire, engine: Engine) -> None:
    hire(1)
    job_id = ask(site, site.floor(), NORMAL)
    with site.sessions.begin() as session:
        session.get_one(Job, job_id).status = "running"
    say_in_the_engine(engine, site.job(job_id).workflow_id, "SUCCESS")
    client = open_client(engine)
    Reconciler(settled_s=0.0).look(client, context_of(site))
    client.destroy()
    job = site.job(job_id)
    assert (job.status, job.message) == ("failed", "ended in the job engine without a result here; ask for it again")


def test_a_job_that_its_worker_never_heard_of_waits_anew(site: "Site", hire: Hire, engine: Engine) -> None:
    """The engine's answer was lost on its way to the worker, which lives."""
    hire(1)
    job_id = ask(site, site.floor(), NORMAL)
    say_in_the_engine(engine, site.job(job_id).workflow_id, "PENDING")
    client, patient, hasty = open_client(engine), Reconciler(settled_s=0.0), Reconciler(0.0, 0.0)
    patient.look(client, context_of(site))
    assert client.list_workflows(workflow_ids=[site.job(job_id).workflow_id], status="PENDING")
    for _ in range(2):
        hasty.look(client, context_of(site))
    client.destroy()
    assert site.job(job_id).admitted_at is None
    admit(site)
    assert known_to_the_engine(engine).count(site.job(job_id).workflow_id) == 1


@pytest.mark.parametrize("status", ["accepted", "running"])
def test_a_job_whose_record_in_the_engine_is_lost_waits_anew_once(
    site: "Site", hire: Hire, engine: Engine, status: str
) -> None:
    hire(2)
    floors = site.floors(2)
    lost, sound = ask(site, floors[0], NORMAL), ask(site, floors[1], NORMAL)
    with site.sessions.begin() as session:
        job = session.get_one(Job, lost)
        job.status, job.progress = status, 40
        session.get_one(Map, job.map_id).status = status
    sound_since = site.job(sound).admitted_at
    client = open_client(engine)
    patient, first, second = (Reconciler(lost_s, 0.0) for lost_s in (LOST_S, 0.0, 0.0))
    client.delete_workflows([job.workflow_id])
    patient.look(client, context_of(site))
    assert site.job(lost).status == status, "whoever is at work on it is given time to notice"
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda each: each.look(client, context_of(site)), (first, second)))
    waiting = site.job(lost)
    assert (waiting.status, waiting.progress, waiting.admitted_at) == ("accepted", 0, None)
    assert "lost" in waiting.message
    with site.sessions() as session:
        assert session.get_one(Map, waiting.map_id).status == "accepted"
    admit(site)
    again = site.job(lost).admitted_at
    assert again is not None
    for each in (first, second, patient):
        each.look(client, context_of(site))
    client.destroy()
    assert (site.job(lost).admitted_at, site.job(sound).admitted_at) == (again, sound_since)
    assert known_to_the_engine(engine).count(job.workflow_id) == 1


def test_beside_a_worker_of_an_older_version_all_are_admitted(site: "Site", hire: Hire) -> None:
    """It ends jobs without admitting the next."""
    hire(1)
    hire(None)
    upload(site, site.floors(6))
    assert len(in_hand(site)) == 6


def test_a_job_that_an_older_version_enqueued_is_one_job(site: "Site", hire: Hire, engine: Engine) -> None:
    (job_id,) = upload(site, [floor := site.floor()])
    name = site.job(job_id).workflow_id
    client = open_client(engine)
    options = {"workflow_name": "rebuild", "workflow_id": name, "queue_name": QUEUE, "queue_partition_key": floor.id,
               "app_version": APPLICATION_VERSION}  # fmt: skip
    client.enqueue(options, floor.id, 1)
    client.destroy()
    hire(1)
    admit(site)
    assert known_to_the_engine(engine).count(name) == 1
    with site.sessions.begin() as session:  # run by the older worker, it takes a slot though nobody admitted it
        session.execute(update(Job).values(status="running", admitted_at=None))
    upload(site, [site.floor()])
    assert in_hand(site) == []


def test_jobs_of_a_restored_database_are_admitted_anew(site: "Site", hire: Hire, queue: JobQueue) -> None:
    hire(1)
    (job_id,) = upload(site, [site.floor()])
    hire(1)
    with site.sessions.begin() as session:
        queue.enqueue_again(session, session.get_one(Job, job_id), "restored")
    assert in_hand(site) == []
    admit(site)
    assert [job.id for job in in_hand(site)] == [job_id]
