"""`Idempotency-Key` on POSTs that create: the same key and request get the same answer, and create once."""

from collections.abc import Callable
from datetime import UTC, datetime
from hashlib import sha256
from typing import Annotated

from fastapi import Depends, Header, Request
from fastapi.responses import JSONResponse
from pydantic import BaseModel
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.api.context import Context
from app.db.tables import Idempotency
from app.errors import Conflict
from app.services.key_ring import Identity

__all__ = ["IdempotencyKey", "RawBody", "answer_once", "answered_before"]

IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=200,
        pattern=r"^[\x21-\x7e]+$",
        description="repeat a request safely: the same key gives the first answer again",
    ),
]


async def _raw_body(request: Request) -> bytes:
    return await request.body()


RawBody = Annotated[bytes, Depends(_raw_body)]
"""The bytes of a JSON body, for bodies that hold JSON of any shape, which need not be fit to be written again."""

Create = Callable[[Session], tuple[int, BaseModel]]


def answer_once(
    context: Context, identity: Identity, request: Request, key: str | None, body: bytes, create: Create
) -> JSONResponse:
    """Create in one transaction and answer; with a key, remember the answer in the same transaction.

    Raises Conflict when the key was used for a different request.
    """
    key = _within_reach(identity, key)
    fingerprint = _fingerprint(request, body)
    for attempt in (1, 2):
        try:
            with context.transaction() as session:
                if key is not None:
                    earlier = session.get(Idempotency, (identity.organisation_id, key))
                    if earlier is not None:
                        return _again(earlier, fingerprint)
                status, answer = create(session)
                content = answer.model_dump(mode="json")
                if key is not None:
                    session.add(
                        Idempotency(
                            organisation_id=identity.organisation_id,
                            key=key,
                            fingerprint=fingerprint,
                            status_code=status,
                            body=content,
                            created_at=datetime.now(UTC),
                        )
                    )
            return JSONResponse(content, status)
        except IntegrityError:  # somebody else used the key, or created the same object, a moment earlier
            if attempt == 2:
                raise
    raise AssertionError("unreachable")


def answered_before(
    context: Context, identity: Identity, request: Request, key: str | None, body: bytes
) -> JSONResponse | None:
    """The answer that was given to this request already, before anything is worked out for it again.

    Raises Conflict when the key was used for a different request.
    """
    key = _within_reach(identity, key)
    if key is None:
        return None
    with context.transaction() as session:
        earlier = session.get(Idempotency, (identity.organisation_id, key))
        return None if earlier is None else _again(earlier, _fingerprint(request, body))


def _within_reach(identity: Identity, key: str | None) -> str | None:
    """What an answer is kept under. Keys limited to buildings have names of their own: an answer that was given to
    somebody who reaches further is not for them."""
    within = identity.reach.building_ids
    if key is None or within is None:
        return key
    return sha256("\n".join([key, *sorted(within)]).encode()).hexdigest()


def _fingerprint(request: Request, body: bytes) -> str:
    return sha256(f"{request.method} {request.url.path}?{request.url.query}\n".encode() + body).hexdigest()


def _again(earlier: Idempotency, fingerprint: str) -> JSONResponse:
    if earlier.fingerprint != fingerprint:
        raise Conflict("this Idempotency-Key was used for a different request; use a new one")
    return JSONResponse(earlier.body, earlier.status_code, headers={"Idempotent-Replayed": "true"})
