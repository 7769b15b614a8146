"""What a running job holds is known, so that nobody cleans it away: its surveys may be deleted while it reads them."""

from typing import Any

from app.services.references import carried_by_jobs

HELD = "d" * 64


def test_a_running_job_holds_the_blobs_of_its_plan(site: Any, crew: Any) -> None:
    floor = site.floor(sleep_s=60, surveys_read=[["survey", HELD, "building"]])
    _, job_id = site.upload(floor)
    with site.sessions() as session:
        assert HELD not in carried_by_jobs(session, site.queue), "it waits: what it will read is in the rows"
    crew.hire()
    site.wait_running(job_id)
    with site.sessions() as session:
        assert HELD in carried_by_jobs(session, site.queue)
    site.cancel(job_id)
    site.wait(job_id)
    with site.sessions() as session:
        assert HELD not in carried_by_jobs(session, site.queue)
