"""Blobs in a local folder. Putting the same bytes again, also from several processes at once, is the same as once.

A blob is written under a temporary name in the same file system, forced to the disk, and renamed. The time of its file
says when it was last put. A lock, `tmp/lock`, held for moments only, keeps putting and discarding by age apart.

What the disk refuses (it is full, read-only, gone, failing) is Unavailable, as of a store that cannot be reached:
nothing was acknowledged, and the same call does once the disk is well again.
"""

import errno
import fcntl
import hashlib
import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from app.blobs.observed import observed
from app.blobs.store import StoredBlob, check_name, is_name
from app.errors import CorruptArtefact, NotFound, Unavailable

__all__ = ["FolderBlobStore"]

ADVICE = {
    errno.ENOSPC: "make room, then send it again; `isodyn clean` forgets what nothing names",
    errno.EDQUOT: "make room or raise the quota, then send it again",
    errno.EROFS: "mount it for writing, then send it again",
    errno.ENOENT: "is its disk mounted, and is ISODYN_BLOB_URL or ISODYN_DATA_DIR right? `isodyn doctor` names it",
    errno.EACCES: "the process may not read or write there",
}


class FolderBlobStore:
    """Blobs in a local folder, fanned out over two levels: `ab/cd/abcd...`."""

    def __init__(self, folder: Path, *, make: bool = True) -> None:
        """`make`: make the folder where there is none. Once there was one its disk is away, and one made in its place
        would take what is put, and hide it when the disk is back."""
        self._folder = folder
        self._temporary = folder / "tmp"
        if make:
            with self._disk_at_hand():
                self._temporary.mkdir(parents=True, exist_ok=True)

    @observed
    def put(self, data: bytes) -> str:
        sha256 = hashlib.sha256(data).hexdigest()
        target = self._path(sha256)
        with self._disk_at_hand():
            if not (self._holds(target, sha256) and self._refresh(target)):
                self._write(target, data)
            # Also when another process has just renamed it: what this call acknowledges must outlive a power cut. A
            # new folder is on the disk once the folder that names it is.
            for folder in (target.parent, target.parent.parent, self._folder):
                _sync_folder(folder)
        return sha256

    @observed
    def get(self, sha256: str) -> bytes:
        check_name(sha256)
        try:
            with self._disk_at_hand(but=FileNotFoundError):
                data = self._path(sha256).read_bytes()
        except FileNotFoundError:
            self._look_for_folder()
            raise NotFound(f"no blob {sha256} in the store: was the blob folder moved or cleaned?") from None
        if hashlib.sha256(data).hexdigest() != sha256:
            raise CorruptArtefact(
                f"blob {sha256}: its {len(data)} bytes do not match their hash; restore it from a backup, or upload "
                "or build the object again"
            )
        return data

    @observed
    def exists(self, sha256: str) -> bool:
        check_name(sha256)
        with self._disk_at_hand():
            if self._path(sha256).is_file():
                return True
        self._look_for_folder()
        return False

    @observed
    def discard(self, sha256: str) -> None:
        check_name(sha256)
        with self._disk_at_hand():
            self._path(sha256).unlink(missing_ok=True)

    @observed
    def discard_older(self, sha256: str, before: datetime) -> bool:
        check_name(sha256)
        path = self._path(sha256)
        with self._disk_at_hand(), self._locked(fcntl.LOCK_EX):
            try:
                if datetime.fromtimestamp(path.stat().st_mtime, UTC) >= before:
                    return False
                path.unlink()
            except FileNotFoundError:
                return False
        return True

    def stored(self) -> Iterator[StoredBlob]:
        self._look_for_folder()
        for path in sorted(self._folder.glob("[0-9a-f][0-9a-f]/[0-9a-f][0-9a-f]/*")):
            if not is_name(path.name):  # somebody else's file
                continue
            try:
                told = path.stat()
            except FileNotFoundError:  # discarded meanwhile
                continue
            yield StoredBlob(path.name, told.st_size, datetime.fromtimestamp(told.st_mtime, UTC))

    def _look_for_folder(self) -> None:
        """Raises Unavailable where the whole folder is gone, not a blob: its disk was unmounted, say."""
        with self._disk_at_hand():
            self._temporary.stat()

    @contextmanager
    def _disk_at_hand(self, but: type[OSError] | tuple[()] = ()) -> Iterator[None]:
        """What the disk refuses is Unavailable, all but one kind of error."""
        try:
            yield
        except but:
            raise
        except OSError as error:
            why = (error.strerror or type(error).__name__).lower()
            more = f": {ADVICE[error.errno]}" if error.errno in ADVICE else ""
            raise Unavailable(f"the blob folder cannot be used now ({why}){more}") from error

    def _path(self, sha256: str) -> Path:
        return self._folder / sha256[:2] / sha256[2:4] / sha256

    @staticmethod
    def _holds(path: Path, sha256: str) -> bool:
        """Whether the file is there and sound: a damaged one is written anew by the next put."""
        try:
            return hashlib.sha256(path.read_bytes()).hexdigest() == sha256
        except FileNotFoundError:
            return False

    def _refresh(self, path: Path) -> bool:
        """Set the file's time to now; False when it was discarded meanwhile."""
        with self._locked(fcntl.LOCK_SH):
            try:
                os.utime(path)
            except FileNotFoundError:
                return False
        return True

    @contextmanager
    def _locked(self, kind: int) -> Iterator[None]:
        descriptor = os.open(self._temporary / "lock", os.O_RDWR | os.O_CREAT, 0o666)
        try:
            try:
                fcntl.flock(descriptor, kind)
            except OSError:  # a file system without locks: there nobody can discard by age, and putting needs none
                if kind == fcntl.LOCK_EX:
                    raise
            yield
        finally:
            os.close(descriptor)

    def _write(self, target: Path, data: bytes) -> None:
        descriptor, name = tempfile.mkstemp(dir=self._temporary)
        temporary = Path(name)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            target.parent.mkdir(parents=True, exist_ok=True)
            with self._locked(fcntl.LOCK_SH):
                temporary.replace(target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
