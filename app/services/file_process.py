"""The program that reads foreign files: it loads every parser once, and forks a child for each file.

`python -m app.services.file_process FD`: over the socket FD come the web process's orders, messages of `CONTROL`. A
child reads one file, answers over a socket of its own and ends: nothing that its file did to it stays. It can open no
file and no other socket, its memory and processor time are bounded, and it knows no secrets, because this program is
started without them.
"""

import array
import errno
import gc
import io
import os
import resource
import signal
import socket
import sys
import traceback
from pathlib import Path
from typing import NoReturn

import numpy as np
import pyarrow as pa
from PIL import Image
from pyarrow import parquet

from app.errors import InvalidInput, TooLarge
from app.services.file_messages import (
    CONTROL,
    END,
    FORK,
    LENGTH,
    NO_FAULT_OF_THE_FILE,
    NUMBER,
    OUT_OF_MEMORY,
    answer_to_bytes,
    failure_to_bytes,
    order_of,
    refusal_to_bytes,
)
from app.services.file_orders import PictureOrder, SurveyOrder, carry_out


def main() -> None:
    """Serve until the web process closes the socket, or dies."""
    control = socket.socket(fileno=int(sys.argv[1]))
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a service manager's, sent to all at once: the web process decides
    _warm_up()
    gc.collect()
    gc.freeze()  # what is there now stays shared with every child
    children: set[int] = set()
    try:
        control.sendall(NUMBER.pack(os.getpid()))
        while said := _receive(control):
            (what, number, memory_bytes), descriptors = said
            if what == FORK:
                number = _fork()
                if number == 0:
                    control.close()
                    _read_one(socket.socket(fileno=descriptors[0]), said[0][1], memory_bytes)
                if number > 0:
                    children.add(number)
                for descriptor in descriptors:
                    os.close(descriptor)
                control.sendall(NUMBER.pack(number))
            else:
                children.remove(number)
                code = _end(number)
                if what == END:
                    control.sendall(NUMBER.pack(code))
    except (BrokenPipeError, ConnectionResetError):
        return
    finally:
        for number in children:
            _end(number)


def _receive(control: socket.socket) -> tuple[tuple[int, int, int], list[int]] | None:
    """One message and the descriptors that came with it; None at the end."""
    said, ancillary, _, _ = control.recvmsg(CONTROL.size, socket.CMSG_SPACE(4), socket.MSG_WAITALL)
    if not said:
        return None
    descriptors = array.array("i")
    for _, _, data in ancillary:
        descriptors.frombytes(data)
    return CONTROL.unpack(said), list(descriptors)


def _fork() -> int:
    """As `os.fork`; minus the error where that fails, which the other children do not notice."""
    try:
        return os.fork()
    except OSError as error:
        return -(error.errno or errno.EAGAIN)


def _end(child: int) -> int:
    ended, status = os.waitpid(child, os.WNOHANG)
    if not ended:
        os.kill(child, signal.SIGKILL)
        _, status = os.waitpid(child, 0)
    return os.waitstatus_to_exitcode(status)


def _read_one(channel: socket.socket, cpu_s: int, memory_bytes: int) -> NoReturn:
    """The child."""
    code = NO_FAULT_OF_THE_FILE
    try:
        _confine(cpu_s, memory_bytes)
        stream = channel.makefile("rb")
        header, file = (stream.read(*LENGTH.unpack(stream.read(LENGTH.size))) for _ in ("header", "file"))
        order = order_of(header, file)
        try:
            answer = answer_to_bytes(carry_out(order))
        except (InvalidInput, TooLarge) as error:
            answer = refusal_to_bytes(error)
        except MemoryError:
            raise
        except Exception:  # a fault of ours, for the log of the web process
            answer = failure_to_bytes(traceback.format_exc())
        channel.sendall(LENGTH.pack(len(answer)))
        channel.sendall(answer)
        code = 0
    except MemoryError:
        code = OUT_OF_MEMORY
    except Exception:
        traceback.print_exc()
    finally:
        os._exit(code)


def _confine(cpu_s: int, memory_bytes: int) -> None:
    """No file and no socket from here on; so much more memory (on Linux), and processor time. Arrow needs a thread."""
    limits = {resource.RLIMIT_NOFILE: 0, resource.RLIMIT_FSIZE: 0, resource.RLIMIT_CORE: 0}
    if sys.platform == "linux":
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        limits[resource.RLIMIT_AS] = pages * resource.getpagesize() + memory_bytes
    for limit, most in limits.items():
        resource.setrlimit(limit, (most, most))
    # SIGXCPU says why; a second later it would be SIGKILL, which cannot be ignored.
    resource.setrlimit(resource.RLIMIT_CPU, (cpu_s, cpu_s + 1))


def _warm_up() -> None:
    """Read a file of every kind, sound and broken, so that all is loaded that a child may need."""
    names = ("t_s", "x_m", "y_m", "z_m", "bx_ut", "by_ut", "bz_ut")
    rows = [[float(t), 0.0, 0.0, 0.0, 20.0, 0.0, -43.0] for t in range(3)]
    table, out = pa.table(dict(zip(names, np.transpose(rows), strict=True))), io.BytesIO()
    parquet.write_table(table, out)
    csv = "\n".join([",".join(names), *(",".join(map(str, row)) for row in rows)])
    ndjson = "\n".join(str(row).replace("'", '"') for row in table.to_pylist())
    trace = "1569474584017\tTYPE_WAYPOINT\t1.0\t2.0\n1569474585017\tTYPE_WAYPOINT\t3.0\t2.0\n"
    files = {"csv": csv.encode(), "ndjson": ndjson.encode(), "parquet": out.getvalue(),
             "indoor-location-2020": trace.encode()}  # fmt: skip
    for format, data in files.items():
        for each in (data, data[:-5]):
            _try(SurveyOrder(each, format, "building", 0.0))
    for kind in ("PNG", "JPEG", "WEBP"):
        out = io.BytesIO()
        Image.new("RGB", (5000, 4)).save(out, kind)
        _try(PictureOrder(out.getvalue()))


def _try(order: SurveyOrder | PictureOrder) -> None:
    try:
        answer_to_bytes(carry_out(order))
    except InvalidInput as error:
        refusal_to_bytes(error)


if __name__ == "__main__":
    main()
