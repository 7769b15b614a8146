"""What a worker calls to do the work it knows nothing about: `app.services.build_map`, or another module by name."""

from collections.abc import Callable
from importlib import import_module
from typing import TYPE_CHECKING, Any, Protocol, cast

from sqlalchemy.orm import Session

from app.blobs import BlobStore

if TYPE_CHECKING:  # mathematics that only children need
    from app.services.shared_tiles import Board

__all__ = ["DEFAULT_BUILDER", "Builder", "Plan", "Result", "load_builder"]

DEFAULT_BUILDER = "app.services.build_map"

Plan = dict[str, Any]
Result = dict[str, Any]


class Builder(Protocol):
    """Each may run twice, because a worker may die after the work and before the note of it. Plans and results are
    JSON and small: hashes and scores; arrays go to the blob store."""

    def claim_build(self, session: Session, job_id: str) -> Plan:
        """Mark the job running and fix what it builds."""
        ...

    def fit_build(
        self, plan: Plan, blobs: BlobStore, progress: Callable[[float, str], None], board: "Board | None"
    ) -> Result:
        """Compute, in a process of its own. `progress(fraction, message)` raises JobCancelled.

        Large work may be offered to other workers on the `board`, where there are any.
        """
        ...

    def fit_chunk(
        self, order_sha256: str, number: int, blobs: BlobStore, progress: Callable[[float, str], None]
    ) -> Result:
        """Compute what another worker offered, in a process of its own. The result's `fits_sha256` is brought to it."""
        ...

    def publish_build(self, session: Session, job_id: str, plan: Plan, result: Result) -> None:
        """Publish the result unless a newer one is there, and mark the job successful."""
        ...

    def fail_build(self, session: Session, job_id: str, message: str) -> None:
        """Mark the job failed, if it has not ended."""
        ...

    def dismiss_build(self, session: Session, job_id: str) -> None:
        """Mark the job dismissed, if it has not ended."""
        ...


def load_builder(module: str) -> Builder:
    """The module as a Builder. Raises ImportError."""
    return cast(Builder, import_module(module))
