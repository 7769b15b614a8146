"""Installations of real processes, embedded and grown, whose every part can be killed or taken away for a while."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from random import Random
from threading import Event, Thread
from typing import Literal

import httpx
from sqlalchemy import text

from app.db.engine import create_database_engine, migrate
from tests.postgres_server import Cluster, new_cluster
from tests.s3_server import BUCKET, ENVIRONMENT, Server, Way, free_port, started

__all__ = ["KEY", "BackEnd", "Fault", "Installation", "installation"]

KEY = "isd_reliability"
BackEnd = Literal["sqlite", "postgres"]
RESTART_S = 0.5


@dataclass(frozen=True)
class Fault:
    """Something that goes wrong, at once or for some seconds."""

    name: str
    happen: Callable[[Random], None]


class Supervised:
    """A process that is started again whenever it ends, as a service manager does."""

    def __init__(self, arguments: list[str], environment: dict[str, str], log: Path) -> None:
        self._command = [sys.executable, "-m", "app.cli", *arguments]
        self._environment, self._log = environment, log
        self._stopping = Event()
        self._process = self._begin()
        self.restarts = 0
        self._thread = Thread(target=self._watch, daemon=True)
        self._thread.start()

    def kill(self) -> None:
        self._process.kill()

    @property
    def pid(self) -> int:
        return self._process.pid

    def stop(self) -> None:
        """Ask it to end, and see to it."""
        self._stopping.set()
        self._thread.join()
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(40)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _begin(self) -> subprocess.Popen[bytes]:
        with self._log.open("ab") as log:
            return subprocess.Popen(self._command, env=self._environment, stdout=log, stderr=log)

    def _watch(self) -> None:
        while not self._stopping.wait(0.1):
            if self._process.poll() is not None:
                self._stopping.wait(RESTART_S)
                self._process = self._begin()
                self.restarts += 1


@dataclass
class Installation:
    """API and worker processes on one database and one blob store."""

    folder: Path
    environment: dict[str, str]
    faults: list[Fault] = field(default_factory=list)
    apis: list[Supervised] = field(default_factory=list)
    workers: list[Supervised] = field(default_factory=list)
    addresses: list[str] = field(default_factory=list)

    def start(self, apis: int, workers: int) -> None:
        for number in range(apis):
            port = free_port()
            arguments = ["serve", "--no-worker", "--port", str(port)]
            self.apis.append(Supervised(arguments, self.environment, self.folder / f"api{number}.log"))
            self.addresses.append(f"http://127.0.0.1:{port}")
        for address in self.addresses:
            wait_until_ready(address)
        for number in range(workers):
            self.workers.append(Supervised(["worker"], self.environment, self.folder / f"worker{number}.log"))
        self.faults += [
            Fault("API killed", lambda draw: draw.choice(self.apis).kill()),
            Fault("worker killed", lambda draw: draw.choice(self.workers).kill()),
        ]

    def stop(self) -> None:
        for process in (*self.apis, *self.workers):
            process.stop()

    def logs(self) -> str:
        return "".join(log.read_text() for log in sorted(self.folder.glob("*.log")))

    def doctor(self) -> str:
        """What `isodyn doctor --deep` says. Raises AssertionError where it finds a fault."""
        command = [sys.executable, "-m", "app.cli", "doctor", "--deep"]
        done = subprocess.run(command, env=self.environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout


@contextmanager
def installation(back_end: BackEnd, folder: Path, outage_s: float) -> Iterator[Installation]:
    """A place to start processes in, its services running; outages last `outage_s`."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = {name: value for name, value in os.environ.items() if not name.startswith(("AWS_", "ISODYN_"))}
    environment |= {"ISODYN_DATA_DIR": str(folder / "var"), "ISODYN_ADMIN_KEY": KEY, "OPENBLAS_NUM_THREADS": "1"}
    make = _embedded if back_end == "sqlite" else _grown
    with make(folder, environment, outage_s) as made:
        try:
            yield made
        finally:
            made.stop()


@contextmanager
def _embedded(folder: Path, environment: dict[str, str], outage_s: float) -> Iterator[Installation]:
    """SQLite and a folder. The folder is a disk of its own where this machine lets us mount one."""
    blobs = folder / "blobs"
    blobs.mkdir()
    environment |= {"ISODYN_BLOB_URL": f"file://{blobs}"}
    database = folder / "var" / "isodyn.db"
    faults = [Fault("database locked", lambda _draw: _lock(database, outage_s))]
    mounted = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=512m", "tmpfs", str(blobs)], capture_output=True)
    if mounted.returncode == 0:
        faults += [
            Fault("blob disk full", lambda _draw: _fill(blobs, outage_s)),
            Fault("blob disk read-only", lambda _draw: _remount(blobs, outage_s)),
        ]
    try:
        yield Installation(folder, environment, faults)
    finally:
        if mounted.returncode == 0:
            subprocess.run(["umount", "--lazy", str(blobs)], check=True)


@contextmanager
def _grown(folder: Path, environment: dict[str, str], outage_s: float) -> Iterator[Installation]:
    """PostgreSQL and S3, both servers of our own."""
    cluster = new_cluster()
    server = started(folder / "s3.txt")
    way = Way(server.port)
    environment |= {**ENVIRONMENT, "AWS_ENDPOINT_URL": way.url, "ISODYN_BLOB_URL": f"s3://{BUCKET}/isodyn"}
    environment |= {"ISODYN_DATABASE_URL": cluster.url}
    migrate(cluster.url)
    faults = [
        Fault("PostgreSQL restarted", lambda _draw: _restart(cluster, 0.0)),
        Fault("PostgreSQL killed", lambda _draw: _kill(cluster)),
        Fault("PostgreSQL gone", lambda _draw: _restart(cluster, outage_s)),
        Fault("S3 gone", lambda _draw: _cut(way, outage_s)),
    ]
    try:
        yield Installation(folder, environment, faults)
    finally:
        way.close()
        _stop(server, cluster)


def _stop(server: Server, cluster: Cluster) -> None:
    server.stop()
    cluster.remove()


def _restart(cluster: Cluster, gone_s: float) -> None:
    cluster.stop("immediate")
    time.sleep(gone_s)
    cluster.start()


def _kill(cluster: Cluster) -> None:
    cluster.kill()
    time.sleep(0.5)
    cluster.start()


def _cut(way: Way, gone_s: float) -> None:
    way.cut()
    time.sleep(gone_s)
    way.mend()


def _lock(database: Path, gone_s: float) -> None:
    """As a tool does that looks at the file and forgets to let go."""
    engine = create_database_engine(f"sqlite:///{database}")
    with engine.connect() as connection, suppress(Exception):
        connection.execute(text("BEGIN IMMEDIATE"))
        time.sleep(gone_s)
    engine.dispose()


def _fill(disk: Path, gone_s: float) -> None:
    ballast = disk / "ballast"
    with ballast.open("wb", buffering=0) as file, suppress(OSError):
        while True:
            file.write(b"\0" * 2**20)
    with ballast.open("ab", buffering=0) as file, suppress(OSError):
        while True:
            file.write(b"\0" * 4096)
    time.sleep(gone_s)
    ballast.unlink()


def _remount(disk: Path, gone_s: float) -> None:
    """Refused while somebody writes, hence the tries."""
    for _ in range(100):
        if subprocess.run(["mount", "-o", "remount,ro", str(disk)], capture_output=True).returncode == 0:
            break
        time.sleep(0.05)
    time.sleep(gone_s)
    subprocess.run(["mount", "-o", "remount,rw", str(disk)], check=True)


def wait_until_ready(address: str, patience_s: float = 90.0) -> None:
    """Until a server answers that it can serve. Raises AssertionError."""
    deadline = time.monotonic() + patience_s
    while time.monotonic() < deadline:
        with suppress(httpx.TransportError):
            if httpx.get(f"{address}/readyz", timeout=10).status_code == 200:
                return
        time.sleep(0.1)
    raise AssertionError(f"{address} is not ready after {patience_s:.0f} s")
