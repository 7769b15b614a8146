"""Foreign files, read in processes of their own (`app.services.file_process`), under bounds of memory and time.

A file that kills its process, or takes more than it may, is refused; this process, and other files, are not affected.
Where a process is killed by somebody else (the kernel, for lack of memory), or there can be none, the file is not to
blame: Unavailable.
"""

import array
import contextlib
import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from math import ceil
from threading import BoundedSemaphore, Lock
from time import monotonic

from app.errors import CorruptArtefact, Fault, InvalidInput, Unavailable, UnreadableSurvey
from app.services.file_messages import (
    CONTROL,
    END,
    FORGET,
    FORK,
    LENGTH,
    MAX_ANSWER_BYTES,
    NO_FAULT_OF_THE_FILE,
    NUMBER,
    OUT_OF_MEMORY,
    order_header,
    told,
)
from app.services.file_orders import Order, PictureOrder, SurveyOrder
from app.services.receive_plan import Picture
from app.survey.walk import Walk

__all__ = ["FileReaders"]

_log = logging.getLogger(__name__)
_START_S = 60.0
_ENDED = "it ended the process that read it, by its size or by a fault in it; write it anew, in another format"
_NOT_ITS_FAULT = frozenset({NO_FAULT_OF_THE_FILE, -signal.SIGKILL})
_PASSED_ON = frozenset({"PATH", "PYTHONPATH", "LANG", "LC_ALL", "TZ", "LD_LIBRARY_PATH", "VIRTUAL_ENV"})
_ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "ARROW_DEFAULT_MEMORY_POOL": "system",
                "PYTHONUNBUFFERED": "1"}  # fmt: skip


class FileReaders:
    """Reads at most `processes` files at once, each with `memory_bytes` for itself and `seconds` of time.

    The program that forks is started by the first file, or before by `start`.
    """

    def __init__(self, processes: int, memory_bytes: int, seconds: float) -> None:
        self._memory_bytes, self._seconds = memory_bytes, seconds
        self._slots = BoundedSemaphore(processes)
        self._program: _Program | None = None
        self._starting = Lock()

    def start(self) -> None:
        """Make ready: takes a second or two."""
        self._running()

    def survey(self, order: SurveyOrder) -> Walk:
        """As `read_on_floor`. Raises UnreadableSurvey, TooLarge, and Unavailable where no process can read it."""
        answer = self._read(order, UnreadableSurvey)
        assert isinstance(answer, Walk)
        return answer

    def picture(self, data: bytes) -> Picture:
        """As `redraw`. Raises InvalidInput, TooLarge, and Unavailable where no process can read it."""
        answer = self._read(PictureOrder(data), InvalidInput)
        assert isinstance(answer, Picture)
        return answer

    def close(self) -> None:
        """End every process, also those that are reading."""
        with self._starting:
            if self._program is not None:
                self._program.close()
                self._program = None

    def _read(self, order: Order, refused: type[InvalidInput]) -> Walk | Picture:
        with self._slots:
            answer, code = self._ask(order)
        if answer is None:
            _log.warning("a file's reader ended without an answer: %s", "too slow" if code is None else code)
            if code in _NOT_ITS_FAULT:
                raise Unavailable("the process that read the file was ended, for lack of memory perhaps; send it again")
            why = self._why(code)
        else:
            try:
                return told(answer, order)
            except CorruptArtefact as error:
                _log.warning("a file's reader was not believed: %s", error)
                why = _ENDED
        raise refused(f"the file cannot be read: {why}", Fault("file", why))

    def _ask(self, order: Order) -> tuple[bytes | None, int | None]:
        """The answer, or None and how its process ended (None: by our patience)."""
        for last_try in (False, True):
            program = self._running()
            ours, theirs = socket.socketpair()
            with ours, theirs:
                try:
                    child = program.fork(theirs, ceil(self._seconds), self._memory_bytes)
                except OSError as error:
                    if last_try:
                        raise Unavailable("files cannot be read now; send it again") from error
                    self._restart(program)
                    continue
                theirs.close()
                answer, in_time = None, True
                try:
                    answer = _converse(ours, order, monotonic() + self._seconds)
                except TimeoutError:
                    in_time = False
                except OSError:
                    pass  # its exit code says more
                if answer is not None:
                    program.forget(child)
                    return answer, None
                code = program.end(child)
                return None, code if in_time else None
        raise AssertionError("unreachable")

    def _why(self, code: int | None) -> str:
        if code is None or code == -signal.SIGXCPU:
            return f"it took longer than {self._seconds:g} s to read and was stopped; split it into several walks"
        if code == OUT_OF_MEMORY:
            return f"it takes more than {self._memory_bytes / 2**20:,.0f} MiB of memory to read; is it what it says?"
        return _ENDED

    def _running(self) -> "_Program":
        with self._starting:
            if self._program is None:
                self._program = _Program()
            return self._program

    def _restart(self, gone: "_Program") -> None:
        with self._starting:
            if self._program is gone:
                gone.close()
                self._program = None


class _Program:
    """A running `app.services.file_process`. Raises OSError when it has died."""

    def __init__(self) -> None:
        self._control, theirs = socket.socketpair()
        self._turn = Lock()
        try:
            with theirs:
                self._process = subprocess.Popen(
                    [sys.executable, "-m", "app.services.file_process", str(theirs.fileno())],
                    pass_fds=(theirs.fileno(),),
                    stdin=subprocess.DEVNULL,
                    stdout=subprocess.DEVNULL,
                    env={name: os.environ[name] for name in _PASSED_ON if name in os.environ} | _ENVIRONMENT,
                    start_new_session=True,  # a Ctrl-C is for the web process, which decides what becomes of its files
                )
        except OSError as error:
            self._control.close()
            raise Unavailable("the process that reads files cannot be started now; send it again") from error
        try:
            self._control.settimeout(_START_S)
            self._number()
        except OSError as error:
            self.close()
            raise Unavailable("the process that reads files did not start; the server's log says more") from error

    def fork(self, channel: socket.socket, cpu_s: int, memory_bytes: int) -> int:
        """A new child that serves this socket: its process id. Raises Unavailable where there can be none."""
        with self._exchange():
            descriptors = array.array("i", [channel.fileno()])
            rights = (socket.SOL_SOCKET, socket.SCM_RIGHTS, descriptors)
            self._control.sendmsg([CONTROL.pack(FORK, cpu_s, memory_bytes)], [rights])
            number = self._number()
        if number < 0:
            raise Unavailable(f"no process can be started to read the file: {os.strerror(-number)}; send it again")
        return number

    def end(self, child: int) -> int:
        """See that a child is gone: its exit code, or minus the signal that ended it."""
        with contextlib.suppress(OSError), self._exchange():
            self._control.sendall(CONTROL.pack(END, child, 0))
            return self._number()
        return -signal.SIGKILL

    def forget(self, child: int) -> None:
        """The same, without waiting for it."""
        with contextlib.suppress(OSError), self._exchange():
            self._control.sendall(CONTROL.pack(FORGET, child, 0))

    @contextlib.contextmanager
    def _exchange(self) -> Iterator[None]:
        """One at a time, and none after one that failed: its answer, come late, would be taken for that to the next."""
        with self._turn:
            try:
                yield
            except OSError:
                self._control.close()
                raise

    def close(self) -> None:
        self._control.close()  # it kills its children, and ends
        try:
            self._process.wait(5.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _number(self) -> int:
        said = self._control.recv(NUMBER.size, socket.MSG_WAITALL)
        if len(said) < NUMBER.size:
            raise ConnectionResetError("the process that reads files has ended")
        number: int = NUMBER.unpack(said)[0]
        return number


def _converse(channel: socket.socket, order: Order, deadline: float) -> bytes | None:
    """Send an order, receive its answer. Raises TimeoutError, and OSError where the child has gone."""
    header = order_header(order)
    for part in filter(None, (LENGTH.pack(len(header)), header, LENGTH.pack(len(order.data)), order.data)):
        channel.settimeout(max(deadline - monotonic(), 0.001))  # an empty file is answered before it could be sent
        channel.sendall(part)
    (length,) = LENGTH.unpack(_received(channel, LENGTH.size, deadline))
    if length > MAX_ANSWER_BYTES:
        return b""  # which is not believed
    return bytes(_received(channel, length, deadline))


def _received(channel: socket.socket, count: int, deadline: float) -> bytearray:
    data = bytearray(count)
    view, got = memoryview(data), 0
    while got < count:
        channel.settimeout(max(deadline - monotonic(), 0.001))
        read = channel.recv_into(view[got:])
        if not read:
            raise ConnectionError("the reader has ended")
        got += read
    return data
