"""What every blob store keeps to: immutable bytes under the SHA-256 of their content, there whole or not at all."""

import re
from collections.abc import Iterator
from datetime import datetime
from typing import NamedTuple, Protocol

from app.errors import NotFound

__all__ = ["BlobStore", "StoredBlob", "check_name", "is_name"]

_SHA256 = re.compile(r"[0-9a-f]{64}")


class StoredBlob(NamedTuple):
    """A blob as the store lists it; its content is checked by `get`."""

    sha256: str
    size_bytes: int
    stored_at: datetime


class BlobStore(Protocol):
    """What every store keeps to; `BlobStoreContract` in the tests says it in full.

    Every method raises Unavailable where the store cannot be used now (no answer, no disk, no room on it); then nothing
    was acknowledged.
    """

    def put(self, data: bytes) -> str:
        """Store bytes durably and return their SHA-256, 64 lower-case hexadecimal digits.

        Also where they are there already, `stored_at` is now: what was put of late may be about to be named.
        """
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

    def discard_older(self, sha256: str, before: datetime) -> bool:
        """Forget a blob last put before this time, and say whether it was forgotten by this call.

        Against a `put` of the same bytes at the same moment: either this sees the new time and keeps the blob, or that
        finds no blob and writes it.
        """
        ...

    def stored(self) -> Iterator[StoredBlob]:
        """Every blob there is, in order of hash; those that come or go meanwhile may be among them or not."""
        ...


def check_name(sha256: str) -> None:
    """Raises NotFound for what is no SHA-256 in hexadecimal digits."""
    # Also what keeps `../` out of paths.
    if not is_name(sha256):
        raise NotFound(f"{sha256[:80]!r} is not the SHA-256 of a blob: 64 lower-case hexadecimal digits are expected")


def is_name(name: str) -> bool:
    """Whether this is a SHA-256 as the stores write it."""
    return _SHA256.fullmatch(name) is not None
