"""A worker whose blobs are in S3: its fits wait for a server that is gone, and go on when it is back."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING
from uuid import uuid4

import pytest
from sqlalchemy import Engine

from app.blobs import open_blob_store
from tests.s3_server import BUCKET, Server, Way

if TYPE_CHECKING:
    from tests.jobs.conftest import Crew, Site

pytestmark = pytest.mark.s3


@pytest.fixture(scope="module")
def database_url(sqlite_url: str) -> str:
    return sqlite_url


@pytest.fixture
def way(s3: Server, monkeypatch: pytest.MonkeyPatch) -> Iterator[Way]:
    way = Way(s3.port)
    monkeypatch.setenv("AWS_ENDPOINT_URL", way.url)
    yield way
    way.close()


@pytest.fixture
def crew(crew_of: "type[Crew]", way: Way, sqlite_url: str, tmp_path: Path, engine: Engine) -> "Iterator[Crew]":
    crew = crew_of(sqlite_url, tmp_path)
    crew.environment["ISODYN_BLOB_URL"] = f"s3://{BUCKET}/{uuid4().hex}"
    crew.hire()
    yield crew
    crew.dismiss()
    print(crew.log)


def test_a_fit_waits_for_its_blobs(crew: "Crew", site: "Site", way: Way) -> None:
    way.cut()
    floor = site.floor(sleep_s=0.1)
    _, job_id = site.upload(floor)
    site.wait(job_id, lambda job: job.message == "waiting for the blob store")
    way.mend()
    job = site.wait(job_id)
    assert job.status == "successful", job.message
    assert len(crew.diary(event="fit starts", floor_id=floor.id)) >= 2
    (blob,) = open_blob_store(crew.environment["ISODYN_BLOB_URL"]).stored()
    assert job.result == {"sha256": blob.sha256}


@pytest.mark.slow
def test_a_fit_that_waits_can_be_cancelled(crew: "Crew", site: "Site", way: Way) -> None:
    way.cut()
    _, job_id = site.upload(site.floor(sleep_s=0.1))
    site.wait(job_id, lambda job: job.message == "waiting for the blob store")
    site.cancel(job_id)
    assert site.wait(job_id).status == "dismissed"
