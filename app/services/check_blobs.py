"""Look at every blob: which are damaged, which are named but not there, and which nobody names."""

from dataclasses import dataclass, field
from datetime import datetime

from sqlalchemy.orm import Session, sessionmaker

from app.blobs import BlobStore, StoredBlob
from app.errors import CorruptArtefact, NotFound
from app.jobs.queue import JobQueue
from app.services.backup_archive import Progress
from app.services.references import References, carried_by_jobs, references

__all__ = ["BlobHealth", "check_blobs", "named_now"]


@dataclass(slots=True)
class BlobHealth:
    """What was found. `damaged` are those that something needs, `damaged_caches` those that nothing does."""

    named: References
    checked: int = 0
    checked_bytes: int = 0
    damaged: list[StoredBlob] = field(default_factory=list)
    damaged_caches: list[StoredBlob] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    missing_caches: list[str] = field(default_factory=list)
    orphaned: list[StoredBlob] = field(default_factory=list)
    young: int = 0


def check_blobs(
    sessions: sessionmaker[Session], queue: JobQueue, blobs: BlobStore, before: datetime, progress: Progress
) -> BlobHealth:
    """Read every blob and compare it with its hash. Orphaned: that nobody names, and last put before this time."""
    listed = sum(1 for _ in blobs.stored())
    named, every = named_now(sessions, queue)
    health, needed = BlobHealth(named), named.all_needed
    for number, blob in enumerate(blobs.stored(), 1):
        _check(health, blobs, blob, needed)
        if blob.sha256 not in every:
            if blob.stored_at < before:
                health.orphaned.append(blob)
            else:
                health.young += 1
        progress("blobs", number, max(listed, number))
    absent = [sha256 for sha256 in sorted(named.all) if not blobs.exists(sha256)]
    with sessions() as session:  # once more: what named it may have been removed since
        still = references(session)
    health.missing = [sha256 for sha256 in absent if sha256 in still.all_needed]
    health.missing_caches = [sha256 for sha256 in absent if sha256 in still.all - still.all_needed]
    return health


def named_now(sessions: sessionmaker[Session], queue: JobQueue) -> tuple[References, frozenset[str]]:
    """What rows name, and all that is named, with what unfinished jobs hold.

    Jobs are asked before and after: what one of them publishes meanwhile is in the rows, what one of them takes up
    meanwhile was in the rows or is told by the second time.
    """
    with sessions() as session:
        before = carried_by_jobs(session, queue)
        named = references(session)
        after = carried_by_jobs(session, queue)
    return named, named.all | before | after


def _check(health: BlobHealth, blobs: BlobStore, blob: StoredBlob, needed: frozenset[str]) -> None:
    try:
        blobs.get(blob.sha256)
    except CorruptArtefact:
        (health.damaged if blob.sha256 in needed else health.damaged_caches).append(blob)
        return
    except NotFound:  # discarded meanwhile, or a file of another name in the folder
        return
    health.checked += 1
    health.checked_bytes += blob.size_bytes
