"""Metrics that are looked up when somebody asks: jobs, workers and tracks by the database, this process's connections,
and the disk of its data. All web processes of an installation say the same of the first three."""

import logging
import shutil
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path

from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector
from sqlalchemy import Engine, func, select
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session
from sqlalchemy.pool import QueuePool

from app.db.tables import BUILD, REBUILD, Job, Track, Worker, utc_now
from app.jobs.lease import FRESH_BEAT_S

__all__ = ["InstallationMetrics"]

_log = logging.getLogger(__name__)


class InstallationMetrics(Collector):
    """`data_dir`: the folder whose disk is looked at."""

    def __init__(self, engine: Engine, data_dir: Path) -> None:
        self._engine, self._data_dir = engine, data_dir

    def collect(self) -> Iterator[Metric]:
        yield from self._disk()
        yield from self._connections()
        up = GaugeMetricFamily("isodyn_database_up", "Whether the database answered just now.")
        try:
            with Session(self._engine) as session:
                yield from _jobs(session)
                yield from _workers(session)
                yield from _tracks(session)
            up.add_metric([], 1)
        except SQLAlchemyError as error:
            _log.warning("metrics without the database's: %s", error)
            up.add_metric([], 0)
        yield up

    def _disk(self) -> Iterator[Metric]:
        try:
            disk = shutil.disk_usage(self._data_dir)
        except OSError as error:
            _log.warning("metrics without the disk's: %s", error)
            return
        yield _gauge("isodyn_disk_size_bytes", "Size of the disk of the data folder.", disk.total)
        yield _gauge("isodyn_disk_free_bytes", "Free space there.", disk.free)

    def _connections(self) -> Iterator[Metric]:
        pool = self._engine.pool
        if isinstance(pool, QueuePool):
            made = GaugeMetricFamily("isodyn_database_connections", "Open connections.", labels=["state"])
            made.add_metric(["used"], pool.checkedout())
            made.add_metric(["idle"], pool.checkedin())
            yield made


def _jobs(session: Session) -> Iterator[Metric]:
    rows = session.execute(
        select(Job.kind, Job.status, func.count(), func.min(Job.created_at))
        .where(Job.status.in_(("accepted", "running")))
        .group_by(Job.kind, Job.status)
    ).all()
    waiting = GaugeMetricFamily("isodyn_jobs_waiting", "Jobs that wait for a worker.", labels=["kind"])
    running = GaugeMetricFamily("isodyn_jobs_running", "Jobs that are worked on.", labels=["kind"])
    for kind in (REBUILD, BUILD):
        for family, status in ((waiting, "accepted"), (running, "running")):
            family.add_metric([kind], sum(row[2] for row in rows if (row[0], row[1]) == (kind, status)))
    yield waiting
    yield running
    oldest = [row[3] for row in rows if row[1] == "accepted"]
    yield _gauge("isodyn_jobs_oldest_waiting_seconds", "Age of the oldest waiting job; 0 without one.", _age_s(oldest))


def _workers(session: Session) -> Iterator[Metric]:
    beats = session.scalars(select(Worker.beat).where(Worker.state == "live")).all()
    fresh = [beat for beat in beats if _age_s([beat]) < FRESH_BEAT_S]  # the last to die is declared dead by nobody
    yield _gauge("isodyn_workers_live", "Workers that hold a lease.", len(fresh))
    yield _gauge(
        "isodyn_workers_oldest_beat_seconds", "Age of the oldest beat of all that did not sign off.", _age_s(beats)
    )


def _tracks(session: Session) -> Iterator[Metric]:
    active = session.scalar(select(func.count()).select_from(Track).where(Track.status == "active"))
    yield _gauge("isodyn_tracks_active", "Tracks that have not ended.", active or 0)


def _gauge(name: str, documentation: str, value: float) -> Metric:
    return GaugeMetricFamily(name, documentation, value=value)


def _age_s(times: Sequence[datetime]) -> float:
    return max((utc_now() - min(times)).total_seconds(), 0.0) if times else 0.0
