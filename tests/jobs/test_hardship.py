"""Jobs that are hard on their worker: those that kill it, keep it busy, or were begun by other code."""

import threading
import time
from typing import TYPE_CHECKING

import pytest

from app.db.tables import Job

if TYPE_CHECKING:
    from conftest import Crew, Site

START = (
    "import json, sys; from app.settings import Settings; from workers.main import run_worker\n"
    "run_worker(Settings(), builder='fake_builder', **json.loads(sys.argv[1]))"
)

# Threads of its own want the interpreter all the time.
BUSY = (
    "import threading\n"
    "def spin():\n"
    "    while True: pass\n"
    "for _ in range(3): threading.Thread(target=spin, daemon=True).start()\n"
) + START

# A later version: it has learned one workflow more, beside the one that jobs of before are named after.
LATER = (
    "import json, sys\n"
    "from dbos import DBOS\n"
    "import workers.main\n"
    "from workers.workflows import register_workflows\n"
    "def register(context):\n"
    "    register_workflows(context)\n"
    "    @DBOS.workflow(name='rebuild_2')\n"
    "    def rebuild_2(floor_id, generation):\n"
    "        return 'of the later version'\n"
    "workers.main.register_workflows = register\n"
    "from app.settings import Settings\n"
    "workers.main.run_worker(Settings(), builder='fake_builder', **json.loads(sys.argv[1]))"
)


class Supervisor:
    """Starts a worker again whenever it has ended, as a service manager does."""

    def __init__(self, crew: "Crew", **options: object) -> None:
        self._crew, self._options, self._stop, self.deaths = crew, options, threading.Event(), 0
        self._thread = threading.Thread(target=self._watch)
        self._thread.start()

    def _watch(self) -> None:
        worker = self._crew.hire(**self._options)  # type: ignore[arg-type]
        while not self._stop.wait(0.1):
            if worker.poll() is not None:
                self.deaths += 1
                worker = self._crew.hire(**self._options)  # type: ignore[arg-type]

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


@pytest.mark.slow
def test_a_job_that_kills_its_worker_every_time_is_given_up_and_others_are_done(crew: "Crew", site: "Site") -> None:
    crew.environment["ISODYN_WORKER_PROCESSES"] = "1"
    _, poison = site.upload(site.floor(kill_worker=True))
    others = [site.upload(site.floor(sleep_s=1.0))[1] for _ in range(4)]
    began = time.monotonic()
    supervisors = [Supervisor(crew), Supervisor(crew)]
    try:
        job = site.wait(poison, patience_s=180.0)
        print(f"given up after {time.monotonic() - began:.0f} s and {sum(each.deaths for each in supervisors)} deaths")
        assert {site.wait(other).status for other in others} == {"successful"}
    finally:
        for supervisor in supervisors:
            supervisor.stop()
    assert job.status == "failed"
    assert "its worker died every time" in job.message
    assert len(crew.diary(event="fit starts", floor_id=job.floor_id)) == 6


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "orders"), [(BUSY, {"sleep_s": 6.0}), (START, {"hold_s": 6.0})], ids=["its own interpreter", "the fit's"]
)
def test_a_worker_beats_while_an_interpreter_is_busy(
    crew: "Crew", site: "Site", code: str, orders: dict[str, object]
) -> None:
    """Longer than the time to live, with another worker watching."""
    floor = site.floor(**orders)
    first = crew.hire("on one machine", code=code, lease_ttl_s=4.0)
    _, job_id = site.upload(floor)
    site.wait(job_id, lambda job: job.status == "running")
    crew.hire("on another", lease_ttl_s=4.0)
    assert site.wait(job_id).status == "successful"
    assert len(crew.diary(event="fit starts", floor_id=floor.id)) == 1
    assert first.poll() is None


@pytest.mark.slow
def test_a_job_half_done_by_one_version_is_finished_by_the_next(crew: "Crew", site: "Site") -> None:
    floor = site.floor(sleep_s=3.0)
    worker = crew.hire()
    _, job_id = site.upload(floor)
    site.wait_running(job_id)
    worker.kill()
    worker.wait()
    crew.hire(code=LATER)
    job = site.wait(job_id)
    assert job.status == "successful"
    with site.sessions() as session:
        assert session.get_one(Job, job_id).map_id == crew.diary(event="fit ends")[0]["map_id"]
