"""One fit in one child process: its memory, its crashes and its hold on the interpreter are not the worker's.

The parent writes a line of JSON, the order, and then at most the word `cancel`; the child writes lines of JSON, its
progress, and at the end a result or an error. A parent that dies closes the pipe, and the child ends.
"""

import json
import logging
import os
import selectors
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from typing import IO, Any

from opentelemetry.context import attach

from app.errors import IsodynError, JobCancelled, Unavailable
from app.settings import Settings
from app.telemetry.facts import add_facts, facts
from app.telemetry.logs import configure_logs
from app.telemetry.tracing import configure_tracing, flush_traces, traced_from, traceparent
from workers.builder import Plan, Result, load_builder

__all__ = ["FitFailed", "FitProcessDied", "run_fit"]

LOOK_EVERY_S = 0.25
CANCEL_GRACE_S = 2.0
MAX_SILENCE_S = 1800.0  # far above the longest step of a fit between two words of progress
ORPHANED = 4
ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OPENBLAS", "OMP", "MKL", "BLIS", "VECLIB")}

Progress = Callable[[float, str], None]


class FitFailed(Exception):
    """The fit itself ended with an error, and would again; the message is for a person."""


class FitProcessDied(Exception):
    """The child ended without a result: killed, out of memory, or unable to start. Worth another try."""


def run_fit(builder: str, plan: Plan, blob_url: str, report: Progress, silence_s: float = MAX_SILENCE_S) -> Result:
    """Run `fit_build` of the module `builder` in a child process and return its result.

    `report` is called from this thread with the last progress, also while the fit is silent; what it raises stops
    the child. A fit that makes no progress for `silence_s` counts as dead. Raises FitFailed, FitProcessDied, and
    Unavailable where the child could not reach its blobs.
    """
    order = {"builder": builder, "plan": plan, "blob_url": blob_url, "facts": dict(facts()), "trace": traceparent()}
    child = subprocess.Popen(
        [sys.executable, "-m", "workers.fit_process"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        env={**os.environ, **ONE_THREAD},
        start_new_session=True,  # a Ctrl-C is for the worker, which decides what becomes of its fits
    )
    try:
        _tell(child, json.dumps(order))
        return _listen(child, report, silence_s)
    finally:
        _stop(child)


def _listen(child: subprocess.Popen[bytes], report: Progress, silence_s: float) -> Result:
    fraction, message, heard = 0.0, "starting", time.monotonic()
    for line in _lines_or_pauses(child):
        if line is None:
            report(fraction, message)
            if time.monotonic() - heard > silence_s:
                raise FitProcessDied(f"the fit made no progress for {silence_s:,.0f} s and was stopped")
            continue
        heard = time.monotonic()
        said: dict[str, Any] = json.loads(line)
        if "result" in said:
            result: Result = said["result"]
            return result
        if "unavailable" in said:
            raise Unavailable(said["unavailable"])
        if "error" in said:
            raise FitFailed(said["error"])
        fraction, message = said["fraction"], said["message"]
        report(fraction, message)
    raise FitProcessDied(_epitaph(child))


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


def main() -> None:
    """The child."""
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w", buffering=1)
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # what libraries print must not look like an answer
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # as is a service manager's, sent to all at once
    os.nice(5)  # whoever asks for a position comes first
    order = json.loads(sys.stdin.readline())
    _be_seen(order)
    cancelled = threading.Event()
    threading.Thread(target=_hear_parent, args=(cancelled,), daemon=True).start()

    def progress(fraction: float, message: str) -> None:
        if cancelled.is_set():
            raise JobCancelled("the job was asked to stop")
        answers.write(json.dumps({"fraction": fraction, "message": message}) + "\n")

    answers.write(json.dumps(_answer(order, progress)) + "\n")
    answers.close()
    flush_traces()
    os._exit(0)  # the thread that listens would be in the way of an orderly end


def _be_seen(order: dict[str, Any]) -> None:
    """What this process logs and traces belongs to the job that it works for."""
    settings = Settings()
    configure_logs(settings.log_format, settings.log_level)
    configure_tracing(settings.otel, "isodyn-fit")
    add_facts(**order.get("facts", {}))
    attach(traced_from(order.get("trace")))


def _answer(order: dict[str, Any], progress: Progress) -> dict[str, Any]:
    from threadpoolctl import threadpool_limits

    from app.blobs import open_blob_store

    try:
        builder = load_builder(order["builder"])
        with threadpool_limits(1):
            return {"result": builder.fit_build(order["plan"], open_blob_store(order["blob_url"]), progress)}
    except Unavailable as error:
        logging.getLogger(__name__).warning("%s: %s", error, error.__cause__)
        return {"unavailable": str(error)}
    except IsodynError as error:
        return {"error": str(error)}
    except Exception as error:
        logging.getLogger(__name__).exception("the fit failed")
        return {"error": f"internal error in the fit ({type(error).__name__}: {error}); the worker's log has its trace"}


def _hear_parent(cancelled: threading.Event) -> None:
    for line in sys.stdin:
        if line.strip() == "cancel":
            cancelled.set()
    os._exit(ORPHANED)


if __name__ == "__main__":
    main()
