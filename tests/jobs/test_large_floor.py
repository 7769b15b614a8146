"""A floor large enough to share, fitted for real: its map is the same with help, and when the one it came from dies."""

import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from sqlalchemy import func, select
from sqlalchemy.orm import Session, sessionmaker

from app.blobs import FolderBlobStore
from app.db.tables import Floor, Map, Survey, TileChunk
from app.field.samples import Samples
from app.jobs.tile_chunks import BUILDER
from app.services.artefacts import samples_to_bytes

if TYPE_CHECKING:
    from conftest import Crew, Site

SIDE_M, SURVEYS = 70.0, 6
FIT = (
    "import json, sys; from app.settings import Settings; from workers.main import run_worker\n"
    "run_worker(Settings(), **json.loads(sys.argv[1]))"
)


def walk(seed: int) -> Samples:
    """Lanes all over the floor, in a field of waves."""
    rng = np.random.default_rng(seed)
    along = np.arange(0.0, 40 * SIDE_M, 0.3)
    lane, on_lane = np.divmod(along, SIDE_M)
    x_m, y_m = on_lane, (lane + rng.random()) * SIDE_M / 40
    p = np.stack([x_m, y_m, np.zeros_like(x_m)], axis=1)
    waves = [6.0 * np.sin(x_m / 0.7 + c) * np.cos(y_m / 0.8 - c) for c in range(3)]
    B = np.array([18.0, 3.0, -44.0]) + np.stack(waves, axis=1) + rng.normal(0.0, 0.3, p.shape)
    return Samples(0.5 * np.arange(len(p)), p, B, "building")


def ask(site: "Site", floor: Floor) -> str:
    with site.sessions.begin() as session:
        row = Map(
            organisation_id=floor.organisation_id, floor_id=floor.id, status="accepted", survey_ids=[], activate=True,
            spec={"components": "norm", "robust": True, "resolution_m": 1.0},
        )  # fmt: skip
        session.add(row)
        return site.queue.enqueue_build(session, row).id


def wait_for_help(sessions: sessionmaker[Session], job_id: str) -> str:
    """The id of the worker that has taken a chunk."""
    theirs = select(TileChunk.taken_by).where(TileChunk.job_id == job_id, TileChunk.taken_by != BUILDER)
    for _ in range(600):
        with sessions() as session:
            if helper := session.scalar(theirs.limit(1)):
                return helper
        time.sleep(0.05)
    pytest.fail("nobody helped")


@pytest.mark.slow
def test_a_large_floor_is_the_same_map_with_help_and_after_a_death(
    crew: "Crew", site: "Site", sessions: sessionmaker[Session], tmp_path: Path
) -> None:
    floor, blobs = site.floor(), FolderBlobStore(tmp_path / "blobs")
    with sessions.begin() as session:
        for seed in range(SURVEYS):
            samples = walk(seed)
            sha256 = blobs.put(samples_to_bytes(samples))
            session.add(
                Survey(
                    organisation_id=floor.organisation_id, floor_id=floor.id, name=f"{seed}", format="csv",
                    frame="building", raw_sha256=sha256, samples_sha256=sha256, sample_count=len(samples), report={},
                )
            )  # fmt: skip
    surveys = {blob.sha256 for blob in blobs.stored()}
    crew.environment["ISODYN_WORKER_PROCESSES"] = "1"
    first = crew.hire(code=FIT)
    alone = site.wait(ask(site, floor), patience_s=240.0)
    assert alone.status == "successful", alone.message

    second = crew.hire(data_dir="elsewhere", code=FIT)
    site.wait_for_workers(2)
    job_id = ask(site, floor)
    wait_for_help(sessions, job_id)
    together = site.wait(job_id, patience_s=240.0)
    with sessions() as session:
        maps = session.scalars(select(Map).where(Map.floor_id == floor.id)).all()
    named = {sha for row in maps for sha in (row.grid_sha256, row.quality_sha256, row.layers_sha256, row.state_sha256)}
    left = {blob.sha256 for blob in blobs.stored()} - surveys - named
    assert left == set()

    job_id = ask(site, floor)
    helper_pid = int(wait_for_help(sessions, job_id).split("-")[-2])
    builder = first if helper_pid == second.pid else second
    builder.send_signal(signal.SIGKILL)
    bereaved = site.wait(job_id, patience_s=240.0)

    results = [job.result for job in (alone, together, bereaved)]
    assert len({result["sha256"] for result in results if result}) == 1
    with sessions() as session:
        assert session.scalar(select(func.count()).select_from(TileChunk)) == 0
