"""Reports of a running job: into its row, not too often, and with the cancel flag as the answer."""

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
        session.get_one(Job, job_id).status = "running"
    return job_id


@pytest.mark.parametrize(("fraction", "progress"), [(0.0, 0), (0.256, 26), (1.0, 100), (7.0, 100), (-1.0, 0)])
def test_a_report_is_in_the_row(site: "Site", job_id: str, fraction: float, progress: int) -> None:
    asked: list[int] = []
    reporter = JobReporter(site.sessions, job_id, still_owner=asked.append, owner_interval_s=0.0)
    reporter.report(fraction, "tile 3 of 12")
    job = site.job(job_id)
    assert (job.progress, job.message) == (progress, "tile 3 of 12")
    assert asked == [progress]


def test_reports_too_close_together_are_dropped(site: "Site", job_id: str) -> None:
    reporter = JobReporter(site.sessions, job_id, still_owner=lambda _: None, interval_s=60.0)
    reporter.report(0.1, "first")
    reporter.report(0.2, "second")
    assert site.job(job_id).message == "first"


def test_a_cancel_request_is_raised(site: "Site", job_id: str) -> None:
    reporter = JobReporter(site.sessions, job_id, still_owner=lambda _: None, interval_s=0.0)
    reporter.report(0.1, "on the way")
    site.cancel(job_id)
    with pytest.raises(JobCancelled):
        reporter.report(0.2, "still on the way")


def test_a_job_that_ended_or_is_gone_counts_as_cancelled(site: "Site", job_id: str) -> None:
    with site.sessions.begin() as session:
        session.execute(update(Job).where(Job.id == job_id).values(status="failed", message="given up"))
    with pytest.raises(JobCancelled):
        JobReporter(site.sessions, job_id, still_owner=lambda _: None).report(0.5, "late")
    assert site.job(job_id).message == "given up"


def test_who_is_not_the_owner_writes_nothing(site: "Site", job_id: str) -> None:
    def refuse(_progress: int) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        JobReporter(site.sessions, job_id, still_owner=refuse, owner_interval_s=0.0).report(0.5, "from a zombie")
    assert site.job(job_id).progress == 0


def test_the_owner_is_not_asked_for_at_every_report(site: "Site", job_id: str) -> None:
    asked: list[int] = []
    reporter = JobReporter(site.sessions, job_id, still_owner=asked.append, interval_s=0.0, owner_interval_s=60.0)
    for percent in (10, 20):
        reporter.report(percent / 100, "on the way")
    assert site.job(job_id).progress == 20
    assert asked == []
