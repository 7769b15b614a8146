"""Real workers: each has its slots, and one walk is not kept waiting by another organisation's two hundred."""

from collections import Counter
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import select

from app.db.tables import Floor, Job

if TYPE_CHECKING:
    from conftest import Crew, Site


@pytest.mark.slow
def test_each_worker_has_slots_of_its_own(crew: "Crew", site: "Site") -> None:
    crew.environment["ISODYN_WORKER_PROCESSES"] = "1"
    narrow = crew.hire()
    site.wait_for_workers(1)
    crew.environment["ISODYN_WORKER_PROCESSES"] = "3"
    wide = crew.hire()
    site.wait_for_workers(2)
    jobs = [site.upload(floor)[1] for floor in site.floors(4, sleep_s=6.0)]
    for job_id in jobs:
        site.wait_running(job_id)
    assert Counter(entry["worker"] for entry in crew.diary(event="fit starts")) == {narrow.pid: 1, wide.pid: 3}


@pytest.mark.slow
def test_two_hundred_waiting_floors_of_another_organisation_are_no_obstacle(crew: "Crew", site: "Site") -> None:
    many = site.floors(200, sleep_s=0.2)
    with site.sessions.begin() as session:
        jobs = [site.queue.enqueue_rebuild(session, session.get_one(Floor, floor.id)).id for floor in many]
    crew.environment["ISODYN_WORKER_PROCESSES"] = "1"
    crew.hire()
    site.wait(jobs[0], lambda _: len(crew.diary(event="fit ends")) > 0)
    one = site.floor()
    begun = len(crew.diary(event="fit starts"))
    _, job_id = site.upload(one)
    assert site.wait(job_id).status == "successful"
    (number,) = [n for n, entry in enumerate(crew.diary(event="fit starts")) if entry["floor_id"] == one.id]
    assert number - begun <= 1  # at most one that was admitted before it came
    with site.sessions() as session:
        assert len(session.scalars(select(Job.id).where(Job.status == "accepted")).all()) > 150
