"""Two standing workers, real processes on both databases: jobs run, coalesce, fail, retry and stop as they should."""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import select

from app.blobs import FolderBlobStore
from app.db.tables import Floor, Job, Map, Survey
from app.jobs.engine import open_client

if TYPE_CHECKING:
    from conftest import Crew, Site


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("workers")


@pytest.fixture(scope="module")
def crew(database_url: str, folder: Path, crew_of: "type[Crew]", site: "Site") -> "Iterator[Crew]":
    crew = crew_of(database_url, folder)
    for _ in range(2):
        crew.hire(lease_ttl_s=15.0)
    yield crew
    crew.dismiss()
    print(crew.log)


def fits(crew: "Crew", floor: Floor) -> list[tuple[float, float]]:
    """When the fits of a floor began and ended."""
    began = {entry["map_id"]: entry["at"] for entry in crew.diary(event="fit starts", floor_id=floor.id)}
    return sorted((began[entry["map_id"]], entry["at"]) for entry in crew.diary(event="fit ends", floor_id=floor.id))


def test_a_job_runs_and_shows_its_progress(crew: "Crew", site: "Site", folder: Path) -> None:
    floor = site.floor(sleep_s=2.0)
    survey_id, job_id = site.upload(floor)
    seen = site.wait(job_id, lambda job: job.progress > 0)
    assert seen.status == "running"
    assert 0 < seen.progress < 100
    assert seen.message.startswith("slice")
    job = site.wait(job_id)
    assert (job.status, job.progress, job.message) == ("successful", 100, "the map is ready")
    with site.sessions() as session:
        row = session.get_one(Map, job.map_id)
        assert session.get_one(Floor, floor.id).active_map_id == row.id
    assert row.survey_ids == [survey_id]
    assert row.grid_sha256 is not None
    FolderBlobStore(folder / "blobs").get(row.grid_sha256)


def test_a_requested_map_is_built(crew: "Crew", site: "Site") -> None:
    floor = site.floor()
    with site.sessions.begin() as session:
        row = Map(organisation_id=floor.organisation_id, floor_id=floor.id, status="accepted", spec={}, survey_ids=[])
        session.add(row)
        job = site.queue.enqueue_build(session, row)
    assert site.wait(job.id).status == "successful"
    with site.sessions() as session:
        assert session.get_one(Map, row.id).status == "ready"


def test_concurrent_uploads_coalesce_and_none_is_missed(crew: "Crew", site: "Site") -> None:
    floors = [site.floor(sleep_s=0.4) for _ in range(3)]
    with ThreadPoolExecutor(10) as pool:
        uploads = list(pool.map(site.upload, floors * 10))
    for job_id in {job_id for _, job_id in uploads}:
        assert site.wait(job_id).status == "successful"
    for floor in floors:
        with site.sessions() as session:
            surveys = set(session.scalars(select(Survey.id).where(Survey.floor_id == floor.id)))
            active = session.get_one(Map, session.get_one(Floor, floor.id).active_map_id)
            jobs = session.scalars(select(Job).where(Job.floor_id == floor.id)).all()
        assert len(surveys) == 10
        assert set(active.survey_ids) == surveys
        assert len(jobs) < 10
        runs = fits(crew, floor)
        assert len(runs) == len(jobs)
        assert all(ended <= began for (_, ended), (began, _) in pairwise(runs))


def test_a_killed_fit_process_is_tried_again(crew: "Crew", site: "Site") -> None:
    floor = site.floor(sleep_s=0.2, die_times=1)
    _, job_id = site.upload(floor)
    assert site.wait(job_id).status == "successful"
    assert len(crew.diary(event="fit starts", floor_id=floor.id)) == 2


@pytest.mark.slow
def test_a_fit_killed_every_time_fails_after_a_bounded_number(crew: "Crew", site: "Site") -> None:
    floor = site.floor(die_times=100)
    job = site.wait(site.upload(floor)[1])
    assert job.status == "failed"
    assert "SIGKILL, often because memory ran out" in job.message
    assert "give the worker more memory" in job.message
    assert len(crew.diary(event="fit starts", floor_id=floor.id)) == 3


@pytest.mark.parametrize(
    ("orders", "message"),
    [
        ({"fail": True}, "walk the floor again"),
        ({"fail_claim": True}, "upload a survey"),
        ({"break": True}, "internal error in the fit (ZeroDivisionError: a fault of the program)"),
    ],
)
def test_a_failing_fit_fails_once_says_why_and_frees_the_floor(
    crew: "Crew", site: "Site", orders: dict[str, object], message: str
) -> None:
    floor = site.floor(**orders)
    _, first = site.upload(floor)
    job = site.wait(first)
    assert job.status == "failed"
    assert message in job.message
    assert len(crew.diary(event="fit starts", floor_id=floor.id)) == (0 if "fail_claim" in orders else 1)
    with site.sessions.begin() as session:
        session.get_one(Floor, floor.id).name = "{}"
    _, second = site.upload(floor)
    assert second != first
    assert site.wait(second).status == "successful"


@pytest.mark.parametrize("silent", [False, True])
def test_cancelling_a_running_fit_ends_it_and_frees_the_floor(crew: "Crew", site: "Site", silent: bool) -> None:
    floor = site.floor(sleep_s=30.0, silent=silent)
    _, first = site.upload(floor)
    site.wait(first, lambda job: bool(crew.diary(event="fit starts", floor_id=floor.id)))
    with site.sessions.begin() as session:
        session.get_one(Floor, floor.id).name = "{}"
    _, second = site.upload(floor)
    assert site.cancel(first).status == "running"
    assert site.wait(first).status == "dismissed"
    assert site.wait(second).status == "successful"
    with site.sessions() as session:
        assert session.get_one(Floor, floor.id).active_map_id == site.job(second).map_id
    (pid,) = {entry["pid"] for entry in crew.diary(event="fit starts", map_id=site.job(first).map_id)}
    with pytest.raises(ProcessLookupError):
        os.kill(pid, 0)


def test_a_job_cancelled_while_waiting_never_starts(crew: "Crew", site: "Site") -> None:
    floor = site.floor(sleep_s=2.5)
    _, running = site.upload(floor)
    site.wait_running(running)
    _, waiting = site.upload(floor)
    assert site.cancel(waiting).status == "dismissed"
    survey_id, later = site.upload(floor)
    assert later != waiting
    assert site.wait(running).status == "successful"
    done = site.wait(later)
    with site.sessions() as session:
        row = session.get_one(Map, done.map_id)
    assert survey_id in row.survey_ids
    assert len(row.survey_ids) == 3
    assert (site.job(waiting).status, site.job(waiting).map_id) == ("dismissed", None)


def test_a_floor_deleted_while_it_is_fitted_troubles_nobody(crew: "Crew", site: "Site") -> None:
    floor = site.floor(sleep_s=2.5)
    _, job_id = site.upload(floor)
    site.wait_running(job_id)
    with site.sessions.begin() as session:
        for table in (Map, Survey, Job):
            for row in session.scalars(select(table).where(table.floor_id == floor.id)):
                session.delete(row)
        session.delete(session.get_one(Floor, floor.id))
    after = site.floor()
    assert site.wait(site.upload(after)[1]).status == "successful"


def test_a_job_cancelled_in_the_engine_by_an_operator_does_not_stay_open(crew: "Crew", site: "Site") -> None:
    floor = site.floor(sleep_s=8.0)
    _, running = site.upload(floor)
    site.wait_running(running)
    client = open_client(site.engine)
    client.cancel_workflow(site.job(running).workflow_id)
    client.destroy()
    job = site.wait(running)
    assert (job.status, job.message) == ("failed", "cancelled in the job engine by an operator")
    assert site.wait(site.upload(floor)[1]).status == "successful"


def test_a_running_job_whose_record_in_the_engine_is_lost_goes_on(crew: "Crew", site: "Site") -> None:
    floor = site.floor(sleep_s=4.0)
    _, job_id = site.upload(floor)
    site.wait_running(job_id)
    client = open_client(site.engine)
    client.delete_workflows([site.job(job_id).workflow_id])
    client.destroy()
    assert site.wait(job_id).status == "successful"
    assert len(crew.diary(event="fit starts", floor_id=floor.id)) == 1


def test_the_workers_log_says_nothing_untoward(crew: "Crew") -> None:
    assert "locked" not in crew.log
    assert "onductor" not in crew.log
    assert "Exception in thread" not in crew.log
    assert "could not look after" not in crew.log
