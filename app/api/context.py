"""What every endpoint may use, made once by `app.main` and found on the application's state."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from fastapi import Depends, Request
from sqlalchemy import Engine
from sqlalchemy.orm import Session, sessionmaker

from app.api.admission import BodyMemory
from app.api.key_limits import KeyLimits
from app.blobs import BlobStore
from app.jobs.queue import JobQueue
from app.services.file_readers import FileReaders
from app.services.follow import Follower
from app.services.grid_cache import GridCache
from app.services.key_ring import KeyRing
from app.services.quotas import Quotas
from app.services.step_rate import StepRate
from app.services.turns import Turns
from app.settings import Settings

if TYPE_CHECKING:
    from app.api.bearer_tokens import BearerTokens

__all__ = ["Context", "ContextDep", "context_of"]


@dataclass(frozen=True, slots=True)
class Context:
    """The open handles of a web process.

    `searches` runs the searches for positions: few at once, the others wait in order of arrival. `follows` is
    the same for tracks, `uploads` for files that are received, `look_ups` for keys, which wait for no slow request.
    `bodies` is the memory for files that are sent.
    """

    settings: Settings
    engine: Engine
    sessions: sessionmaker[Session]
    blobs: BlobStore
    queue: JobQueue
    files: FileReaders
    grids: GridCache
    keys: KeyRing
    look_ups: Turns
    tokens: "BearerTokens | None"
    key_limits: KeyLimits
    quotas: Quotas
    bodies: BodyMemory
    searches: Turns
    follows: Turns
    uploads: Turns
    follower: Follower
    step_rate: StepRate

    @contextmanager
    def transaction(self) -> Iterator[Session]:
        """One transaction: committed before the answer is made, rolled back on any error."""
        with self.sessions.begin() as session:
            yield session


async def context_of(request: Request) -> Context:
    """The context of the application that serves this request. Async, so that it costs no change of threads."""
    context: Context = request.app.state.context
    return context


ContextDep = Annotated[Context, Depends(context_of)]
