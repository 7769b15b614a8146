"""What workers cost beside the work: cores busy, seconds added to each job, latency, and the price of waiting.

Run: python benchmarks/worker_efficiency.py [DATABASE_URL] [--workers 4] [--jobs 60] [--cost 0.5]. Default: SQLite in
a temporary folder. A job spins `cost` seconds of CPU in its fit's process. This file is also the builder that workers
load. Shares are of the core seconds that others on the machine left, from when each worker has ended a job until the
last jobs run, when cores idle for want of jobs. What a job adds is how many of them went by for each job beyond its
cost: work of workers, what its fit's process does besides, and idle cores. With as many workers as cores nothing hides
the time between two fits of a slot, which is printed too.
"""

import argparse
import os
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import suppress
from datetime import UTC, datetime
from itertools import pairwise
from pathlib import Path
from statistics import median
from typing import Any

from sqlalchemy import func, select
from sqlalchemy.orm import Session, sessionmaker

from app.db.engine import create_database_engine, migrate, session_factory
from app.db.tables import Building, Floor, Job, Map, Organisation, Worker
from app.jobs import FINAL_STATES, JobQueue

START = (
    "from app.settings import Settings; from workers.main import run_worker; "
    "run_worker(Settings(), builder='worker_efficiency')"
)
BUSY_TARGET, ADDED_TARGET_S = 0.90, 0.050
IDLE_S = 10.0
TICKS = os.sysconf("SC_CLK_TCK")


def claim_build(session: Session, job_id: str) -> dict[str, Any]:
    job = session.get_one(Job, job_id)
    job.status, job.started_at = "running", datetime.now(UTC)
    return {"cost_s": session.get_one(Map, job.map_id).spec["cost_s"], "claimed_at": time.time()}


def fit_build(plan: dict[str, Any], _blobs: object, _progress: object, _board: object) -> dict[str, Any]:
    began, cpu_s = time.time(), time.process_time()
    while time.process_time() - cpu_s < plan["cost_s"]:
        sum(range(1000))
    return {"claimed_at": plan["claimed_at"], "began": began, "ended": time.time(), "pid": os.getpid()}


def publish_build(session: Session, job_id: str, _plan: dict[str, Any], result: dict[str, Any]) -> None:
    job = session.get_one(Job, job_id)
    job.status, job.result, job.finished_at = "successful", result, datetime.now(UTC)


def fail_build(session: Session, job_id: str, message: str) -> None:
    job = session.get_one(Job, job_id)
    job.status, job.message = "failed", message


def dismiss_build(session: Session, job_id: str) -> None:
    session.get_one(Job, job_id).status = "dismissed"


def make_building(session: Session) -> Building:
    """One of an organisation of its own."""
    owner = Organisation(name=f"benchmark {time.time_ns()}")
    session.add(owner)
    session.flush()
    building = Building(organisation_id=owner.id, name="b")
    session.add(building)
    session.flush()
    return building


def make_floor(session: Session, building: Building) -> Floor:
    """One more."""
    floor = Floor(
        organisation_id=building.organisation_id, building_id=building.id, name="f", ordinal=0, elevation_m=0.0
    )
    session.add(floor)
    session.flush()
    return floor


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
            building, ids = make_building(session), []
            for _ in range(count):
                floor = make_floor(session, building)
                spec = {"cost_s": cost_s}
                row = Map(
                    organisation_id=floor.organisation_id,
                    floor_id=floor.id,
                    status="accepted",
                    spec=spec,
                    survey_ids=[],
                )
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

    def wait_for(self, ids: list[str], count: int) -> int:
        """Until so many of the jobs have ended: how many have."""
        ended = select(func.count()).where(Job.id.in_(ids), Job.status.in_(FINAL_STATES))
        while True:
            with self.sessions() as session:
                found = session.scalar(ended) or 0
            if found >= count:
                return found
            time.sleep(0.1)

    def close(self) -> None:
        self.dismiss()
        self.queue.close()
        self.engine.dispose()


def machine_s() -> tuple[float, float]:
    """Seconds that all cores worked so far, whoever for, and that they were idle."""
    fields = [int(each) for each in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    idle = fields[3] + fields[4]
    return (sum(fields) - idle) / TICKS, idle / TICKS


def cpu_s(pids: list[int], children: bool = True) -> float:
    """CPU seconds of processes, and of their children, those that have ended too."""
    total = 0
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):
            fields = (folder / "stat").read_text().rsplit(")", 1)[1].split()
            if int(folder.name) in pids:
                total += sum(int(each) for each in fields[11 : 15 if children else 13])
            elif children and int(fields[1]) in pids:
                total += int(fields[11]) + int(fields[12])
    return total / TICKS


def children_s(pids: list[int]) -> float:
    """CPU seconds of the children of processes."""
    return cpu_s(pids) - cpu_s(pids, children=False)


def gaps_s(runs: list[dict[str, float]]) -> list[float]:
    """Seconds from the end of a fit to the start of the next in the same process."""
    of_process: dict[float, list[dict[str, float]]] = {}
    for run in sorted(runs, key=lambda run: run["began"]):
        of_process.setdefault(run["pid"], []).append(run)
    return [after["began"] - before["ended"] for each in of_process.values() for before, after in pairwise(each)]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("database_url", nargs="?")
    parser.add_argument("--workers", type=int, default=4)
    parser.add_argument("--jobs", type=int, default=100)
    parser.add_argument("--cost", type=float, default=0.5)
    asked = parser.parse_args()
    cores = os.cpu_count() or 1
    with tempfile.TemporaryDirectory() as folder:
        installation = Installation(asked.database_url or f"sqlite:///{folder}/isodyn.db", folder)
        try:
            installation.hire(asked.workers)
            installation.wait(installation.ask(asked.workers, 2.0))  # so long that each takes one, and has a warm child
            pids = [worker.pid for worker in installation.workers]
            ids = installation.ask(asked.jobs + 3 * asked.workers, asked.cost)
            at_first = children_s(pids)
            ended = installation.wait_for(ids, asked.workers)
            before = (*machine_s(), cpu_s(pids), children_s(pids), time.time())
            jobs = installation.wait_for(ids, asked.jobs + asked.workers) - ended
            all_s, idle_s, ours_s, fits_s, wall_s = (
                now - was
                for now, was in zip((*machine_s(), cpu_s(pids), children_s(pids), time.time()), before, strict=True)
            )
            installation.wait(ids)
            besides_s = (children_s(pids) - at_first) / len(ids) - asked.cost  # that a fit's process does for a job
            left_s = ours_s + idle_s
            worked = (fits_s - jobs * besides_s) / left_s
            print(f"{asked.workers} workers, {cores} cores, {jobs} jobs of {asked.cost:.2f} s CPU each: "
                  f"{wall_s:.1f} s; others took {100 * (1 - left_s / (all_s + idle_s)):.0f} %")  # fmt: skip
            print(f"of the rest: fits {100 * worked:.1f} %, workers {100 * (ours_s / left_s - worked):.1f} %, "
                  f"idle {100 * idle_s / left_s:.1f} %")  # fmt: skip
            added_s = (left_s - fits_s) / jobs + besides_s
            print(f"a job adds to its cost             {1000 * added_s:6.0f} ms")
            installation.dismiss()

            installation.hire(cores)
            installation.wait(installation.ask(cores, 2.0))
            time.sleep(6.0)
            gaps = sorted(gaps_s(installation.wait(installation.ask(asked.jobs, asked.cost))))
            print(f"{cores} workers, between two fits         {1000 * sum(gaps) / len(gaps):6.0f} ms mean, "
                  f"{1000 * median(gaps):.0f} median, {1000 * gaps[-1]:.0f} worst")  # fmt: skip

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
            pids = [worker.pid for worker in installation.workers]
            burnt_s = cpu_s(pids, children=False)
            time.sleep(IDLE_S)
            idle = (cpu_s(pids, children=False) - burnt_s) / IDLE_S / len(pids)
            print(f"an idle worker burns               {100 * idle:6.1f} % of a core")
        finally:
            installation.close()
    if worked < BUSY_TARGET or added_s > ADDED_TARGET_S:
        sys.exit(f"missed: at least {BUSY_TARGET:.0%} busy with fits and at most {1000 * ADDED_TARGET_S:.0f} ms added")


if __name__ == "__main__":
    main()
