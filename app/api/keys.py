"""API keys of one's own organisation: made, listed, rotated, revoked. A key is shown once, in the answer that makes it.

These POSTs take no Idempotency-Key: to answer again, the key itself would have to be kept.
"""

from datetime import datetime, timedelta
from typing import Annotated, Literal

from fastapi import APIRouter, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from app.api.auth import AdminOnly, Identity, actor
from app.api.context import ContextDep
from app.api.listing import Page, PagingDep, list_page
from app.api.models import Finite, Id, Name, RequestModel, Time
from app.api.ownership import find_own_key, own_keys
from app.api.problems import ERROR_RESPONSES, Forbidden
from app.db.tables import Key, Organisation
from app.services.manage_keys import MadeKey, make_key, revoke_key, rotate_key

__all__ = ["router"]

router = APIRouter(prefix="/v1/keys", tags=["keys"], responses=ERROR_RESPONSES)
Scope = Literal["admin", "survey:write", "map:read", "map:write", "locate", "track:read"]
BuildingId = Annotated[str, Field(max_length=64, pattern=r"^[A-Za-z0-9_-]+$")]


class NewKey(RequestModel):
    model_config = ConfigDict(
        extra="forbid",
        json_schema_extra={
            "examples": [{"name": "robot-7", "scopes": ["locate"], "expires_at": "2030-01-01T00:00:00Z"}]
        },
    )
    name: Annotated[Name, Field(description="what it is for")]
    scopes: Annotated[list[Scope], Field(min_length=1, max_length=20)]
    building_ids: Annotated[
        list[BuildingId] | None,
        Field(min_length=1, max_length=1000, description="all that it sees and touches; default: the organisation's"),
    ] = None
    expires_at: Annotated[Time | None, Field(description="when it ends; default: never")] = None


class Rotation(RequestModel):
    model_config = ConfigDict(extra="forbid", json_schema_extra={"examples": [{"overlap_s": 3600}]})
    overlap_s: Annotated[
        Finite, Field(ge=0, le=90 * 86_400, description="how long the old key goes on to work")
    ] = 86_400.0  # fmt: skip


class KeyView(BaseModel):
    id: str
    name: str
    scopes: Annotated[list[str], Field(description="of a subject: none, those of each token count")]
    building_ids: Annotated[list[str] | None, Field(description="null: all of the organisation's")]
    issuer: Annotated[str | None, Field(description="of an identity provider's subject; null for a key")]
    subject: str | None
    created_at: datetime
    expires_at: datetime | None
    last_used_at: Annotated[datetime | None, Field(description="to a minute or two")]
    revoked_at: datetime | None


class MadeKeyView(KeyView):
    secret: Annotated[str, Field(description="the key itself: it is not kept, and never shown again")]


def show_key(row: Key) -> KeyView:
    return KeyView.model_validate(row, from_attributes=True)


def _show_made(made: MadeKey) -> MadeKeyView:
    return MadeKeyView(**dict(show_key(made.row)), secret=made.secret)


@router.get("", summary="List keys")
def list_keys(context: ContextDep, identity: AdminOnly, paging: PagingDep) -> Page[KeyView]:
    """Also those that have ended, and the subjects of an identity provider. A key limited to buildings sees those that
    reach no further."""
    with context.transaction() as session:
        return list_page(session, own_keys(session, identity), Key.id, paging, show_key)


@router.post("", status_code=201, summary="Make a key")
def create_key(body: NewKey, request: Request, context: ContextDep, identity: AdminOnly) -> MadeKeyView:
    """The answer holds the key itself, this once. An admin key that is limited to buildings makes keys that are limited
    to some of them."""
    _check_no_wider(identity, body)
    with context.transaction() as session:
        owner = session.get_one(Organisation, identity.organisation_id)
        made = make_key(
            session, owner, actor(request, identity), name=body.name, scopes=set(body.scopes),
            building_ids=None if body.building_ids is None else set(body.building_ids), expires_at=body.expires_at,
        )  # fmt: skip
        context.quotas.check_keys(session, identity.organisation_id)
        return _show_made(made)


def _check_no_wider(identity: Identity, body: NewKey) -> None:
    """Raise Forbidden for a key that would reach further than the one that makes it."""
    within = identity.reach.building_ids
    if within is not None and (body.building_ids is None or not within.issuperset(body.building_ids)):
        raise Forbidden("this key is limited to buildings: name some of them in building_ids, and no others")


@router.post("/{key_id}:rotate", status_code=201, summary="Replace a key by a new one")
def rotate(
    key_id: Id, request: Request, context: ContextDep, identity: AdminOnly, body: Rotation | None = None
) -> MadeKeyView:
    """The new key has the same name, scopes, buildings and span of life; the answer holds it, this once. The old one
    ends after the overlap, or when it would have ended anyway."""
    with context.transaction() as session:
        row = find_own_key(session, identity, key_id)
        overlap = timedelta(seconds=(body or Rotation()).overlap_s)
        made = rotate_key(session, row, actor(request, identity), overlap)
        context.quotas.check_keys(session, identity.organisation_id)
        return _show_made(made)


@router.delete("/{key_id}", status_code=204, summary="Revoke a key")
def revoke(key_id: Id, request: Request, context: ContextDep, identity: AdminOnly) -> Response:
    """It is useless within seconds, in every process, and what it holds open ends. Once more changes nothing. A subject
    of an identity provider is locked out, whatever tokens it is given."""
    with context.transaction() as session:
        row = find_own_key(session, identity, key_id)
        revoke_key(session, row.id, actor(request, identity))
    return Response(status_code=204)
