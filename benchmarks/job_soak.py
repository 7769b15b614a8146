"""Steady small jobs for as long as asked, with a worker killed now and then: what grows, what slows down, what is lost.

Run: python benchmarks/job_soak.py [DATABASE_URL] [--minutes 60] [--kill-every 60] [--jobs-per-s 3]. Default: SQLite in
a temporary folder. Prints a line a minute (or a tenth of the time): jobs done, seconds from request to end, memory of
the workers, rows of the engine's tables. The engine's entries are cleaned after half a minute: growth would show.
"""

import argparse
import os
import random
import signal
import sys
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from statistics import median
from typing import Any

from sqlalchemy import func, select, text
from worker_efficiency import Installation

from app.db.tables import Job
from app.jobs import FINAL_STATES

TABLES = ("workflow_status", "workflow_input", "operation_outputs", "workflow_events")
HISTORY_DAYS = 30.0 / 86_400
START = (
    "import workers.upkeep; workers.upkeep.EVERY_S = 10.0; "
    "from app.settings import Settings; from workers.main import run_worker; "
    "run_worker(Settings(), builder='worker_efficiency', lease_ttl_s=6.0)"
)


def rss_mib(pids: list[int]) -> float:
    """Memory of processes and all their children."""
    total = 0
    for folder in Path("/proc").glob("[0-9]*"):
        with suppress(OSError, StopIteration):
            parent = int((folder / "stat").read_text().rsplit(")", 1)[1].split()[1])
            if int(folder.name) in pids or parent in pids:
                lines = (folder / "status").read_text().splitlines()
                total += int(next(line for line in lines if line.startswith("VmRSS")).split()[1])
    return total / 1024


def engine_rows(installation: Installation) -> dict[str, int]:
    schema = "dbos." if installation.engine.dialect.name == "postgresql" else ""
    with installation.engine.connect() as connection:
        return {name: connection.scalar(text(f"SELECT count(*) FROM {schema}{name}")) for name in TABLES}


def took_s(jobs: list[Job]) -> list[float]:
    return [(job.finished_at - job.created_at).total_seconds() for job in jobs if job.finished_at is not None]


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("database_url", nargs="?")
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--kill-every", type=float, default=60.0, metavar="S")
    parser.add_argument("--jobs-per-s", type=float, default=3.0)
    asked = parser.parse_args()
    os.environ["ISODYN_JOB_HISTORY_DAYS"] = str(HISTORY_DAYS)
    with tempfile.TemporaryDirectory() as folder:
        installation = Installation(asked.database_url or f"sqlite:///{folder}/isodyn.db", folder, START)
        try:
            lost, killed = soak(installation, asked)
        finally:
            installation.close()
    print(f"{killed} workers killed, {lost} jobs lost")
    if lost:
        sys.exit("missed: no job lost")


def soak(installation: Installation, asked: Any) -> tuple[int, int]:
    """How many jobs never ended well, and how many workers were killed."""
    installation.hire(2)
    began = time.monotonic()
    end, line_s = began + 60.0 * asked.minutes, min(60.0, 6.0 * asked.minutes)
    next_kill, next_line, last_id, killed = began + asked.kill_every, began + line_s, "", 0
    print("   min   jobs  took median   95 %   worst   workers MiB   engine's rows")
    while time.monotonic() < end:
        installation.ask(1, 0.01)
        time.sleep(random.expovariate(asked.jobs_per_s))
        if time.monotonic() > next_kill:
            next_kill += asked.kill_every
            victim = random.choice(installation.workers)
            victim.send_signal(signal.SIGKILL)
            victim.wait()
            installation.workers.remove(victim)
            installation.workers.append(installation.start())
            killed += 1
        if time.monotonic() > next_line:
            next_line += line_s
            with installation.sessions() as session:
                jobs = list(session.scalars(select(Job).where(Job.id > last_id, Job.status.in_(FINAL_STATES))))
            last_id = max((job.id for job in jobs), default=last_id)
            all_s = sorted(took_s(jobs))
            print(f"{(time.monotonic() - began) / 60:6.1f} {len(jobs):6d} {median(all_s):11.2f} s "
                  f"{all_s[int(0.95 * len(all_s))]:6.2f} {all_s[-1]:7.2f} "
                  f"{rss_mib([worker.pid for worker in installation.workers]):11.0f}   {engine_rows(installation)}",
                  flush=True)  # fmt: skip
    with installation.sessions() as session:
        ids = list(session.scalars(select(Job.id).where(Job.status.not_in(FINAL_STATES))))
    installation.wait(ids)
    with installation.sessions() as session:
        return session.scalar(select(func.count(Job.id)).where(Job.status != "successful")) or 0, killed


if __name__ == "__main__":
    main()
