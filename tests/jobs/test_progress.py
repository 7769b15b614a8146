"""Reports of a running job: into its row, not too often, and with the cancel flag as the answer."""

import time
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import update

from app.db.tables import Floor, Job
from app.errors import JobCancelled
from app.jobs.progress import JobReporter

if TYPE_CHECKING:
    from conftest import Site


@pytest.fixture
def job_id(site: "Site", floor: Floor) -> str:
    _, job_id = site.upload(floor)
    with site.sessions.begin() as session:
        job = session.get_one(Job, job_id)
        job.status, job.fencing_token = "running", "mine"
    return job_id


@pytest.mark.parametrize(("fraction", "progress"), [(0.0, 0), (0.256, 26), (1.0, 100), (7.0, 100), (-1.0, 0)])
def test_a_report_is_in_the_row(site: "Site", job_id: str, fraction: float, progress: int) -> None:
    reporter = JobReporter(site.sessions, job_id, "mine", interval_s=0.0)
    reporter.report(fraction, "tile 3 of 12")
    job = site.job(job_id)
    assert (job.progress, job.message) == (progress, "tile 3 of 12")


def test_reports_too_close_together_are_dropped(site: "Site", job_id: str) -> None:
    reporter = JobReporter(site.sessions, job_id, "mine", interval_s=0.5)
    reporter.report(0.1, "too early")
    assert site.job(job_id).progress == 0
    time.sleep(0.5)
    for percent in (20, 30):
        reporter.report(percent / 100, "on the way")
    assert site.job(job_id).progress == 20


def test_a_cancel_request_is_raised(site: "Site", job_id: str) -> None:
    reporter = JobReporter(site.sessions, job_id, "mine", interval_s=0.0)
    reporter.report(0.1, "on the way")
    site.cancel(job_id)
    with pytest.raises(JobCancelled):
        reporter.report(0.2, "still on the way")


def test_a_job_that_ended_or_is_gone_counts_as_cancelled(site: "Site", job_id: str) -> None:
    with site.sessions.begin() as session:
        session.execute(update(Job).where(Job.id == job_id).values(status="failed", message="given up"))
    with pytest.raises(JobCancelled):
        JobReporter(site.sessions, job_id, "mine", interval_s=0.0).report(0.5, "late")
    assert site.job(job_id).message == "given up"


def test_who_has_lost_the_job_writes_nothing_and_is_stopped(site: "Site", job_id: str) -> None:
    with pytest.raises(JobCancelled):
        JobReporter(site.sessions, job_id, "of an earlier try", interval_s=0.0).report(0.5, "from a zombie")
    assert site.job(job_id).progress == 0
