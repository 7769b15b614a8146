"""Floors to build on, workers that are real processes, and their diary."""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from uuid import uuid4

import pytest
from sqlalchemy import Engine, func, select
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Building, Floor, Job, Organisation, Survey, Worker
from app.jobs import FINAL_STATES, JobQueue

ROOT = Path(__file__).parents[2]
START = (
    "import json, sys; from app.settings import Settings; from workers.main import run_worker\n"
    "run_worker(Settings(), builder='fake_builder', **json.loads(sys.argv[1]))"
)
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def queue(engine: Engine) -> Iterator[JobQueue]:
    queue = JobQueue(engine)
    yield queue
    queue.close()


class Site:
    """Makes floors whose builds do as told (see fake_builder), uploads to them, and waits for what comes of it."""

    def __init__(self, engine: Engine, sessions: sessionmaker[Session], queue: JobQueue) -> None:
        self.engine, self.sessions, self.queue = engine, sessions, queue

    def floor(self, **orders: object) -> Floor:
        """One, of an organisation of its own."""
        return self.floors(1, **orders)[0]

    def floors(self, count: int, **orders: object) -> list[Floor]:
        """Several, of one organisation of their own."""
        with self.sessions.begin() as session:
            organisation = Organisation(name=f"organisation {uuid4()}")
            session.add(organisation)
            session.flush()
            building = Building(organisation_id=organisation.id, name="b")
            session.add(building)
            session.flush()
            floors = [
                Floor(
                    organisation_id=organisation.id,
                    building_id=building.id,
                    name=json.dumps(orders),
                    ordinal=0,
                    elevation_m=0.0,
                )
                for _ in range(count)
            ]
            session.add_all(floors)
        return floors

    def upload(self, floor: Floor) -> tuple[str, str]:
        """A survey row and its rebuild in one transaction: their ids."""
        with self.sessions.begin() as session:
            survey = Survey(
                organisation_id=floor.organisation_id, floor_id=floor.id, name="s", format="csv", frame="building",
                raw_sha256=uuid4().hex * 2, samples_sha256=uuid4().hex * 2, sample_count=1, report={},
            )  # fmt: skip
            session.add(survey)
            job = self.queue.enqueue_rebuild(session, session.get_one(Floor, floor.id))
        return survey.id, job.id

    def cancel(self, job_id: str) -> Job:
        with self.sessions.begin() as session:
            return self.queue.request_cancel(session, session.get_one(Job, job_id))

    def job(self, job_id: str) -> Job:
        with self.sessions() as session:
            return session.get_one(Job, job_id)

    def wait(
        self,
        job_id: str,
        until: Callable[[Job], bool] = lambda job: job.status in FINAL_STATES,
        patience_s: float = PATIENCE_S,
    ) -> Job:
        deadline = time.monotonic() + patience_s
        while not until(job := self.job(job_id)):
            if time.monotonic() > deadline:
                pytest.fail(f"job {job_id} is still {job.status} at {job.progress} %: {job.message}")
            time.sleep(0.05)
        return job

    def wait_for_workers(self, count: int) -> None:
        """Until so many live."""
        living = select(func.count()).where(Worker.state == "live")
        deadline = time.monotonic() + PATIENCE_S
        while time.monotonic() < deadline:
            with self.sessions() as session:
                if session.scalar(living) == count:
                    return
            time.sleep(0.05)
        pytest.fail(f"there are not {count} workers")

    def wait_running(self, job_id: str) -> Job:
        """Until the fit has begun to report."""
        return self.wait(job_id, lambda job: job.status == "running" and job.message.startswith("slice"))


@pytest.fixture(scope="module")
def site(engine: Engine, sessions: sessionmaker[Session], queue: JobQueue) -> Site:
    return Site(engine, sessions, queue)


@pytest.fixture
def floor(site: Site) -> Floor:
    return site.floor()


class Crew:
    """Worker processes, and what their fits wrote down."""

    def __init__(self, database_url: str, folder: Path) -> None:
        self.folder = folder
        self._diary = folder / "diary"
        self._diary.touch()
        self._log = folder / "log"
        self.environment = {
            **os.environ,
            "ISODYN_DATABASE_URL": database_url,
            "ISODYN_DATA_DIR": str(folder / "var"),
            "ISODYN_BLOB_URL": f"file://{folder / 'blobs'}",
            "ISODYN_WORKER_PROCESSES": "3",
            "ISODYN_TEST_DIARY": str(self._diary),
            "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'tests' / 'jobs'}",
        }
        self._processes: list[subprocess.Popen[bytes]] = []

    @staticmethod
    def command(code: str = START, **options: Any) -> list[str]:
        return [sys.executable, "-c", code, json.dumps({"lease_ttl_s": 3.0, **options})]

    def hire(self, data_dir: str = "var", prefix: Sequence[str] = (), **options: Any) -> subprocess.Popen[bytes]:
        """Start a worker. Workers with another data folder cannot see each other die, as on two machines.

        `prefix` goes before the command; `code` is what it runs, where that is not `run_worker`."""
        environment = {**self.environment, "ISODYN_DATA_DIR": str(self.folder / data_dir)}
        with self._log.open("a") as log:
            process = subprocess.Popen([*prefix, *self.command(**options)], env=environment, stderr=log)
        self._processes.append(process)
        return process

    @property
    def log(self) -> str:
        return self._log.read_text()

    def diary(self, **facts: object) -> list[dict[str, Any]]:
        """The entries with these facts."""
        entries: list[dict[str, Any]] = [json.loads(line) for line in self._diary.read_text().splitlines()]
        return [entry for entry in entries if facts.items() <= entry.items()]

    def dismiss(self) -> None:
        for process in self._processes:
            if process.poll() is None:
                process.send_signal(signal.SIGCONT)
                process.kill()
            process.wait()


@pytest.fixture(scope="session")
def crew_of() -> type[Crew]:
    return Crew


@pytest.fixture
def crew(database_url: str, tmp_path: Path, engine: Engine) -> Iterator[Crew]:
    crew = Crew(database_url, tmp_path)
    yield crew
    crew.dismiss()
    print(crew.log)
