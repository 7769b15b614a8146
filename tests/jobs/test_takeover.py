"""Workers that die, hang, are asked to go or lose their parent: the job is finished, once, by another."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import select
from sqlalchemy.orm import Session, sessionmaker

from app.db.tables import Map, Worker

if TYPE_CHECKING:
    from conftest import Crew, Site


def is_alive(pid: int) -> bool:
    """Whether the process runs (a zombie does not)."""
    try:
        return "Z" not in Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
    except FileNotFoundError:
        return False


def wait_dead(pid: int) -> None:
    deadline = time.monotonic() + 20
    while is_alive(pid):
        assert time.monotonic() < deadline, f"process {pid} is still alive"
        time.sleep(0.05)


def workers(sessions: sessionmaker[Session]) -> set[str]:
    with sessions() as session:
        return set(session.scalars(select(Worker.id)))


@pytest.mark.parametrize(
    ("successor", "ttl_s"),
    [
        pytest.param("var", 600.0, id="restarted, which knows of the death at once"),
        pytest.param(
            "elsewhere", 3.0, id="on another machine, which waits for the lease to run out", marks=pytest.mark.slow
        ),
    ],
)
def test_the_next_worker_finishes_what_a_killed_one_began(
    crew: "Crew", site: "Site", successor: str, ttl_s: float
) -> None:
    floor = site.floor(sleep_s=2.5)
    first = crew.hire(lease_ttl_s=ttl_s)
    _, job_id = site.upload(floor)
    site.wait_running(job_id)
    _, waiting = site.upload(floor)
    first.kill()
    (orphan,) = {entry["pid"] for entry in crew.diary(event="fit starts")}
    wait_dead(orphan)
    crew.hire(successor, lease_ttl_s=ttl_s)
    job = site.wait(job_id)
    assert (job.status, site.wait(waiting).status) == ("successful", "successful")
    assert len(crew.diary(event="fit starts", map_id=job.map_id)) == 2
    assert len(crew.diary(event="fit ends", map_id=job.map_id)) == 1
    with site.sessions() as session:
        maps = session.scalars(select(Map).where(Map.floor_id == floor.id)).all()
    assert sorted((row.sequence, row.status) for row in maps) == [(1, "ready"), (2, "ready")]


@pytest.mark.slow
def test_another_worker_takes_over_and_a_hung_one_ends_itself(crew: "Crew", site: "Site") -> None:
    floor = site.floor(sleep_s=4.0)
    first = crew.hire()
    _, job_id = site.upload(floor)
    site.wait_running(job_id)
    crew.hire()
    first.send_signal(signal.SIGSTOP)
    site.wait(job_id, lambda job: len(crew.diary(event="fit starts")) == 2)
    first.send_signal(signal.SIGCONT)
    assert first.wait(20) == 3
    assert site.wait(job_id).status == "successful"


@pytest.mark.slow
def test_a_cancelled_job_of_a_killed_worker_is_not_done_again(crew: "Crew", site: "Site") -> None:
    floor = site.floor(sleep_s=30.0)
    first = crew.hire()
    _, job_id = site.upload(floor)
    site.wait_running(job_id)
    first.kill()
    site.cancel(job_id)
    crew.hire()
    assert site.wait(job_id).status == "dismissed"


@pytest.mark.parametrize(
    "database_url", ["sqlite", pytest.param("postgres", marks=[pytest.mark.postgres, pytest.mark.slow])], indirect=True
)
def test_asked_to_stop_a_worker_finishes_its_job_first(crew: "Crew", site: "Site") -> None:
    floor = site.floor(sleep_s=3.0)
    worker = crew.hire(drain_s=20.0)
    _, job_id = site.upload(floor)
    site.wait_running(job_id)
    _, waiting = site.upload(floor)
    worker.terminate()
    assert worker.wait(30) == 0
    assert site.job(job_id).status == "successful"
    assert site.job(waiting).status == "accepted"  # nothing new was begun
    crew.hire()
    assert site.wait(waiting).status == "successful"


@pytest.mark.slow
def test_asked_to_stop_a_worker_leaves_a_long_job_to_the_next_at_once(crew: "Crew", site: "Site") -> None:
    floor = site.floor(sleep_s=6.0)
    worker = crew.hire(drain_s=1.0, lease_ttl_s=600.0)  # the next must not have to wait for this lease
    _, job_id = site.upload(floor)
    site.wait_running(job_id)
    worker.terminate()
    assert worker.wait(30) == 0
    crew.hire(lease_ttl_s=600.0)
    assert site.wait(job_id).status == "successful"


def test_an_idle_worker_leaves_no_trace(crew: "Crew", sessions: sessionmaker[Session]) -> None:
    before = workers(sessions)
    worker = crew.hire()
    deadline = time.monotonic() + 30
    while not (mine := workers(sessions) - before):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    worker.send_signal(signal.SIGINT)
    assert worker.wait(30) == 0
    assert not mine & workers(sessions)


@pytest.mark.slow
def test_a_worker_ends_with_its_parent(crew: "Crew", site: "Site") -> None:
    _, job_id = site.upload(site.floor(sleep_s=5.0))
    code = (
        "import json, os, subprocess, sys, time\n"
        "options = {'parent_pid': os.getpid(), 'lease_ttl_s': 600.0}\n"
        "child = subprocess.Popen([*json.loads(sys.argv[1]), json.dumps(options)])\n"
        "print(child.pid, flush=True); time.sleep(100)"
    )
    command = [sys.executable, "-c", code, json.dumps(crew.command()[:-1])]
    parent = subprocess.Popen(command, env=crew.environment, stdout=subprocess.PIPE, text=True)
    assert parent.stdout is not None
    with parent.stdout:
        pid = int(parent.stdout.readline())
    try:
        site.wait_running(job_id)
    finally:
        parent.kill()
        parent.wait()
    try:
        wait_dead(pid)
    except AssertionError:
        os.kill(pid, signal.SIGKILL)
        raise
    crew.hire()
    assert site.wait(job_id).status == "successful"
