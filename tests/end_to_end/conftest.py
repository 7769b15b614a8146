"""Every process for real: `isodyn serve` with its worker, spoken to over HTTP, killed without warning."""

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import numpy as np
import pytest

KEY = "isd_end-to-end"


class Server:
    """One `isodyn serve` on its own data folder; starting it again after a kill keeps the folder."""

    def __init__(self, folder: Path, database_url: str | None = None) -> None:
        self.folder = folder
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        self.environment = {
            **os.environ,
            "ISODYN_DATA_DIR": str(folder / "var"),
            "ISODYN_ADMIN_KEY": KEY,
            "ISODYN_PORT": str(self.port),
        }
        if database_url is not None:
            self.environment["ISODYN_DATABASE_URL"] = database_url
        self.process: subprocess.Popen[bytes] | None = None
        self.http = httpx.Client(
            base_url=f"http://127.0.0.1:{self.port}", headers={"Authorization": f"Bearer {KEY}"}, timeout=60
        )

    def start(self) -> None:
        command = [sys.executable, "-m", "app.cli", "serve"]
        with (self.folder / "server.log").open("ab") as log:
            self.process = subprocess.Popen(
                command, env=self.environment, stdout=log, stderr=log, start_new_session=True
            )
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            assert self.process.poll() is None, (self.folder / "server.log").read_text()
            try:
                if self.http.get("/readyz").status_code == 200:
                    return
            except httpx.TransportError:
                time.sleep(0.05)
        raise AssertionError((self.folder / "server.log").read_text())

    def pids(self, word: bytes = b"") -> list[int]:
        """Every process that works on this server's data folder, of those whose command has the word."""
        mine = f"ISODYN_DATA_DIR={self.environment['ISODYN_DATA_DIR']}".encode()
        found = []
        for folder in Path("/proc").glob("[0-9]*"):
            with suppress(OSError):
                if mine in (folder / "environ").read_bytes() and word in (folder / "cmdline").read_bytes():
                    found.append(int(folder.name))
        return found

    def kill(self) -> None:
        """kill -9 of the server and everything it started."""
        assert self.process is not None
        for pid in self.pids():
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self.process.wait()

    def stop(self) -> int:
        """Ask the server to end, as Ctrl-C does, and return its exit code."""
        assert self.process is not None
        self.process.send_signal(signal.SIGINT)
        try:
            return self.process.wait(timeout=40)
        finally:
            if self.process.poll() is None:
                self.kill()

    def new_floor(self) -> str:
        building = self.http.post("/v1/buildings", json={"name": "House"}).json()["id"]
        return str(self.http.post(f"/v1/buildings/{building}/floors", json={"name": "G", "ordinal": 0}).json()["id"])

    def wait_for(self, job_id: str, *statuses: str, timeout_s: float = 120) -> dict[str, object]:
        """The job, once it has one of the statuses (or has ended)."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            job: dict[str, object] = self.http.get(f"/v1/jobs/{job_id}").json()
            if job["status"] in (*statuses, "successful", "failed", "dismissed"):
                return job
            time.sleep(0.02)
        raise AssertionError(f"{job}\n{(self.folder / 'server.log').read_text()}")


@pytest.fixture(scope="session")
def server_of() -> type[Server]:
    return Server


@pytest.fixture
def server(tmp_path: Path) -> Iterator[Server]:
    server = Server(tmp_path)
    server.start()
    yield server
    server.http.close()
    server.kill()


@pytest.fixture(scope="session")
def walk_csv() -> Callable[[int], bytes]:
    """A walk over a 30 x 20 m floor, 0.5 m lanes, long enough that a fit takes a moment."""

    def make(seed: int) -> bytes:
        rng = np.random.default_rng(seed)
        xs = np.arange(0.0, 30.0, 0.25)
        lanes = np.arange(0.1 * seed, 20.0, 0.5)
        x = np.concatenate([xs if k % 2 == 0 else xs[::-1] for k in range(len(lanes))])
        y = np.repeat(lanes, len(xs))
        B = np.stack(
            [18 + 6 * np.sin(0.9 * x) * np.cos(0.7 * y), 3 + 5 * np.cos(0.6 * x - 0.8 * y), -42 + 6 * np.sin(x + y)], 1
        ) + rng.normal(0, 0.3, (len(x), 3))
        rows = np.column_stack([0.2 * np.arange(len(x)), x, y, np.full(len(x), 1.2), B])
        lines = [",".join(f"{v:.4f}" for v in row) for row in rows]
        return ("t_s,x_m,y_m,z_m,bx_ut,by_ut,bz_ut\n" + "\n".join(lines) + "\n").encode()

    return make
