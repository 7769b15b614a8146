"""How long a job waits for an idle worker, and what the worker costs while it waits.

Run: python benchmarks/job_latency.py [DATABASE_URL]. Default: SQLite in a temporary folder. This file is also the
builder the worker loads: its builds take no time, so what is measured is the queue.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

from sqlalchemy.orm import Session, sessionmaker

from app.db.engine import create_database_engine, migrate, session_factory
from app.db.tables import Building, Floor, Job, Organisation
from app.jobs import JobQueue

JOBS = 20
IDLE_S = 10.0
LATENCY_TARGET_S = 0.5
IDLE_TARGET = 0.10
START = (
    "from app.settings import Settings; from workers.main import run_worker; "
    "run_worker(Settings(), builder='job_latency')"
)


def claim_build(session: Session, job_id: str) -> dict[str, Any]:
    session.get_one(Job, job_id).status = "running"
    return {"claimed_at": time.time()}


def fit_build(plan: dict[str, Any], _blobs: object, _progress: object, _board: object) -> dict[str, Any]:
    return plan


def publish_build(session: Session, job_id: str, _plan: dict[str, Any], result: dict[str, Any]) -> None:
    job = session.get_one(Job, job_id)
    job.status, job.result = "successful", result


def fail_build(session: Session, job_id: str, message: str) -> None:
    job = session.get_one(Job, job_id)
    job.status, job.message = "failed", message


def dismiss_build(session: Session, job_id: str) -> None:
    session.get_one(Job, job_id).status = "dismissed"


def make_floor(sessions: sessionmaker[Session]) -> Floor:
    with sessions.begin() as session:
        organisation = Organisation(name=f"benchmark {time.time_ns()}")
        session.add(organisation)
        session.flush()
        building = Building(organisation_id=organisation.id, name="b")
        session.add(building)
        session.flush()
        floor = Floor(organisation_id=organisation.id, building_id=building.id, name="f", ordinal=0, elevation_m=0.0)
        session.add(floor)
    return floor


def run_job(sessions: sessionmaker[Session], queue: JobQueue, floor: Floor) -> tuple[float, float]:
    """Seconds from the commit of the request to the start of the job, and to its end."""
    with sessions.begin() as session:
        job_id = queue.enqueue_rebuild(session, session.get_one(Floor, floor.id)).id
    committed = time.time()
    while True:
        with sessions() as session:
            job = session.get_one(Job, job_id)
        if job.status == "failed":
            sys.exit(job.message)
        if job.status == "successful":
            assert job.result is not None
            return job.result["claimed_at"] - committed, time.time() - committed
        time.sleep(0.01)


def cpu_s(pid: int) -> float:
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def rss_mib(pid: int) -> float:
    line = next(line for line in Path(f"/proc/{pid}/status").read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        url = sys.argv[1] if len(sys.argv) > 1 else f"sqlite:///{folder}/isodyn.db"
        migrate(url)
        engine = create_database_engine(url)
        sessions, queue = session_factory(engine), JobQueue(engine)
        floor = make_floor(sessions)
        path = os.pathsep.join((str(Path(__file__).parent), str(Path(__file__).parents[1])))
        environment = {**os.environ, "ISODYN_DATABASE_URL": url, "ISODYN_DATA_DIR": folder, "PYTHONPATH": path}
        worker = subprocess.Popen([sys.executable, "-c", START], env=environment)
        try:
            _, started_s = run_job(sessions, queue, floor)
            runs = [run_job(sessions, queue, floor) for _ in range(JOBS)]
            before_s = cpu_s(worker.pid)
            time.sleep(IDLE_S)
            idle = (cpu_s(worker.pid) - before_s) / IDLE_S
            memory_mib = rss_mib(worker.pid)
        finally:
            worker.terminate()
            worker.wait()
            queue.close()
            engine.dispose()
    waits = sorted(wait for wait, _ in runs)
    print(f"worker start to first job done     {started_s:6.2f} s")
    print(f"request to running, idle worker    {median(waits):6.2f} s median, {waits[-1]:.2f} s worst of {JOBS}")
    print(f"request to successful, empty build {median(end for _, end in runs):6.2f} s median")
    print(f"idle worker                        {100 * idle:6.1f} % of one core, {memory_mib:.0f} MiB")
    if median(waits) > LATENCY_TARGET_S or idle > IDLE_TARGET:
        sys.exit(f"missed: at most {LATENCY_TARGET_S} s median to running and {IDLE_TARGET:.0%} of a core when idle")


if __name__ == "__main__":
    main()
