"""The child of `workers.fit_process`: takes orders for fits, one after the other, and answers them.

A line of JSON on standard input is an order, or what others took of the tiles that the fit offered, which it asks for;
the word `cancel` is for the fit that runs. Answers are lines of JSON on standard output: progress, what is offered to
others, and at the end a result or an error, with whether another order may come. A parent that dies closes the pipe,
and the child ends.
"""

import json
import logging
import os
import queue
import resource
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from opentelemetry.context import attach

from app.errors import IsodynError, JobCancelled, Unavailable
from app.settings import Settings
from app.telemetry.facts import with_facts
from app.telemetry.logs import configure_logs
from app.telemetry.tracing import configure_tracing, flush_traces, traced_from
from workers.builder import load_builder

__all__: list[str] = []

ORPHANED = 4
LOOK_EVERY_S = 0.25
IDLE_S = 60.0  # then its memory is given back
LARGEST_KEPT_KIB = 768 * 1024  # of its highest memory use: an allocator seldom gives back what a large fit took

Progress = Callable[[float, str], None]


class _Orders:
    """What the parent says, heard by a thread of its own."""

    def __init__(self) -> None:
        self.cancelled = threading.Event()
        self.taken: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        self._waiting: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
        threading.Thread(target=self._hear, daemon=True).start()

    def next(self) -> dict[str, Any] | None:
        """The next order; None when none has come for a while."""
        try:
            order = self._waiting.get(timeout=IDLE_S)
        except queue.Empty:
            return None
        self.cancelled.clear()
        return order

    def _hear(self) -> None:
        for line in sys.stdin:
            if line.strip() == "cancel":
                self.cancelled.set()
                continue
            said = json.loads(line)
            if "taken" in said:
                self.taken.put(said)
            else:
                self._waiting.put(said)
        os._exit(ORPHANED)


class _Board:
    """Where a fit offers its tiles to other workers (`app.services.shared_tiles.Board`): the parent has it.

    It is asked for news now and then, and once at a time: what it writes is read, however busy the fit is.
    """

    def __init__(self, say: Callable[[dict[str, Any]], None], orders: _Orders) -> None:
        self._say, self._orders = say, orders
        self._offers, self._taken = 0, dict[int, str | None]()
        self._asked, self._ask_s = False, 0.0

    def offer(self, order_sha256: str, chunks: int) -> None:
        self._offers, self._taken, self._asked = self._offers + 1, {}, False
        self._say({"offer": {"order_sha256": order_sha256, "chunks": chunks}})

    def begin(self, chunk: int) -> None:
        self._say({"begin": chunk})

    def taken(self) -> Mapping[int, str | None]:
        with suppress(queue.Empty):
            while said := self._orders.taken.get_nowait():
                if said["offer"] == self._offers:  # and not of one before
                    self._taken |= dict(said["taken"])
                    self._asked = False
        if not self._asked and time.monotonic() > self._ask_s:
            self._asked, self._ask_s = True, time.monotonic() + LOOK_EVERY_S
            self._say({"look": self._offers})
        return self._taken

    def withdraw(self) -> None:
        self._say({"withdraw": True})


def main() -> None:
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what libraries print must not look like an answer
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # as is a service manager's, sent to all at once
    os.nice(5)  # whoever asks for a position comes first
    settings = Settings()
    configure_logs(settings.log_format, settings.log_level)
    configure_tracing(settings.otel, "isodyn-fit")
    orders = _Orders()

    def say(answer: dict[str, Any]) -> None:
        try:
            answers.write(json.dumps(answer) + "\n")
        except BrokenPipeError:
            os._exit(ORPHANED)

    def progress(fraction: float, message: str) -> None:
        if orders.cancelled.is_set():
            raise JobCancelled("the job was asked to stop")
        say({"fraction": fraction, "message": message})

    board, kept = _Board(say, orders), True
    while kept and (order := orders.next()) is not None:
        attach(traced_from(order.get("trace")))
        with with_facts(**order.get("facts", {})):  # what it logs and traces belongs to the job that it works for
            answer = _answer(order, progress, board)
        kept = "result" in answer and _highest_memory_kib() < LARGEST_KEPT_KIB
        say(answer | {"kept": kept})
    answers.close()
    flush_traces()  # after the answer, which no collector that is away may hold up
    os._exit(0)  # the thread that listens would be in the way of an orderly end


def _highest_memory_kib() -> int:
    """Of this program alone: the highest resident size of a process also counts the one that started it."""
    with suppress(FileNotFoundError), Path("/proc/self/status").open() as status:
        for line in status:
            if line.startswith("VmHWM:"):
                return int(line.split()[1])
    highest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return highest // 1024 if sys.platform == "darwin" else highest


def _answer(order: dict[str, Any], progress: Progress, board: _Board) -> dict[str, Any]:
    from threadpoolctl import threadpool_limits

    from app.blobs import open_blob_store

    try:
        builder = load_builder(order["builder"])
        with threadpool_limits(1):
            blobs = open_blob_store(order["blob_url"], make=False)
            if "chunk" in order:
                return {"result": builder.fit_chunk(**order["chunk"], blobs=blobs, progress=progress)}
            shared = board if order.get("shares") else None  # a parent of an older version would not understand
            return {"result": builder.fit_build(order["plan"], blobs, progress, shared)}
    except Unavailable as error:
        logging.getLogger(__name__).warning("%s: %s", error, error.__cause__)
        return {"unavailable": str(error)}
    except IsodynError as error:
        return {"error": str(error)}
    except Exception as error:
        logging.getLogger(__name__).exception("the fit failed")
        return {"error": f"internal error in the fit ({type(error).__name__}: {error}); the worker's log has its trace"}


if __name__ == "__main__":
    main()
