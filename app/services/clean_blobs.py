"""Delete the blobs that nobody names any more, while everything runs, and never one that somebody needs.

A row never names a blob that was not put just before (`BlobStore.put` makes it young again if it was there), or that a
row or an unfinished job names already. So a blob that nobody names now, and that was last put longer ago than any
request or step takes, is named by nobody later either, unless it is put again. That it was not is looked at in the
same step in which it is deleted (`BlobStore.discard_older`).
"""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from itertools import islice

from sqlalchemy.orm import Session, sessionmaker

from app.blobs import BlobStore, StoredBlob
from app.errors import Conflict
from app.jobs.queue import JobQueue
from app.services.backup_archive import Progress
from app.services.check_blobs import named_now

__all__ = ["Cleaned", "clean_blobs"]

_AT_A_TIME = 1000
_FEW = 20


@dataclass(frozen=True, slots=True)
class Cleaned:
    """What was deleted, or would be; `kept` nobody names either, but they are too young."""

    blobs: int
    size_bytes: int
    kept: int


def clean_blobs(
    sessions: sessionmaker[Session], queue: JobQueue, blobs: BlobStore,
    older_than: timedelta, dry_run: bool, progress: Progress, even_most: bool = False,
) -> Cleaned:  # fmt: skip
    """Delete what nobody names and was last put longer ago than that; it must be longer than any request takes.

    Raises Conflict where that is most of the store, unless `even_most`: it may be the store of another database.
    """
    before = datetime.now(UTC) - older_than
    _, named = named_now(sessions, queue)
    total, orphans = 0, []
    for blob in blobs.stored():
        total += 1
        if blob.sha256 not in named:
            orphans.append(blob)
    old = [blob for blob in orphans if blob.stored_at < before]
    if len(old) > max(_FEW, total / 2) and not (dry_run or even_most):
        raise Conflict(
            f"the database names none of {len(old):,} of the {total:,} blobs: is it the one that they belong to? See "
            "ISODYN_DATABASE_URL and ISODYN_BLOB_URL; if so, give --even-most"
        )
    count = size_bytes = done = 0
    for batch in _batches(old):
        _, named = named_now(sessions, queue)
        for blob in batch:
            done += 1
            progress("blobs", done, len(old))
            if blob.sha256 not in named and (dry_run or blobs.discard_older(blob.sha256, before)):
                count, size_bytes = count + 1, size_bytes + blob.size_bytes
    return Cleaned(count, size_bytes, len(orphans) - count)


def _batches(of: list[StoredBlob]) -> Iterator[list[StoredBlob]]:
    left = iter(of)
    while batch := list(islice(left, _AT_A_TIME)):
        yield batch
