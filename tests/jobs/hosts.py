"""Hosts that are network namespaces on one bridge, and a PostgreSQL server of their own that they reach over it.

Needs root and PostgreSQL's binaries. The test's own process reaches the server by its socket, whatever happens to the
network.
"""

import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from uuid import uuid4

__all__ = ["Network", "network", "why_not"]

POSTGRES = sorted(Path("/usr/lib/postgresql").glob("*/bin/postgres"))
SERVER, PORT = "10.201.0.1", 5499
HOSTS = ("a", "b")


def why_not() -> str | None:
    """What this machine lacks."""
    if os.geteuid() != 0 or shutil.which("ip") is None:
        return "needs root and the command `ip`"
    if not POSTGRES:
        return "needs PostgreSQL's server binaries in /usr/lib/postgresql"
    probe = f"isodyn-probe-{uuid4().hex[:6]}"
    made = subprocess.run(["ip", "netns", "add", probe], capture_output=True, text=True)
    if made.returncode != 0:
        return f"network namespaces are not permitted here: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "del", probe], check=True)
    return None


@dataclass(frozen=True)
class Network:
    """`url` is the database as a host sees it, `local_url` as this process does."""

    name: str
    url: str
    local_url: str

    def on(self, host: str) -> list[str]:
        """What to put before a command to run it on a host; the process stays the same one."""
        return ["ip", "netns", "exec", f"{self.name}{host}"]

    def cut(self, host: str) -> None:
        """Take the host's cable out: nothing comes or goes, and nobody is told."""
        _ip("-n", f"{self.name}s", "link", "set", f"port-{host}", "down")

    def heal(self, host: str) -> None:
        _ip("-n", f"{self.name}s", "link", "set", f"port-{host}", "up")


@contextmanager
def network() -> Iterator[Network]:
    """Two hosts, a and b, and a server between them; all gone afterwards."""
    name = f"iso{uuid4().hex[:6]}"
    folder = Path(tempfile.mkdtemp(prefix="isodyn-hosts-"))
    try:
        _wire(name)
        with _server(name, folder):
            local = f"postgresql+psycopg://postgres@/postgres?host={folder}&port={PORT}"
            yield Network(name, f"postgresql+psycopg://postgres@{SERVER}:{PORT}/postgres", local)
    finally:
        for each in ("s", *HOSTS):
            subprocess.run(["ip", "netns", "del", f"{name}{each}"], capture_output=True)
        shutil.rmtree(folder)


def _wire(name: str) -> None:
    server = f"{name}s"
    _ip("netns", "add", server)
    _ip("-n", server, "link", "add", "bridge", "type", "bridge")
    _ip("-n", server, "address", "add", f"{SERVER}/24", "dev", "bridge")
    _ip("-n", server, "link", "set", "bridge", "up")
    for number, host in enumerate(HOSTS, 2):
        _ip("netns", "add", f"{name}{host}")
        _ip(
            "-n",
            server,
            "link",
            "add",
            f"port-{host}",
            "type",
            "veth",
            "peer",
            "name",
            "cable",
            "netns",
            f"{name}{host}",
        )
        _ip("-n", server, "link", "set", f"port-{host}", "master", "bridge", "up")
        _ip("-n", f"{name}{host}", "address", "add", f"10.201.0.{number}/24", "dev", "cable")
        for device in ("cable", "lo"):
            _ip("-n", f"{name}{host}", "link", "set", device, "up")


@contextmanager
def _server(name: str, folder: Path) -> Iterator[None]:
    shutil.chown(folder, "postgres", "postgres")
    folder.chmod(0o755)
    data, binaries = folder / "data", POSTGRES[-1].parent
    as_postgres = ["runuser", "-u", "postgres", "--"]
    subprocess.run([*as_postgres, str(binaries / "initdb"), "-D", str(data), "--auth=trust", "--no-sync"],
                   check=True, capture_output=True, cwd="/")  # fmt: skip
    with (data / "pg_hba.conf").open("a") as rules:
        rules.write("host all all 10.201.0.0/24 trust\n")
    command = [*as_postgres, str(binaries / "postgres"), "-D", str(data), "-p", str(PORT), "-k", str(folder),
               "-c", f"listen_addresses={SERVER}", "-c", "fsync=off"]  # fmt: skip
    with (folder / "log").open("w") as log:
        server = subprocess.Popen(["ip", "netns", "exec", f"{name}s", *command], stderr=log, cwd="/")
    try:
        ready = [str(binaries / "pg_isready"), "-q", "-h", str(folder), "-p", str(PORT)]
        deadline = time.monotonic() + 60
        while subprocess.run(ready).returncode != 0:
            assert server.poll() is None, (folder / "log").read_text()
            assert time.monotonic() < deadline, "PostgreSQL did not start"
            time.sleep(0.1)
        yield
    finally:
        subprocess.run([*as_postgres, str(binaries / "pg_ctl"), "-D", str(data), "-m", "immediate", "stop"],
                       capture_output=True, cwd="/")  # fmt: skip
        server.wait(30)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True)
