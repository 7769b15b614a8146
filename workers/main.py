"""A worker process, from start to end.

It stops in three ways. Asked (SIGTERM, SIGINT, or its parent gone): it takes nothing new, gives running jobs a bounded
time, and leaves what is unfinished to be taken over at once. Fenced (its lease is lost): it ends on the spot. Killed:
the others notice when its lease runs out.
"""

import gc
import logging
import os
import signal
import threading
import time
from collections.abc import Callable
from math import ceil
from types import FrameType

from dbos import DBOS, DBOSClient
from prometheus_client import start_http_server
from sqlalchemy import Engine
from sqlalchemy.exc import SQLAlchemyError

from app.blobs import open_blob_store
from app.db.engine import create_database_engine, migrate, session_factory
from app.jobs.admission import has_admitted
from app.jobs.engine import QUEUE, engine_configuration, open_client
from app.jobs.lease import Lease
from app.jobs.queue import JobQueue
from app.settings import Settings
from workers.builder import DEFAULT_BUILDER, load_builder
from workers.helper import Helper
from workers.lifeline import Lifeline, new_worker_id
from workers.reaper import Reaper
from workers.reconcile import has_unfinished_jobs
from workers.slots import POLL_S, Slots
from workers.upkeep import Upkeep
from workers.workflows import FENCED, WorkflowContext, register_workflows

__all__ = ["run_worker"]

RESUMED_POLL_S = 10.0

log = logging.getLogger(__name__)


def run_worker(
    settings: Settings,
    *,
    builder: str = DEFAULT_BUILDER,
    lease_ttl_s: float = 30.0,
    drain_s: float = 10.0,
    parent_pid: int | None = None,
) -> None:
    """Take jobs from the database until asked to stop; call it in the main thread.

    `builder` is the module that does the work (`workers.builder.Builder`). A worker that falls silent for
    `lease_ttl_s` is dead to the others. Running jobs get `drain_s` to finish when the worker is asked to stop, and no
    time when `parent_pid` is given and is not this process's parent any more.
    """
    stop = _stop_on_signals()
    if settings.worker_metrics_port is not None:
        start_http_server(settings.worker_metrics_port, settings.host)
    url = settings.resolved_database_url
    migrate(url)
    blobs = open_blob_store(settings.resolved_blob_url)  # makes its folder: no fit does
    engine = create_database_engine(url)
    client = open_client(engine)
    worker_id = new_worker_id()
    context = WorkflowContext(
        session_factory(engine), JobQueue(engine), settings.resolved_blob_url, load_builder(builder), builder,
        Slots(settings.worker_processes), worker_id,
    )  # fmt: skip
    register_workflows(context)
    lease = Lease(engine, worker_id, lease_ttl_s, slots=settings.worker_processes)
    lifeline = Lifeline(settings.data_dir / "workers", lease.worker_id)
    lease.start()
    _start_thread("fence", _end_when_lost, lease)
    _launch(engine, settings.worker_processes, context)
    _start_thread("reaper", Reaper(url, lease, lifeline, client, context).run, stop)
    _start_thread("helper", Helper(context).run, stop)
    upkeep = Upkeep(client, context.sessions, blobs, settings.job_history_days, settings.track_history_days)
    _start_thread("upkeep", upkeep.run, stop)
    gc.collect()
    gc.freeze()  # what is there now stays: a collection that walks through it takes as long as a job's statements
    parent_died = _wait(stop, parent_pid)
    context.slots.close()
    _leave(lease, client, context.slots, 0.0 if parent_died else drain_s)
    context.fits.close()
    lifeline.release()
    engine.dispose()


def _stop_on_signals() -> threading.Event:
    stop = threading.Event()

    def ask(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, ask)
    return stop


def _start_thread(name: str, target: Callable[..., None], *arguments: object) -> None:
    threading.Thread(target=target, args=arguments, name=name, daemon=True).start()


def _launch(engine: Engine, fits_at_one_time: int, context: WorkflowContext) -> None:
    job_engine = DBOS(config=engine_configuration(engine.url, context.worker_id))
    DBOS.listen_queues([])  # our slots do
    DBOS.launch()
    # Where an operator's `resume` puts a job; nothing of ours waits there, and to look takes as long as for our queue.
    job_engine._registry.get_internal_queue()._polling_interval_sec = RESUMED_POLL_S
    queue = DBOS.register_queue(
        QUEUE, partition_concurrency=1, worker_concurrency=fits_at_one_time, polling_interval_sec=POLL_S
    )
    queue._worker_concurrency = fits_at_one_time  # and not what somebody wrote there meanwhile
    queue.database_backed_queue = False  # its row is shared, and read before every poll; each worker has its own slots

    def is_wanted() -> bool:
        try:
            with context.sessions() as session:
                return has_admitted(session)
        except Exception:  # whatever it was: a worker that does not look takes no jobs
            log.warning("could not look for jobs; the engine looks itself", exc_info=True)
            return True

    context.slots.fill(job_engine, queue, is_wanted)


def _end_when_lost(lease: Lease) -> None:
    while True:
        time.sleep(lease.ttl_s / 8)
        if lease.is_lost:
            log.error("worker %s lost its lease and ends: others may hold its jobs", lease.worker_id)
            os._exit(FENCED)


def _wait(stop: threading.Event, parent_pid: int | None) -> bool:
    """Until asked to stop; True if the reason is that the parent died."""
    while not stop.wait(0.5):
        if parent_pid is not None and os.getppid() != parent_pid:
            return True
    return False


def _leave(lease: Lease, client: DBOSClient, slots: Slots, drain_s: float) -> None:
    """Take nothing new, let running jobs finish, and leave the rest to the others."""
    try:
        busy = slots.are_used or has_unfinished_jobs(client, lease.worker_id)
        DBOS.destroy(workflow_completion_timeout_sec=ceil(drain_s) if busy else 0)
        unfinished = has_unfinished_jobs(client, lease.worker_id)
        lease.release(unfinished=unfinished)
        unfinished |= slots.are_used  # by a job of which the engine has lost its record
    except SQLAlchemyError:
        log.exception("worker %s could not sign off; its lease will run out", lease.worker_id)
        unfinished = True
    if unfinished:
        os._exit(0)  # the threads of unfinished jobs must not go on: their jobs are somebody else's now
