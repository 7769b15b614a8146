"""Keys in `Authorization: Bearer isd_...`, and the scopes an endpoint asks for."""

from collections.abc import Awaitable, Callable
from typing import Annotated

from fastapi import Depends, Request
from fastapi.concurrency import run_in_threadpool
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer

from app.api.context import Context, context_of
from app.api.problems import Forbidden, Unauthorised
from app.services.manage_keys import Identity

__all__ = [
    "AdminOnly",
    "Calibrating",
    "Identity",
    "Locating",
    "Measuring",
    "Reading",
    "SurveyReading",
    "SurveyWriting",
    "MapWriting",
    "recognised",
]

_bearer = HTTPBearer(auto_error=False, description="an API key, `isd_...`; `isodyn keys create` makes one")


async def recognised(context: Context, secret: str | None, *any_of: str) -> Identity:
    """Whose key this is. Raises Unauthorised, and Forbidden where it has none of the scopes that are asked for."""
    if secret is None:
        raise Unauthorised("send your key as `Authorization: Bearer isd_...`")
    identity = context.keys.recent(secret) or await run_in_threadpool(context.keys.recognise, secret)
    if identity is None:
        raise Unauthorised("this key is not known or was revoked; `isodyn keys create` makes a new one")
    if any_of and not identity.may(*any_of):
        raise Forbidden(f"this needs a key with scope {' or '.join(any_of)}")
    return identity


def _needs(*any_of: str) -> Callable[..., Awaitable[Identity]]:
    # One dependency that calls the rest: FastAPI spends more on each than the look-up of a known key takes.
    async def check(
        request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(_bearer)]
    ) -> Identity:
        secret = None if credentials is None else credentials.credentials
        context = await context_of(request)
        identity = await recognised(context, secret, *any_of)
        context.key_limits.begin(identity.key_id, request.scope)
        return identity

    return check


AdminOnly = Annotated[Identity, Depends(_needs("admin"))]
Reading = Annotated[Identity, Depends(_needs("map:read", "map:write"))]
MapWriting = Annotated[Identity, Depends(_needs("map:write"))]
SurveyReading = Annotated[Identity, Depends(_needs("survey:write", "map:read", "map:write"))]
SurveyWriting = Annotated[Identity, Depends(_needs("survey:write"))]
Locating = Annotated[Identity, Depends(_needs("locate"))]
Calibrating = Annotated[Identity, Depends(_needs("survey:write", "locate"))]
Measuring = Annotated[Identity, Depends(_needs("survey:write", "map:read", "map:write", "locate"))]
