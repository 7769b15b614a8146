"""Fits in child processes, one at a time each: their memory, crashes and hold on the interpreter are not the worker's.

`workers.fit_child` is the other side, and says what the two tell each other.
"""

import json
import os
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from typing import IO, Any

from app.errors import Unavailable
from app.jobs.tile_chunks import ChunkBoard
from app.telemetry.facts import facts
from app.telemetry.tracing import traceparent
from workers.builder import Result

__all__ = ["FitFailed", "FitProcessDied", "FitProcesses"]

LOOK_EVERY_S = 0.25
CANCEL_GRACE_S = 2.0
MAX_SILENCE_S = 1800.0  # far above the longest step of a fit between two words of progress
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL", "BLIS", "VECLIB")}

Progress = Callable[[float, str], None]


class FitFailed(Exception):
    """The fit itself ended with an error, and would again; the message is for a person."""


class FitProcessDied(Exception):
    """The child ended without a result: killed, out of memory, or unable to start. Worth another try."""


class FitProcesses:
    """The children of a worker. One that ended its fit well waits for the next a while: starting one costs a second."""

    def __init__(self) -> None:
        self._idle: list[subprocess.Popen[bytes]] = []
        self._lock = threading.Lock()

    def run(
        self,
        builder: str,
        work: Mapping[str, Any],
        blob_url: str,
        report: Progress,
        board: ChunkBoard | None = None,
        silence_s: float = MAX_SILENCE_S,
    ) -> Result:
        """Run the module `builder` in a child process and return its result: `fit_build` where `work` has a `plan`,

        `fit_chunk` where it has a `chunk`. `report` is called from this thread with the last progress, also while the
        fit is silent; what it raises stops the child. A fit that makes no progress for `silence_s` counts as dead.
        `board`: where the fit may offer its tiles to others. Raises FitFailed, FitProcessDied, and Unavailable where
        the child could not reach its blobs.
        """
        order = {"builder": builder, **work, "blob_url": blob_url, "facts": dict(facts()), "trace": traceparent(),
                 "shares": board is not None}  # fmt: skip
        child = self._take()
        try:
            _tell(child, json.dumps(order))
            said = _listen(child, report, board, silence_s)
        except BaseException:
            _stop(child)
            raise
        finally:
            if board is not None:
                board.withdraw()
        self._put_back(child, said["kept"])
        result: Result = said["result"]
        return result

    def close(self) -> None:
        """End the children that wait."""
        while (child := self._pop()) is not None:
            _end(child)

    def _take(self) -> subprocess.Popen[bytes]:
        while (child := self._pop()) is not None:
            if child.poll() is None:
                return child
            _end(child)
        return subprocess.Popen(
            [sys.executable, "-m", "workers.fit_child"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env={**os.environ, **ONE_THREAD},
            start_new_session=True,  # a Ctrl-C is for the worker, which decides what becomes of its fits
        )

    def _put_back(self, child: subprocess.Popen[bytes], kept: bool) -> None:
        if not kept:
            _stop(child)
            return
        with self._lock:
            self._idle.append(child)

    def _pop(self) -> subprocess.Popen[bytes] | None:
        with self._lock:
            return self._idle.pop() if self._idle else None


def _listen(
    child: subprocess.Popen[bytes], report: Progress, board: ChunkBoard | None, silence_s: float
) -> dict[str, Any]:
    """What the child said last: its result."""
    fraction, message, heard = 0.0, "starting", time.monotonic()
    shared = None if board is None else _Shared(child, board)
    for line in _lines_or_pauses(child):
        if line is None:
            report(fraction, message)
            if time.monotonic() - heard > silence_s:
                raise FitProcessDied(f"the fit made no progress for {silence_s:,.0f} s and was stopped")
            continue
        heard = time.monotonic()
        said: dict[str, Any] = json.loads(line)
        if "result" in said:
            return said
        if "unavailable" in said:
            raise Unavailable(said["unavailable"])
        if "error" in said:
            raise FitFailed(said["error"])
        if "fraction" in said:
            fraction, message = said["fraction"], said["message"]
            report(fraction, message)
        elif shared is not None:
            shared.hear(said)
    raise FitProcessDied(_epitaph(child))


class _Shared:
    """Between a child that shares its tiles and the board they are on. What it is told it has asked for: it reads."""

    def __init__(self, child: subprocess.Popen[bytes], board: ChunkBoard) -> None:
        self._child, self._board = child, board
        self._told: Mapping[int, str | None] = {}

    def hear(self, said: dict[str, Any]) -> None:
        if "offer" in said:
            self._told = {}
            self._board.offer(**said["offer"])
        elif "begin" in said:
            self._board.begin(said["begin"])
        elif "look" in said:
            taken = self._board.taken()
            news = [each for each in taken.items() if each not in self._told.items()]
            self._told = taken
            _tell(self._child, json.dumps({"taken": news, "offer": said["look"]}))
        elif "withdraw" in said:
            self._board.withdraw()


def _lines_or_pauses(child: subprocess.Popen[bytes]) -> Iterator[bytes | None]:
    """The child's lines as they come, and None whenever it says nothing for a while."""
    assert child.stdout is not None
    descriptor, buffer = child.stdout.fileno(), b""
    with selectors.DefaultSelector() as selector:
        selector.register(descriptor, selectors.EVENT_READ)
        while True:
            if not selector.select(LOOK_EVERY_S):
                yield None
                continue
            read = os.read(descriptor, 65536)
            if not read:
                return
            *lines, buffer = (buffer + read).split(b"\n")
            yield from lines


def _tell(child: subprocess.Popen[bytes], line: str) -> None:
    assert child.stdin is not None
    try:
        child.stdin.write(line.encode() + b"\n")
        child.stdin.flush()
    except BrokenPipeError:  # it has died; what it leaves says how
        return


def _stop(child: subprocess.Popen[bytes]) -> None:
    """See that the child is gone: ask it first, then kill it."""
    try:
        if child.poll() is None:
            _tell(child, "cancel")
            child.wait(CANCEL_GRACE_S)
    except subprocess.TimeoutExpired:
        child.kill()
    finally:
        for pipe in (child.stdin, child.stdout):
            _close(pipe)
        child.wait()


def _end(child: subprocess.Popen[bytes]) -> None:
    """See that a child is gone that waits for an order: it ends with its input."""
    for pipe in (child.stdin, child.stdout):
        _close(pipe)
    child.wait()


def _close(pipe: IO[bytes] | None) -> None:
    assert pipe is not None
    try:
        pipe.close()
    except BrokenPipeError:  # an order that was never read
        return


def _epitaph(child: subprocess.Popen[bytes]) -> str:
    code = child.wait()
    if code >= 0:
        return f"the fit's process ended with code {code} and no result; the worker's log says more"
    name = signal.Signals(-code).name
    often = ", often because memory ran out" if -code == signal.SIGKILL else ""
    return f"the fit's process was killed ({name}{often})"
