"""A server of the S3 API on this machine (moto's, in a process of its own), and a way to it that can be cut.

The server keeps its objects in memory, so it cannot die and come back with them: what dies in these tests is the way.
It checks neither keys nor signatures until `Server.check_keys`.
"""

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.client import HTTPConnection
from importlib.util import find_spec
from pathlib import Path

import pytest

ENVIRONMENT = {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_REGION": "us-east-1"}
BUCKET = "isodyn-test"


class Server:
    """`python -m moto.server` with one bucket."""

    def __init__(self, log: Path) -> None:
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._log = log
        with log.open("wb") as file:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "moto.server", "-H", "127.0.0.1", "-p", str(self.port)],
                stdout=file,
                stderr=file,
            )

    def wait(self) -> None:
        """Until it answers. Raises RuntimeError if it does not within a minute."""
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline and self._process.poll() is None:
            with suppress(OSError):
                return self.ask("PUT", f"/{BUCKET}")
            time.sleep(0.05)
        raise RuntimeError(f"no server of the S3 API at {self.url}: {self._log.read_text()[-500:]}")

    def ask(self, method: str, path: str, body: bytes = b"") -> None:
        """A plain request, to make buckets and to tamper with objects behind the store's back."""
        signed = {"Authorization": "AWS4-HMAC-SHA256 Credential=testing/20260101/us-east-1/s3/aws4_request"}
        connection = HTTPConnection("127.0.0.1", self.port, timeout=10)
        try:
            connection.request(method, path, body, signed)
            answer = connection.getresponse()
            answer.read()
            assert answer.status < 300, (method, path, answer.status)
        finally:
            connection.close()

    @contextmanager
    def check_keys(self) -> Iterator[None]:
        """For a while, keys are checked, and none is known."""
        self.ask("POST", "/moto-api/reset-auth", b"0")
        try:
            yield
        finally:
            self.ask("POST", "/moto-api/reset-auth", b"inf")

    def stop(self) -> None:
        self._process.terminate()
        self._process.wait()


class Way:
    """A relay to a server, with a port of its own: `cut` it at any moment, after any number of bytes, and `mend` it."""

    def __init__(self, to_port: int) -> None:
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._to_port = to_port
        self._open: set[socket.socket] = set()
        self._lock = threading.Lock()
        self._listener: socket.socket | None = None
        self._threads: list[threading.Thread] = []
        self._left: int | None = None
        self.mend()

    def mend(self, cut_after: int | None = None) -> None:
        """Let through: everything, or this many bytes of requests."""
        self._left = cut_after
        self._listener = socket.create_server(("127.0.0.1", self.port))
        self._start(self._accept, self._listener)

    def cut(self) -> None:
        """Nobody listens any more, and every connection there was is gone."""
        with self._lock:
            listener, self._listener = self._listener, None
            ends, self._open = self._open, set()
        if listener is not None:
            with suppress(OSError):
                listener.shutdown(socket.SHUT_RDWR)  # wakes who accepts
            listener.close()
        for end in ends:
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def close(self) -> None:
        self.cut()
        for thread in self._threads:
            thread.join(10)

    def _start(self, work: object, *arguments: object) -> None:
        thread = threading.Thread(target=work, args=arguments, daemon=True)  # type: ignore[arg-type]
        self._threads.append(thread)
        thread.start()

    def _accept(self, listener: socket.socket) -> None:
        with suppress(OSError):
            while True:
                near, _ = listener.accept()
                far = socket.create_connection(("127.0.0.1", self._to_port))
                with self._lock:
                    self._open |= {near, far}
                self._start(self._both, near, far)

    def _both(self, near: socket.socket, far: socket.socket) -> None:
        answers = threading.Thread(target=self._carry, args=(far, near, False), daemon=True)
        answers.start()
        self._carry(near, far, True)
        answers.join()
        with self._lock:
            self._open -= {near, far}
        near.close()
        far.close()

    def _carry(self, source: socket.socket, sink: socket.socket, counted: bool) -> None:
        with suppress(OSError):
            while data := source.recv(65536):
                if counted and self._left is not None:
                    self._left -= len(data)
                    if self._left < 0:
                        self.cut()
                        break
                sink.sendall(data)
        for end in (source, sink):
            with suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def started(log: Path) -> Server:
    """A server that answers. Without one the tests are skipped, but where `CI` is set they fail."""
    reason = "no server of the S3 API: pip install 'moto[server,s3]'"
    if find_spec("moto") is not None and find_spec("flask_cors") is not None:
        server = Server(log)
        try:
            server.wait()
        except RuntimeError as error:
            server.stop()
            reason = str(error)
        else:
            return server
    if os.environ.get("CI"):
        pytest.fail(reason)
    pytest.skip(reason)
