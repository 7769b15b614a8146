"""The archive of a backup: a ZIP file of rows and blobs, with a manifest written last.

`rows/TABLE.ndjson`   a table's rows, a line each (`app.db.portable_rows`), in order of the primary key
`blobs/SHA256`        a blob, stored as it is
`manifest.json`       program, schema revision, time; each table's columns and rows; each member's bytes and SHA-256

It is written under a temporary name in the same folder, forced to the disk, and renamed.
"""

import hashlib
import json
import os
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from struct import error as StructError
from types import TracebackType
from typing import IO, Self

from app.errors import Conflict, CorruptArtefact, InvalidInput, NotFound

__all__ = ["ArchiveReader", "ArchiveWriter", "Manifest", "Member", "Progress", "StoredTable"]

FORMAT = "isodyn-backup-1"
MANIFEST = "manifest.json"
_CHUNK_BYTES = 2**20
_DAMAGE = (zipfile.BadZipFile, zlib.error, EOFError, OSError, KeyError, ValueError, RuntimeError, StructError)

Progress = Callable[[str, int, int], None]
"""Told what is being done, how far it is, and how far it goes."""


@dataclass(frozen=True, slots=True)
class Member:
    size_bytes: int
    sha256: str


@dataclass(frozen=True, slots=True)
class StoredTable:
    columns: Mapping[str, str]
    rows: int


@dataclass(slots=True)
class Manifest:
    """What an archive says of itself. `missing`: blobs that were named when it was made, and could not be read."""

    program: str
    revision: str
    created_at: str
    tables: dict[str, StoredTable] = field(default_factory=dict)
    members: dict[str, Member] = field(default_factory=dict)
    missing: list[str] = field(default_factory=list)
    format: str = FORMAT

    def as_bytes(self) -> bytes:
        return json.dumps(asdict(self), indent=1).encode()

    @classmethod
    def from_bytes(cls, data: bytes) -> "Manifest":
        """Raises ValueError, TypeError, KeyError for what is no manifest."""
        told = json.loads(data)
        if told["format"] != FORMAT:
            raise ValueError(f"it is of format {told['format']}, this program reads {FORMAT}")
        told["tables"] = {name: StoredTable(**each) for name, each in told["tables"].items()}
        told["members"] = {name: Member(**each) for name, each in told["members"].items()}
        return cls(**told)


class ArchiveWriter:
    """Writes an archive: whole under its name after the `with` block, or not there at all."""

    def __init__(self, path: Path, manifest: Manifest) -> None:
        """Raises Conflict where there is such a file already, NotFound where its folder is not."""
        if path.exists():
            raise Conflict(f"{path} is there already; backups are never overwritten: give another name")
        if not path.parent.is_dir():
            raise NotFound(f"there is no folder {path.parent} to write a backup to; make it first")
        self._path, self._manifest = path, manifest

    def __enter__(self) -> Self:
        descriptor, name = tempfile.mkstemp(dir=self._path.parent, prefix=f".{self._path.name}.", suffix=".partial")
        self._temporary = Path(name)
        self._file = os.fdopen(descriptor, "w+b")
        self._zip = zipfile.ZipFile(self._file, "w", zipfile.ZIP_STORED)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        try:
            if kind is None:
                self._finish()
        finally:
            with suppress(Exception):  # given up: whether its end could be written does not matter any more
                self._zip.close()
            with suppress(OSError):
                self._file.close()
            self._temporary.unlink(missing_ok=True)

    def add(self, name: str, parts: Iterable[bytes], *, packed: bool = False) -> None:
        """Write a member from its parts, one after the other."""
        info = zipfile.ZipInfo(name)
        info.compress_type = zipfile.ZIP_DEFLATED if packed else zipfile.ZIP_STORED
        size, digest = 0, hashlib.sha256()
        with self._zip.open(info, "w", force_zip64=True) as member:
            for part in parts:
                member.write(part)
                digest.update(part)
                size += len(part)
        self._manifest.members[name] = Member(size, digest.hexdigest())

    def _finish(self) -> None:
        self._zip.writestr(MANIFEST, self._manifest.as_bytes(), zipfile.ZIP_DEFLATED)
        self._zip.close()
        self._file.flush()
        os.fsync(self._file.fileno())
        if self._path.exists():
            raise Conflict(f"{self._path} has come meanwhile; backups are never overwritten: give another name")
        self._temporary.replace(self._path)
        descriptor = os.open(self._path.parent, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)


class ArchiveReader:
    """Reads an archive; `verify` before anything in it is believed."""

    def __init__(self, path: Path) -> None:
        """Raises NotFound, InvalidInput for what is no archive of ours, CorruptArtefact for one cut short."""
        if not path.is_file():
            raise NotFound(f"there is no archive {path}")
        self.path = path
        try:
            self._zip = zipfile.ZipFile(path)
        except _DAMAGE as error:
            raise CorruptArtefact(
                f"{path} is no whole archive ({error}): cut short, or not a backup; take another"
            ) from error
        try:
            self.manifest = Manifest.from_bytes(self._zip.read(MANIFEST))
        except (*_DAMAGE, TypeError) as error:
            self._zip.close()
            raise InvalidInput(f"{path}: its manifest cannot be read ({error}); take another backup") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._zip.close()

    @property
    def blobs(self) -> list[str]:
        """The hashes of the blobs it has."""
        return [name.removeprefix("blobs/") for name in self.manifest.members if name.startswith("blobs/")]

    def verify(self, progress: Progress) -> None:
        """Read every byte. Raises CorruptArtefact, naming what is damaged, missing or too many."""
        members = self.manifest.members
        held = sorted(set(self._zip.namelist()) - {MANIFEST})
        if held != sorted(members) or len(self._zip.namelist()) != len(members) + 1:
            odd = sorted(set(held) ^ set(members))[:3]
            raise CorruptArtefact(f"{self.path}: its members are not those of its manifest ({', '.join(odd)})")
        if absent := [name for name in self.manifest.tables if f"rows/{name}.ndjson" not in members]:
            raise CorruptArtefact(f"{self.path}: it has no rows of {', '.join(absent)}")
        total = sum(each.size_bytes for each in members.values())
        done = 0
        for name, told in members.items():
            digest, size = hashlib.sha256(), 0
            for part in self._parts(name):
                digest.update(part)
                size += len(part)
                progress("checking the archive", done + size, total)
            done += size
            wanted = name.removeprefix("blobs/") if name.startswith("blobs/") else told.sha256
            if (size, digest.hexdigest()) != (told.size_bytes, told.sha256) or told.sha256 != wanted:
                raise CorruptArtefact(f"{self.path}: {name} is damaged; take another backup")

    def blob(self, sha256: str) -> bytes:
        return b"".join(self._parts(f"blobs/{sha256}"))

    def lines(self, table: str) -> Iterator[bytes]:
        """The rows of a table, a line each."""
        with self._readable(f"rows/{table}.ndjson") as member:
            yield from member

    def _parts(self, name: str) -> Iterator[bytes]:
        with self._readable(name) as member:
            while part := member.read(_CHUNK_BYTES):
                yield part

    @contextmanager
    def _readable(self, name: str) -> Iterator[IO[bytes]]:
        try:
            with self._zip.open(name) as member:
                yield member
        except _DAMAGE as error:
            raise CorruptArtefact(f"{self.path}: {name} is damaged ({error}); take another backup") from error
