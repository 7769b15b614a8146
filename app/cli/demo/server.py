"""The demonstration's own server: a child process on its own data, in a folder that nobody else's files are in."""

import fcntl
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx

__all__ = ["DemoError", "DemoServer", "clean_folder", "running_server"]

MARKER = ".isodyn-demo"
HOST = "127.0.0.1"
READY_WITHIN_S = 60.0
STOP_WITHIN_S = 25.0


class DemoError(Exception):
    """The demonstration cannot go on; the message says why and what to do."""


@dataclass(frozen=True, slots=True)
class DemoServer:
    """A server that answers: its address, its admin key, its process and its log."""

    url: str
    key: str
    process: subprocess.Popen[bytes]
    log: Path


@contextmanager
def clean_folder(folder: Path) -> Iterator[Path]:
    """The output folder, emptied of the last demonstration and locked for this one.

    A folder that a demonstration did not make, and that holds anything, is refused. Raises DemoError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    marker = folder / MARKER
    if not marker.exists() and any(folder.iterdir()):
        raise DemoError(f"{folder} holds files that no demo made; choose another folder with --output")
    with marker.open("a") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise DemoError(f"another demo is running in {folder}; stop it, or choose another --output") from error
        for path in folder.iterdir():
            if path.name == "var" and path.is_dir() and not path.is_symlink():
                shutil.rmtree(path)
            elif path.suffix in (".png", ".html", ".json", ".log"):
                path.unlink()
        yield folder


@contextmanager
def running_server(folder: Path, port: int | None) -> Iterator[DemoServer]:
    """`isodyn serve` on `folder`/var with a key made for it, ready to answer; stopped at the end. Raises DemoError."""
    port = _checked(port) if port else _free_port()
    key = "isd_" + secrets.token_urlsafe(24)
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("ISODYN_")}
    settings = {"ISODYN_DATA_DIR": str(folder.resolve() / "var"), "ISODYN_ADMIN_KEY": key}
    log = folder / "server.log"
    command = [sys.executable, "-m", "app.cli", "serve", "--host", HOST, "--port", str(port)]
    with log.open("wb") as out:
        process = subprocess.Popen(
            command, env=inherited | settings, stdout=out, stderr=subprocess.STDOUT, start_new_session=True
        )
    server = DemoServer(f"http://{HOST}:{port}", key, process, log)
    try:
        _wait_until_ready(server)
        yield server
    finally:
        _stop(process)


def _wait_until_ready(server: DemoServer) -> None:
    deadline = time.monotonic() + READY_WITHIN_S
    while time.monotonic() < deadline:
        if server.process.poll() is not None:
            raise DemoError(f"the server did not start; its last words:\n{_last_words(server.log)}")
        try:
            if httpx.get(f"{server.url}/readyz", timeout=5).status_code == 200:
                return
        except httpx.TransportError:
            pass
        time.sleep(0.1)
    raise DemoError(
        f"the server was not ready after {READY_WITHIN_S:g} s; see {server.log}:\n{_last_words(server.log)}"
    )


def _stop(process: subprocess.Popen[bytes]) -> None:
    """Ask the server to end its worker and itself; make sure of it."""
    if process.poll() is not None:
        return
    process.send_signal(signal.SIGINT)
    try:
        process.wait(STOP_WITHIN_S)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):  # its worker ends when it sees that its parent is gone
        process.kill()
        process.wait()


def _last_words(log: Path) -> str:
    return "\n".join(log.read_text(errors="replace").splitlines()[-15:])


def _checked(port: int) -> int:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except OSError as error:
            raise DemoError(f"port {port} is taken; leave --port out to use a free one") from error
    return port


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind((HOST, 0))
        return int(probe.getsockname()[1])
