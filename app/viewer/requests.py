"""What a browser's requests carry: where they come from, small forms, small JSON, and the policy of our answers."""

import json
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from math import ceil
from typing import TypeVar
from urllib.parse import parse_qs, urlsplit

from pydantic import BaseModel, ValidationError
from starlette.requests import Request
from starlette.responses import JSONResponse, Response

from app.errors import Conflict, Fault, InvalidInput, IsodynError, NotFound, TooLarge, Unavailable

__all__ = ["SECURITY_HEADERS", "foreign_fetch", "problem", "read_form", "read_json", "refusal", "same_origin"]

SECURITY_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "SAMEORIGIN",
    "Referrer-Policy": "same-origin",  # "no-referrer" would make forms send the Origin "null"
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
}

Model = TypeVar("Model", bound=BaseModel)


def same_origin(headers: Mapping[str, str]) -> bool:
    """Whether the page that asks is this server's: its Origin names the host that was asked. None given is a no."""
    origin, host = headers.get("origin", ""), headers.get("host", "")
    parts = urlsplit(origin)
    return parts.scheme in ("http", "https") and host != "" and parts.netloc.lower() == host.lower()


def foreign_fetch(headers: Mapping[str, str]) -> bool:
    """Whether the browser says that another site's page asks (Sec-Fetch-Site, or an Origin that is not ours)."""
    site = headers.get("sec-fetch-site", "same-origin")
    return site not in ("same-origin", "none") or ("origin" in headers and not same_origin(headers))


async def read_form(request: Request, most_bytes: int) -> dict[str, str]:
    """The fields of a small form. Raises TooLarge."""
    body = await _read(request, most_bytes)
    return {name: values[0] for name, values in parse_qs(body.decode("utf-8", "replace")).items()}


async def read_json(request: Request, model: type[Model], most_bytes: int) -> Model:
    """A small JSON body. Raises TooLarge, InvalidInput with where and why."""
    body = await _read(request, most_bytes)
    try:
        return model.model_validate(json.loads(body))
    except (ValueError, RecursionError) as error:
        if not isinstance(error, ValidationError):
            raise InvalidInput("the body is not JSON", Fault("/body", str(error)[:200])) from error
        faults = [Fault("/body/" + "/".join(map(str, e["loc"])), e["msg"]) for e in error.errors()[:20]]
        raise InvalidInput(faults[0].reason, *faults) from error


async def _read(request: Request, most_bytes: int) -> bytes:
    body = bytearray()
    async for chunk in request.stream():
        body += chunk
        if len(body) > most_bytes:
            raise TooLarge(f"the body is larger than {most_bytes:,} bytes")
    return bytes(body)


def refusal(status: HTTPStatus, reason: str, faults: Sequence[Fault] = ()) -> Response:
    """Why not, as the API says it: a problem document."""
    errors = [{"location": fault.location, "reason": fault.reason} for fault in faults]
    content = {"title": status.phrase, "status": int(status), "detail": reason, "errors": errors}
    return JSONResponse(content, status, SECURITY_HEADERS, media_type="application/problem+json")


_STATUS: dict[type[IsodynError], HTTPStatus] = {
    NotFound: HTTPStatus.NOT_FOUND,
    Conflict: HTTPStatus.CONFLICT,
    TooLarge: HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
    Unavailable: HTTPStatus.SERVICE_UNAVAILABLE,
    InvalidInput: HTTPStatus.UNPROCESSABLE_ENTITY,
}


def problem(error: IsodynError) -> Response:
    """An error of ours as a refusal."""
    known = (status for kind, status in _STATUS.items() if isinstance(error, kind))
    answer = refusal(next(known, HTTPStatus.INTERNAL_SERVER_ERROR), str(error), error.faults)
    if isinstance(error, Unavailable):
        answer.headers["Retry-After"] = str(ceil(error.retry_after_s))
    return answer
