"""The blob store: immutable bytes under the SHA-256 of their content.

A blob is there whole or not at all: it is written under a temporary name in the same file system, forced to the
disk, and renamed. Putting the same bytes again, also from several processes at once, is the same as putting them once.
"""

import hashlib
import os
import re
import tempfile
from pathlib import Path
from typing import Protocol
from urllib.parse import unquote, urlsplit

from app.errors import CorruptArtefact, InvalidInput, NotFound

__all__ = ["BlobStore", "FolderBlobStore", "open_blob_store"]

_SHA256 = re.compile(r"[0-9a-f]{64}")


class BlobStore(Protocol):
    """What every store keeps to; `BlobStoreContract` in the tests says it in full."""

    def put(self, data: bytes) -> str:
        """Store bytes durably and return their SHA-256, 64 lower-case hexadecimal digits."""
        ...

    def get(self, sha256: str) -> bytes:
        """The bytes, checked. Raises NotFound if there are none, CorruptArtefact if they do not match their hash."""
        ...

    def exists(self, sha256: str) -> bool:
        """Whether the store has a blob of this hash (its content is checked by `get`)."""
        ...

    def discard(self, sha256: str) -> None:
        """Forget a blob that nothing refers to any more; none there is as good."""
        ...


class FolderBlobStore:
    """Blobs in a local folder, fanned out over two levels: `ab/cd/abcd...`."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._temporary = folder / "tmp"
        self._temporary.mkdir(parents=True, exist_ok=True)

    def put(self, data: bytes) -> str:
        sha256 = hashlib.sha256(data).hexdigest()
        target = self._path(sha256)
        if not self._holds(target, sha256):
            self._write(target, data)
        # Also when another process has just renamed it: what this call acknowledges must outlive a power cut. A new
        # folder is on the disk once the folder that names it is.
        for folder in (target.parent, target.parent.parent, self._folder):
            _sync_folder(folder)
        return sha256

    def get(self, sha256: str) -> bytes:
        _check_name(sha256)
        try:
            data = self._path(sha256).read_bytes()
        except FileNotFoundError:
            raise NotFound(f"no blob {sha256} in the store: was the blob folder moved or cleaned?") from None
        if hashlib.sha256(data).hexdigest() != sha256:
            raise CorruptArtefact(
                f"blob {sha256}: its {len(data)} bytes do not match their hash; restore it from a backup, or upload "
                "or build the object again"
            )
        return data

    def exists(self, sha256: str) -> bool:
        _check_name(sha256)
        return self._path(sha256).is_file()

    def discard(self, sha256: str) -> None:
        _check_name(sha256)
        self._path(sha256).unlink(missing_ok=True)

    def _path(self, sha256: str) -> Path:
        return self._folder / sha256[:2] / sha256[2:4] / sha256

    @staticmethod
    def _holds(path: Path, sha256: str) -> bool:
        """Whether the file is there and sound: a damaged one is written anew by the next put."""
        try:
            return hashlib.sha256(path.read_bytes()).hexdigest() == sha256
        except FileNotFoundError:
            return False

    def _write(self, target: Path, data: bytes) -> None:
        descriptor, name = tempfile.mkstemp(dir=self._temporary)
        temporary = Path(name)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            target.parent.mkdir(parents=True, exist_ok=True)
            temporary.replace(target)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise


def open_blob_store(url: str) -> BlobStore:
    """The store at a `file://` address. Raises InvalidInput for addresses that are not offered."""
    parts = urlsplit(url)
    if parts.scheme == "file" and parts.netloc in ("", "localhost") and parts.path.startswith("/"):
        return FolderBlobStore(Path(unquote(parts.path)))
    if parts.scheme == "s3":
        raise InvalidInput(f"blob address {url!r}: s3:// is not offered yet; use file:///FOLDER")
    raise InvalidInput(f"blob address {url!r} cannot be read: use file:///FOLDER with an absolute path")


def _check_name(sha256: str) -> None:
    # Also what keeps `../` out of paths.
    if not _SHA256.fullmatch(sha256):
        raise NotFound(f"{sha256[:80]!r} is not the SHA-256 of a blob: 64 lower-case hexadecimal digits are expected")


def _sync_folder(folder: Path) -> None:
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
