"""Keys and tokens in `Authorization: Bearer ...`, and the scopes an endpoint asks for.

Whoever is not recognised is told the same, whether a key never was, was revoked, or has expired.
"""

import asyncio
import logging
from typing import Annotated

from fastapi import Depends, Request
from fastapi.security import HTTPAuthorizationCredentials, HTTPBearer
from sqlalchemy.exc import SQLAlchemyError
from starlette.requests import HTTPConnection

from app.api.context import Context, context_of
from app.api.problems import Forbidden, Unauthorised
from app.errors import IsodynError, Unavailable
from app.services.audit_log import Actor
from app.services.key_ring import Identity
from app.services.manage_keys import OPERATOR
from app.telemetry.metrics import AUTH_FAILURES

__all__ = [
    "AdminOfAll",
    "AdminOnly",
    "BuildingMaking",
    "Calibrating",
    "CalibrationReading",
    "Identity",
    "Locating",
    "MapWriting",
    "Measuring",
    "Reading",
    "SurveyReading",
    "SurveyWriting",
    "TrackReading",
    "actor",
    "bearer",
    "check_operator",
    "recognised",
    "secret_of",
    "until_refused",
]

_log = logging.getLogger(__name__)
bearer = HTTPBearer(auto_error=False, description="an API key, `isd_...`; `isodyn keys create` makes one")

RECHECK_S = 5.0
"""What a key holds open ends this long, and what the process remembers, after the key does."""


async def recognised(context: Context, secret: str | None, *any_of: str) -> Identity:
    """Whose key this is. Raises Unauthorised, Forbidden where it has none of the scopes that are asked for, and
    Unavailable where only the issuer of a token could tell, or where the database does not soon."""
    if secret is None:
        AUTH_FAILURES.labels("missing").inc()
        raise Unauthorised("send your key as `Authorization: Bearer isd_...`")
    keys = context.keys
    identity = keys.recent(secret) or await context.look_ups.run(lambda: keys.recent(secret) or keys.recognise(secret))
    if identity is None:
        AUTH_FAILURES.labels("unknown").inc()
        raise Unauthorised("this key is not known, was revoked or has expired; `isodyn keys create` makes a new one")
    if any_of and not identity.may(*any_of):
        AUTH_FAILURES.labels("forbidden").inc()
        raise Forbidden(f"this needs a key with scope {' or '.join(any_of)}")
    return identity


async def until_refused(context: Context, secret: str | None, *any_of: str) -> IsodynError:
    """Wait until the key has ended, and return why: what it holds open must end then."""
    while True:
        await asyncio.sleep(RECHECK_S)
        try:
            await recognised(context, secret, *any_of)
        except (Unavailable, SQLAlchemyError):
            continue  # nobody can tell just now
        except IsodynError as error:
            return error


def actor(connection: HTTPConnection, identity: Identity) -> Actor:
    """Who acts, for the log. The address is the client's as the server knows it: a proxy's word for it counts only
    where the proxy is one of `ISODYN_TRUSTED_PROXIES`."""
    client = connection.client
    request_id = getattr(connection.state, "request_id", None)
    return Actor(identity.name, identity.key_id, None if client is None else client.host, request_id)


def secret_of(connection: HTTPConnection) -> str | None:
    """The key or token in the header `Authorization`."""
    scheme, _, secret = connection.headers.get("authorization", "").partition(" ")
    return secret.strip() or None if scheme.lower() == "bearer" else None


class _Needs:
    """A dependency that recognises whoever asks. One that calls the rest: FastAPI spends more on each than the look-up
    of a known key takes.

    any_of      scopes, of which one is needed
    unlimited   why keys limited to buildings may not, where they may not
    """

    def __init__(self, *any_of: str, unlimited: str | None = None) -> None:
        self.any_of, self.unlimited = any_of, unlimited

    async def __call__(
        self, request: Request, credentials: Annotated[HTTPAuthorizationCredentials | None, Depends(bearer)]
    ) -> Identity:
        secret = None if credentials is None else credentials.credentials
        try:
            context = await context_of(request)
            identity = await recognised(context, secret, *self.any_of)
            if self.unlimited is not None and identity.is_limited:
                raise Forbidden(f"this key is limited to buildings, and {self.unlimited}; use one that is not")
        except (Unauthorised, Forbidden) as error:
            where = None if request.client is None else request.client.host
            _log.info("refused %s %r from %s: %s", request.method, request.url.path, where, error)
            raise
        request.state.identity = identity
        context.key_limits.begin(identity.key_id, request.scope)
        return identity


def check_operator(identity: Identity) -> None:
    """Raise Forbidden but for a key of the organisation of whoever runs the installation, for what tells of all."""
    if identity.is_limited or identity.organisation != OPERATOR:
        raise Forbidden(f"this tells of all organisations: it needs a key for the whole organisation {OPERATOR}")


_OF_ALL = "calibrations belong to the whole organisation"
AdminOnly = Annotated[Identity, Depends(_Needs("admin"))]
AdminOfAll = Annotated[Identity, Depends(_Needs("admin", unlimited="the log tells of the whole organisation"))]
Reading = Annotated[Identity, Depends(_Needs("map:read", "map:write"))]
BuildingMaking = Annotated[Identity, Depends(_Needs("map:write", unlimited="a new building is not among them"))]
MapWriting = Annotated[Identity, Depends(_Needs("map:write"))]
SurveyReading = Annotated[Identity, Depends(_Needs("survey:write", "map:read", "map:write"))]
SurveyWriting = Annotated[Identity, Depends(_Needs("survey:write"))]
Locating = Annotated[Identity, Depends(_Needs("locate"))]
TrackReading = Annotated[Identity, Depends(_Needs("locate", "track:read"))]
Calibrating = Annotated[Identity, Depends(_Needs("survey:write", "locate", unlimited=_OF_ALL))]
CalibrationReading = Annotated[
    Identity, Depends(_Needs("survey:write", "map:read", "map:write", "locate", unlimited=_OF_ALL))
]
Measuring = Annotated[Identity, Depends(_Needs("survey:write", "map:read", "map:write", "locate"))]
