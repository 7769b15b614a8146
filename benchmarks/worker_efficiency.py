"""What workers cost beside the work: cores busy, seconds added to each job, latency, and the price of waiting.

Run: python benchmarks/worker_efficiency.py [DATABASE_URL] [--workers 4] [--jobs 60] [--cost 0.5]. Default: SQLite in a
temporary folder. A job spins `cost` seconds of CPU in its fit's process. This file is also the builder that the workers
load. Overhead of a job, where there are as many workers as cores: slots x wall / jobs - cost, so everything between
two fits of a slot.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, sessionmaker

from app.db.engine import create_database_engine, migrate, session_factory
from app.db.tables import Building, Floor, Job, Map, Organisation, Worker
from app.jobs import FINAL_STATES, JobQueue

START = (
    "from app.settings import Settings; from workers.main import run_worker; "
    "run_worker(Settings(), builder='worker_efficiency')"
)
BUSY_TARGET, OVERHEAD_TARGET_S = 0.90, 0.050
IDLE_S = 10.0
TICKS = os.sysconf("SC_CLK_TCK")


def claim_build(session: Session, job_id: str) -> dict[str, Any]:
    job = session.get_one(Job, job_id)
    job.status, job.started_at = "running", datetime.now(UTC)
    return {"cost_s": session.get_one(Map, job.map_id).spec["cost_s"], "claimed_at": time.time()}


def fit_build(plan: dict[str, Any], _blobs: object, _progress: object) -> dict[str, Any]:
    began, cpu_s = time.time(), time.process_time()
    while time.process_time() - cpu_s < plan["cost_s"]:
        sum(range(1000))
    return {"claimed_at": plan["claimed_at"], "began": began, "ended": time.time()}


def publish_build(session: Session, job_id: str, _plan: dict[str, Any], result: dict[str, Any]) -> None:
    job = session.get_one(Job, job_id)
    job.status, job.result, job.finished_at = "successful", result, datetime.now(UTC)


def fail_build(session: Session, job_id: str, message: str) -> None:
    job = session.get_one(Job, job_id)
    job.status, job.message = "failed", message


def dismiss_build(session: Session, job_id: str) -> None:
    session.get_one(Job, job_id).status = "dismissed"


class Installation:
    """A database, workers, and jobs that spin."""

    def __init__(self, url: str, folder: str, code: str = START) -> None:
        migrate(url)
        self.engine = create_database_engine(url)
        self.sessions: sessionmaker[Session] = session_factory(self.engine)
        self.queue = JobQueue(self.engine)
        path = os.pathsep.join((str(Path(__file__).parent), str(Path(__file__).parents[1])))
        self._environment = {**os.environ, "ISODYN_DATABASE_URL": url, "ISODYN_DATA_DIR": folder, "PYTHONPATH": path}
        self.workers: list[subprocess.Popen[bytes]] = []
        self._code = code

    def start(self) -> subprocess.Popen[bytes]:
        return subprocess.Popen([sys.executable, "-c", self._code], env=self._environment)

    def hire(self, count: int) -> None:
        """Start workers, and wait until they live."""
        self.workers = [self.start() for _ in range(count)]
        while len(self._live()) < count:
            time.sleep(0.1)

    def dismiss(self) -> None:
        for worker in self.workers:
            worker.send_signal(signal.SIGTERM)
        for worker in self.workers:
            worker.wait()
        self.workers = []

    def _live(self) -> list[str]:
        with self.sessions() as session:
            return list(session.scalars(select(Worker.id).where(Worker.state == "live")))

    def ask(self, count: int, cost_s: float) -> list[str]:
        """So many jobs, each on a floor of its own."""
        with self.sessions.begin() as session:
            owner = Organisation(name=f"benchmark {time.time_ns()}")
            session.add(owner)
            session.flush()
            building = Building(organisation_id=owner.id, name="b")
            session.add(building)
            session.flush()
            ids = []
            for _ in range(count):
                floor = Floor(organisation_id=owner.id, building_id=building.id, name="f", ordinal=0, elevation_m=0.0)
                session.add(floor)
                session.flush()
                spec = {"cost_s": cost_s}
                row = Map(organisation_id=owner.id, floor_id=floor.id, status="accepted", spec=spec, survey_ids=[])
                session.add(row)
                ids.append(self.queue.enqueue_build(session, row).id)
        return ids

    def wait(self, ids: list[str]) -> list[dict[str, float]]:
        """What the jobs noted, when all have ended."""
        while True:
            with self.sessions() as session:
                jobs = session.scalars(select(Job).where(Job.id.in_(ids))).all()
                if all(job.status in FINAL_STATES for job in jobs):
                    return [job.result for job in jobs if job.result is not None]
            time.sleep(0.25)

    def close(self) -> None:
        self.dismiss()
        self.queue.close()
        self.engine.dispose()


def busy_s() -> float:
    """CPU seconds that all cores of the machine have worked so far, whoever they worked for."""
    fields = [int(each) for each in Path("/proc/stat").read_text().splitlines()[0].split()[1:]]
    return (sum(fields[:8]) - fields[3] - fields[4]) / TICKS


def cpu_s(pid: int) -> float:
    """CPU seconds of a process without its children."""
    fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    return (int(fields[11]) + int(fields[12])) / TICKS


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("database_url", nargs="?")
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--jobs", type=int, default=60)
    parser.add_argument("--cost", type=float, default=0.5)
    asked = parser.parse_args()
    cores = os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder:
        installation = Installation(asked.database_url or f"sqlite:///{folder}/isodyn.db", folder)
        try:
            installation.hire(asked.workers)
            installation.wait(installation.ask(2 * asked.workers, 0.0))  # every worker has a warm child
            began, busy = time.time(), busy_s()
            runs = installation.wait(installation.ask(asked.jobs, asked.cost))
            last = max(run["ended"] for run in runs)
            first = min(run["began"] for run in runs)
            wall_s = last - first
            share = (busy_s() - busy) / (cores * (time.time() - began))
            worked = asked.jobs * asked.cost / (cores * wall_s)
            print(f"{asked.workers} workers, {cores} cores, {asked.jobs} jobs of {asked.cost:.2f} s CPU each: "
                  f"{wall_s:.1f} s")  # fmt: skip
            print(
                f"cores busy with fits               {100 * worked:6.1f} % (all that ran on them: {100 * share:.0f} %)"
            )
            installation.dismiss()

            installation.hire(cores)
            installation.wait(installation.ask(2 * cores, 0.0))
            runs = installation.wait(installation.ask(asked.jobs, asked.cost))
            wall_s = max(run["ended"] for run in runs) - min(run["began"] for run in runs)
            spun_s = median(run["ended"] - run["began"] for run in runs)
            overhead_s = cores * wall_s / asked.jobs - spun_s
            print(f"{cores} workers: a job adds                {1000 * overhead_s:6.0f} ms to its {spun_s:.2f} s")

            waits = []
            for _ in range(20):
                time.sleep(0.3)
                sent = time.time()
                (run,) = installation.wait(installation.ask(1, 0.0))
                waits.append((run["claimed_at"] - sent, run["began"] - sent))
            claimed_ms, begun_ms = ([1000 * each for each in column] for column in zip(*waits, strict=True))
            print(f"request to claimed, idle workers   {median(claimed_ms):6.0f} ms median, {max(claimed_ms):.0f} worst"
                  f", to its fit {median(begun_ms):.0f}")  # fmt: skip
            time.sleep(3.0)
            before = [cpu_s(worker.pid) for worker in installation.workers]
            time.sleep(IDLE_S)
            idle = [
                (cpu_s(worker.pid) - was) / IDLE_S for worker, was in zip(installation.workers, before, strict=True)
            ]
            print(f"an idle worker burns               {100 * max(idle):6.1f} % of a core")
        finally:
            installation.close()
    if worked < BUSY_TARGET or overhead_s > OVERHEAD_TARGET_S:
        sys.exit(f"missed: at least {BUSY_TARGET:.0%} busy and at most {1000 * OVERHEAD_TARGET_S:.0f} ms a job")


if __name__ == "__main__":
    main()
