"""The audit log: who did what, when, and from where."""

from datetime import datetime
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query
from pydantic import BaseModel, Field

from app.api.auth import AdminOfAll
from app.api.context import ContextDep
from app.api.listing import Page, PagingDep, list_page
from app.api.models import Time
from app.api.problems import ERROR_RESPONSES
from app.db.tables import Audit
from app.services.audit_log import select_rows

__all__ = ["AuditView", "router"]

router = APIRouter(prefix="/v1/audit", tags=["keys"], responses=ERROR_RESPONSES)
AnId = Annotated[str | None, Query(max_length=64, pattern=r"^[A-Za-z0-9_-]+$")]


class AuditView(BaseModel):
    """One change."""

    id: str
    at: datetime
    actor: Annotated[str, Field(description="the key's name, an identity provider's subject, or `command line`")]
    key_id: Annotated[str | None, Field(description="null for the command line")]
    action: Annotated[str, Field(examples=["survey.upload"])]
    object_id: str
    outcome: Annotated[Literal["done", "accepted"], Field(description="accepted: a job does the rest")]
    address: Annotated[str | None, Field(description="where the request came from")]
    request_id: str | None
    details: Annotated[dict[str, Any], Field(description="ids, names of fields and short words")]


def show_audit(row: Audit) -> AuditView:
    return AuditView.model_validate(row, from_attributes=True)


@router.get("", summary="Who did what")
def list_audit(
    context: ContextDep,
    identity: AdminOfAll,
    paging: PagingDep,
    object: Annotated[AnId, Query(description="changes of the object with this id")] = None,
    actor: Annotated[AnId, Query(description="changes by the key with this id")] = None,
    action: Annotated[
        str | None, Query(max_length=60, pattern=r"^[a-z_.]+$", examples=["survey.upload"], description="one kind only")
    ] = None,
    since: Annotated[Time | None, Query(description="from this time on")] = None,
) -> Page[AuditView]:
    """The organisation's own changes, as they were made. Refused attempts are in the server's log and metrics."""
    statement = select_rows(identity.organisation_id, object_id=object, key_id=actor, action=action, since=since)
    with context.transaction() as session:
        return list_page(session, statement, Audit.id, paging, show_audit)
