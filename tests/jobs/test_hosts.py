"""Two hosts with a network between them and the database: one dies, hangs or is cut off, the other finishes its job."""

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import Popen
from typing import TYPE_CHECKING

import pytest
from sqlalchemy import Engine, select

from app.db.engine import create_database_engine, migrate
from app.db.tables import Floor, Map, Worker
from tests.jobs.hosts import Network, network, why_not

if TYPE_CHECKING:
    from conftest import Crew, Site

FENCED = 3
MOST_S = 60.0  # from the death to the other's finish, with the default lease


@pytest.fixture(scope="module")
def hosts() -> Iterator[Network]:
    reason = why_not()
    if reason is not None:
        (pytest.fail if os.environ.get("CI") else pytest.skip)(reason)
    with network() as made:
        yield made


@pytest.fixture(scope="module")
def engine(hosts: Network) -> Iterator[Engine]:
    """The hosts' database, by its socket."""
    migrate(hosts.local_url)
    engine = create_database_engine(hosts.local_url)
    yield engine
    engine.dispose()


@pytest.fixture
def crew(hosts: Network, engine: Engine, tmp_path: Path, crew_of: "type[Crew]") -> "Iterator[Crew]":
    crew = crew_of(hosts.url, tmp_path)
    yield crew
    crew.dismiss()
    for host in ("a", "b"):
        hosts.heal(host)
    print(crew.log)


def kill(hosts: Network, worker: "Popen[bytes]") -> None:
    worker.kill()


def stop(hosts: Network, worker: "Popen[bytes]") -> None:
    worker.send_signal(signal.SIGSTOP)


def cut(hosts: Network, worker: "Popen[bytes]") -> None:
    hosts.cut("a")


def after(worker: "Popen[bytes]", hosts: Network, way: Callable[..., None]) -> None:
    """What comes back after its death ends itself."""
    if way is cut:
        assert worker.wait(MOST_S) == FENCED  # while it is cut off still
        hosts.heal("a")
    if way is stop:
        worker.send_signal(signal.SIGCONT)
        assert worker.wait(MOST_S) == FENCED


def take_over(crew: "Crew", site: "Site", hosts: Network, way: Callable[..., None], lease_ttl_s: float) -> float:
    """Host a takes a job and dies that way, host b finishes it: seconds from the one to the other."""
    floor = site.floor(sleep_s=3.0)
    first = crew.hire("on a", prefix=hosts.on("a"), lease_ttl_s=lease_ttl_s)
    _, job_id = site.upload(floor)
    site.wait_running(job_id)
    crew.hire("on b", prefix=hosts.on("b"), lease_ttl_s=lease_ttl_s)
    way(hosts, first)
    began = time.monotonic()
    job = site.wait(job_id)
    took_s = time.monotonic() - began
    assert job.status == "successful"
    after(first, hosts, way)
    survey_id, later = site.upload(floor)  # the healed one does no harm, and the floor is free
    assert site.wait(later).status == "successful"
    with site.sessions() as session:
        maps = session.scalars(select(Map).where(Map.floor_id == floor.id)).all()
        active = session.get_one(Map, session.get_one(Floor, floor.id).active_map_id)
        assert len(session.scalars(select(Worker.id).where(Worker.state == "live")).all()) == 1
    assert sorted((row.sequence, row.status) for row in maps) == [(1, "ready"), (2, "ready")]
    assert survey_id in active.survey_ids
    return took_s


@pytest.mark.slow
def test_locks_of_a_host_that_is_cut_off_in_the_middle_of_a_transaction_are_let_go(
    crew: "Crew", site: "Site", hosts: Network
) -> None:
    floor = site.floor(claim_s=5.0, sleep_s=0.5)
    first = crew.hire("on a", prefix=hosts.on("a"), lease_ttl_s=30.0)
    _, job_id = site.upload(floor)
    site.wait(job_id, lambda _: bool(crew.diary(event="claim starts", floor_id=floor.id)))
    crew.hire("on b", prefix=hosts.on("b"), lease_ttl_s=30.0)
    hosts.cut("a")
    began = time.monotonic()
    assert site.wait(job_id, patience_s=2 * MOST_S).status == "successful"
    print(f"cut off with locks: finished {time.monotonic() - began:.1f} s after")
    assert time.monotonic() - began < MOST_S
    assert first.wait(MOST_S) == FENCED


def test_a_host_that_is_cut_off_fences_itself_and_the_other_finishes(
    crew: "Crew", site: "Site", hosts: Network
) -> None:
    take_over(crew, site, hosts, cut, lease_ttl_s=3.0)


@pytest.mark.slow
@pytest.mark.parametrize("way", [kill, cut, stop])
def test_another_host_finishes_within_a_minute(
    crew: "Crew", site: "Site", hosts: Network, way: Callable[..., None]
) -> None:
    took_s = take_over(crew, site, hosts, way, lease_ttl_s=30.0)
    print(f"{way.__name__}: finished {took_s:.1f} s after")
    assert took_s < MOST_S
