"""A PostgreSQL server of one's own, which a test may stop, kill and start again without harm to anybody else."""

import os
import shutil
import signal
import socket
import subprocess
import tempfile
from pathlib import Path

import pytest

__all__ = ["Cluster", "new_cluster"]

USER = "isodyn"


class Cluster:
    """A server on a free port of loopback, in a new folder; root runs it as the user `postgres`, as it must."""

    def __init__(self, binaries: Path, listen: str = "127.0.0.1") -> None:
        self._binaries, self._listen = binaries, listen
        self._as = ["runuser", "-u", "postgres", "--"] if os.geteuid() == 0 else []
        self.folder = Path(tempfile.mkdtemp(prefix="isodyn-postgres-"))
        if self._as:
            shutil.chown(self.folder, "postgres")
        with socket.socket() as probe:
            probe.bind((listen, 0))
            self.port = int(probe.getsockname()[1])
        trust = ["--auth=trust", "--username", USER, "--encoding=UTF8", "--locale=C"]
        self._run("initdb", "--pgdata", str(self._data), *trust)
        if listen != "127.0.0.1":
            with (self._data / "pg_hba.conf").open("a") as rules:
                rules.write("host all all samenet trust\n")
        self.start()

    @property
    def url(self) -> str:
        return f"postgresql+psycopg://{USER}@{self._listen}:{self.port}/postgres"

    def start(self) -> None:
        options = (
            f"-c listen_addresses={self._listen} -c port={self.port} -c unix_socket_directories= -c max_connections=200"
        )
        self._run("pg_ctl", "start", "--silent", "--wait", "--pgdata", str(self._data),
                  "--log", str(self.folder / "log"), "--options", options)  # fmt: skip

    def stop(self, mode: str = "immediate") -> None:
        """`immediate` is a crash with recovery at the next start; `fast` sends everybody away in good order."""
        self._run("pg_ctl", "stop", "--silent", "--wait", "--pgdata", str(self._data), "--mode", mode)

    def kill(self) -> None:
        """kill -9 of the whole server; `start` recovers."""
        postmaster = int((self._data / "postmaster.pid").read_text().split()[0])
        children = Path(f"/proc/{postmaster}/task/{postmaster}/children").read_text().split()
        for pid in (postmaster, *map(int, children)):
            os.kill(pid, signal.SIGKILL)
        (self._data / "postmaster.pid").unlink()

    def remove(self) -> None:
        self.stop()
        shutil.rmtree(self.folder)

    @property
    def _data(self) -> Path:
        return self.folder / "data"

    def _run(self, program: str, *arguments: str) -> None:
        done = subprocess.run(
            [*self._as, str(self._binaries / program), *arguments],
            cwd=self.folder, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE if program == "initdb" else None,
            stderr=subprocess.STDOUT if program == "initdb" else None,
        )  # fmt: skip
        assert done.returncode == 0, (program, arguments, done.stdout)


def new_cluster(listen: str = "127.0.0.1") -> Cluster:
    """A started server. Without PostgreSQL's programs the test is skipped, but where `CI` is set it fails."""
    found = sorted(Path("/usr/lib/postgresql").glob("*/bin/initdb"))
    initdb = shutil.which("initdb") or (str(found[-1]) if found else None)
    if initdb is None:
        reason = "PostgreSQL's programs (initdb, pg_ctl) are not here: apt-get install postgresql"
        if os.environ.get("CI"):
            pytest.fail(reason)
        pytest.skip(reason)
    return Cluster(Path(initdb).resolve().parent, listen)
