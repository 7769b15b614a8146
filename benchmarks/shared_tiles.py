"""What a second worker that has nothing else to do takes off the build of one large floor.

Both sides are real workers of one slot on the same cores and floor: one alone, and one beside it that helps. The maps
must be the same to the byte. Times are of whole builds: reading, learning (not shared), tiles, scores, storing.

    python benchmarks/shared_tiles.py [DATABASE_URL] [--side 200] [--workers 2]   exits 1 when a map differs, or when
                                            the build is not 1.4 times as fast with two workers on two free cores
"""

import argparse
import os
import sys
import tempfile
import time

from map_growth import SURVEY_SAMPLES, surveys
from sqlalchemy import func, select
from tqdm import tqdm
from worker_efficiency import Installation, make_building, make_floor

from app.blobs import open_blob_store
from app.db.tables import Floor, Job, Map, Survey, TileChunk
from app.jobs.tile_chunks import BUILDER
from app.services.artefacts import samples_to_bytes

START = "from app.settings import Settings; from workers.main import run_worker; run_worker(Settings())"
SAMPLES_PER_M2 = 20.0
REPEATS = 1
SPEC = {"kernel": "matern32", "resolution_m": 0.5, "components": "norm", "robust": True}
TARGET = 1.4


def make_walked_floor(installation: Installation, blob_url: str, side_m: float) -> Floor:
    """A square floor with its surveys."""
    blobs = open_blob_store(blob_url)
    count = max(SURVEY_SAMPLES * 4, round(SAMPLES_PER_M2 * side_m**2 / SURVEY_SAMPLES) * SURVEY_SAMPLES)
    with installation.sessions.begin() as session:
        floor = make_floor(session, make_building(session))
        for name, samples in tqdm(surveys(count, side_m**2).items(), desc=f"{side_m:g} m square", leave=False):
            sha256 = blobs.put(samples_to_bytes(samples))
            session.add(
                Survey(
                    organisation_id=floor.organisation_id, floor_id=floor.id, name=name, format="csv", frame="building",
                    raw_sha256=sha256, samples_sha256=sha256, sample_count=len(samples), report={},
                )
            )  # fmt: skip
    return floor


def build(installation: Installation, floor: Floor) -> tuple[float, str, int]:
    """Seconds from claim to publication, the map's hash, and the chunks that others were seen to have taken."""
    with installation.sessions.begin() as session:
        row = Map(organisation_id=floor.organisation_id, floor_id=floor.id, status="accepted", spec=SPEC, survey_ids=[])
        session.add(row)
        job_id = installation.queue.enqueue_build(session, row).id
    taken = 0
    while True:
        with installation.sessions() as session:
            job = session.get_one(Job, job_id)
            theirs = select(func.count()).where(TileChunk.job_id == job_id, TileChunk.taken_by != BUILDER)
            taken = max(taken, session.scalar(theirs) or 0)
            if job.finished_at is not None and job.started_at is not None:
                assert job.result is not None, job.message
                return (job.finished_at - job.started_at).total_seconds(), str(job.result["sha256"]), taken
        time.sleep(0.1)


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("database_url", nargs="?")
    parser.add_argument("--side", type=float, default=200.0)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeats", type=int, default=REPEATS)
    asked = parser.parse_args()
    os.environ["ISODYN_WORKER_PROCESSES"] = "1"
    with tempfile.TemporaryDirectory() as folder:
        blob_url = os.environ.setdefault("ISODYN_BLOB_URL", f"file://{folder}/blobs")
        installation = Installation(asked.database_url or f"sqlite:///{folder}/isodyn.db", folder, START)
        try:
            small, large = (make_walked_floor(installation, blob_url, side_m) for side_m in (60.0, asked.side))
            times_s: dict[int, list[float]] = {}
            hashes = set()
            for _ in range(asked.repeats):
                for workers in (1, asked.workers):
                    installation.hire(workers)
                    for _ in range(2):
                        build(installation, small)  # starts and compiles
                    took_s, sha256, taken = build(installation, large)
                    installation.dismiss()
                    times_s.setdefault(workers, []).append(took_s)
                    hashes.add(sha256)
                    load = os.getloadavg()[0]
                    print(
                        f"{workers} worker(s): {took_s:6.1f} s, {taken} chunks taken by others, load {load:.1f}",
                        flush=True,
                    )
        finally:
            installation.close()
    ratio = min(times_s[1]) / min(times_s[asked.workers])
    print(f"{asked.workers} workers are {ratio:.2f} times as fast as one; maps the same: {len(hashes) == 1}")
    return int(len(hashes) > 1 or ratio < TARGET)


if __name__ == "__main__":
    sys.exit(main())
