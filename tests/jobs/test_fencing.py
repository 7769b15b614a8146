"""Two tries at one job, of which one has lost it without knowing: what it does afterwards changes nothing."""

from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

import pytest
from sqlalchemy import select
from sqlalchemy.orm import undefer

from app.blobs import open_blob_store
from app.db.tables import Floor, Job, Map, Worker
from app.errors import JobCancelled
from app.jobs.queue import locked_job
from workers.builder import load_builder
from workers.slots import Slots
from workers.workflows import Claim, Fenced, JobRun, WorkflowContext

if TYPE_CHECKING:
    from conftest import Site

BUILDER = "tests.jobs.fake_builder"


@pytest.fixture
def context(site: "Site", tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[WorkflowContext]:
    monkeypatch.setenv("ISODYN_TEST_DIARY", str(tmp_path / "diary"))
    worker = Worker(id=str(uuid4()), state="live", beat=datetime.now(UTC), slots=1)
    with site.sessions.begin() as session:
        session.add(worker)
    blob_url = f"file://{tmp_path / 'blobs'}"
    open_blob_store(blob_url)
    context = WorkflowContext(site.sessions, site.queue, blob_url, load_builder(BUILDER), BUILDER, Slots(1), worker.id)
    yield context
    context.fits.close()
    with site.sessions.begin() as session:
        session.delete(session.get_one(Worker, worker.id))


@pytest.fixture
def workflow_id(site: "Site", floor: Floor) -> str:
    _, job_id = site.upload(floor)
    return site.job(job_id).workflow_id


def job_of(site: "Site", workflow_id: str) -> Job:
    with site.sessions() as session:
        return session.scalars(select(Job).options(undefer(Job.plan)).where(Job.workflow_id == workflow_id)).one()


def claimed(run: JobRun) -> Claim:
    claim = run.claim()
    assert isinstance(claim, Claim)
    return claim


def test_who_takes_over_builds_what_was_claimed_first(
    site: "Site", context: WorkflowContext, workflow_id: str, floor: Floor
) -> None:
    first = claimed(JobRun(context, workflow_id, 1))
    site.upload(floor)
    second = claimed(JobRun(context, workflow_id, 1))
    assert (second.plan, second.was_claimed, first.was_claimed) == (first.plan, True, False)


def test_only_the_last_try_publishes(site: "Site", context: WorkflowContext, workflow_id: str) -> None:
    zombie, heir = JobRun(context, workflow_id, 1), JobRun(context, workflow_id, 1)
    plan = claimed(zombie).plan
    claimed(heir)
    assert zombie.publish(plan, {"sha256": "0" * 64}) == "skipped"
    assert zombie.close("failed", "out of its mind") == zombie.close("cancelled", "") == "skipped"
    assert job_of(site, workflow_id).status == "running"
    assert heir.publish(plan, {"sha256": "1" * 64}) == "published"
    assert heir.publish(plan, {"sha256": "2" * 64}) == "published", "its answer was lost, and it asks again"
    with site.sessions() as session:
        assert session.get_one(Map, plan["map_id"]).grid_sha256 == "1" * 64
    job = job_of(site, workflow_id)
    assert (job.status, job.plan) == ("successful", None)


def test_a_claim_whose_answer_was_lost_is_made_again(site: "Site", context: WorkflowContext, workflow_id: str) -> None:
    run = JobRun(context, workflow_id, 1)
    assert claimed(run).plan == claimed(run).plan
    assert run.run() == "published"


def test_a_zombie_runs_to_its_end_and_leaves_the_job_to_the_heir(
    site: "Site", context: WorkflowContext, workflow_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    zombie, heir = JobRun(context, workflow_id, 1), JobRun(context, workflow_id, 1)
    publish = zombie.publish

    def late(plan: dict[str, object], result: dict[str, object]) -> str:
        claimed(heir)
        return publish(plan, result)

    monkeypatch.setattr(zombie, "publish", late)
    assert zombie.run() == "skipped"
    assert job_of(site, workflow_id).status == "running"


def test_a_zombie_does_not_end_a_job_that_waits_anew(
    site: "Site", context: WorkflowContext, workflow_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    zombie = JobRun(context, workflow_id, 1)

    def late(plan: dict[str, object], result: dict[str, object]) -> str:
        with site.sessions.begin() as session:
            site.queue.enqueue_again(session, locked_job(session, workflow_id), "its record was lost")
        raise JobCancelled("it is not yours any more")

    monkeypatch.setattr(zombie, "publish", late)
    assert zombie.run() == "skipped"
    job = job_of(site, workflow_id)
    assert (job.status, job.fencing_token, job.plan) == ("accepted", None, None)
    assert JobRun(context, workflow_id, 1).run() == "published"


def test_a_worker_that_was_declared_dead_claims_nothing(
    site: "Site", context: WorkflowContext, workflow_id: str
) -> None:
    """It was stopped before its claim, and goes on when the job has long been another's."""
    heir = JobRun(context, workflow_id, 1)
    plan = claimed(heir).plan
    with site.sessions.begin() as session:
        session.get_one(Worker, context.worker_id).state = "dead"
    with pytest.raises(Fenced):
        JobRun(context, workflow_id, 1).run()
    assert heir.publish(plan, {"sha256": "1" * 64}) == "published"


def test_a_cancel_counts_until_the_map_is_there(
    site: "Site", context: WorkflowContext, workflow_id: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = JobRun(context, workflow_id, 1)
    publish = run.publish

    def late(plan: dict[str, object], result: dict[str, object]) -> str:
        site.cancel(job_of(site, workflow_id).id)
        return publish(plan, result)

    monkeypatch.setattr(run, "publish", late)
    assert run.run() == "cancelled"
    assert job_of(site, workflow_id).status == "dismissed"


def test_a_job_that_was_cancelled_while_its_worker_was_dead_ends(
    site: "Site", context: WorkflowContext, workflow_id: str
) -> None:
    claimed(JobRun(context, workflow_id, 1))
    site.cancel(job_of(site, workflow_id).id)
    assert JobRun(context, workflow_id, 1).run() == "cancelled"
    assert job_of(site, workflow_id).status == "dismissed"


def test_what_cannot_be_claimed_leaves_nothing_half_made(site: "Site", context: WorkflowContext) -> None:
    _, job_id = site.upload(site.floor(fail_claim=True))
    assert JobRun(context, site.job(job_id).workflow_id, 1).run() == "failed"
    job = site.job(job_id)
    assert (job.status, job.map_id) == ("failed", None)
    assert "upload a survey" in job.message
