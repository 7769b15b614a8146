"""Deaths on this machine are known at once: a locked file, which the kernel lets go when its process ends.

A lease runs out after seconds only; a worker restarted beside its predecessor's lock file need not wait for it. Workers
on other machines, or with another data folder, are judged by their lease alone.
"""

import fcntl
import os
import socket
from pathlib import Path
from uuid import uuid4

__all__ = ["Lifeline", "new_worker_id"]

SUFFIX = ".lock"


def new_worker_id() -> str:
    """An id no other worker has had; it begins with the machine's name."""
    return f"{_machine()}{os.getpid()}-{uuid4().hex[:12]}"


class Lifeline:
    """This worker's locked file in `folder`, and a look at those of the others."""

    def __init__(self, folder: Path, worker_id: str) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self._folder = folder
        self._path = folder / f"{worker_id}{SUFFIX}"
        unlocked = folder / f"{worker_id}.new"
        self._descriptor = os.open(unlocked, os.O_CREAT | os.O_WRONLY, 0o600)
        fcntl.flock(self._descriptor, fcntl.LOCK_EX)
        unlocked.replace(self._path)  # seen by others only once it is locked

    def cut(self) -> list[str]:
        """The ids of workers of this machine whose process has ended without a word."""
        files = self._folder.glob(f"{_machine()}*{SUFFIX}")
        return [file.name.removesuffix(SUFFIX) for file in files if file != self._path and _is_free(file)]

    def bury(self, dead_id: str) -> None:
        """Remove the file of a worker that has been taken over from."""
        (self._folder / f"{dead_id}{SUFFIX}").unlink(missing_ok=True)

    def release(self) -> None:
        self._path.unlink(missing_ok=True)
        os.close(self._descriptor)


def _machine() -> str:
    return f"{socket.gethostname()[:60]}-"


def _is_free(file: Path) -> bool:
    try:
        descriptor = os.open(file, os.O_WRONLY)
    except FileNotFoundError:
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    finally:
        os.close(descriptor)
    return True
