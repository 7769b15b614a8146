"""RFC 9457: every refusal is `application/problem+json` with a stable `type`, a sentence, and `errors[]` saying where.

| type (under https://isodyn.dev/problems/) | status | when                                                        |
|---|---|---|
| unreadable-survey, invalid-window, incompatible-frames, invalid-input | 422 | what was sent cannot be used  |
| unauthorised | 401 | no key, or one that is not known                                                          |
| forbidden    | 403 | the key lacks the scope                                                                   |
| not-found    | 404 | no such object for this key                                                               |
| conflict     | 409 | the object's present state forbids it                                                     |
| quota        | 409 | the organisation has as many of these as it may: delete some, or have the limit raised    |
| changed      | 412 | it is not what `If-Match` names: somebody else changed it                                 |
| too-slow     | 408 | the body came too slowly                                                                  |
| too-large    | 413 | more bytes than the limit                                                                 |
| too-many     | 429 | more requests, tracks, or steps a second, than the limit; Retry-After says when            |
| overloaded   | 503 | more work than can be done soon; nothing was done, Retry-After says when to try again     |
| unavailable  | 503 | the database or the blob store cannot be reached; Retry-After says when to try again      |
"""

import logging
from collections.abc import Sequence
from math import ceil
from typing import Any

from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field
from sqlalchemy.exc import DBAPIError, OperationalError
from sqlalchemy.exc import TimeoutError as PoolTimeout
from starlette.exceptions import HTTPException

from app.api.access_log import REQUEST_ID_HEADER
from app.errors import (
    Conflict,
    CorruptArtefact,
    Fault,
    IncompatibleFrames,
    InvalidInput,
    InvalidWindow,
    IsodynError,
    NotFound,
    Overloaded,
    PreconditionFailed,
    QuotaExceeded,
    TooLarge,
    TooMany,
    TooSlow,
    Unavailable,
    UnreadableSurvey,
)
from app.telemetry.facts import request_id
from app.telemetry.metrics import PROBLEMS

__all__ = [
    "ERROR_RESPONSES",
    "Forbidden",
    "Problem",
    "Unauthorised",
    "add_problem_handlers",
    "isodyn_problem",
    "problem_response",
    "validation_problem",
]

_log = logging.getLogger(__name__)
TYPE_BASE = "https://isodyn.dev/problems/"
UNION_TAGS = frozenset({"vectors", "magnitudes"})  # of a window's b_ut: no part of a JSON pointer


class Unauthorised(IsodynError):
    """No key, or one that is not known."""


class Forbidden(IsodynError):
    """The key lacks the scope."""


# The nearest ancestor decides.
_KINDS: dict[type[IsodynError], tuple[int, str, str]] = {
    UnreadableSurvey: (422, "unreadable-survey", "The survey cannot be read"),
    InvalidWindow: (422, "invalid-window", "The window cannot be matched"),
    IncompatibleFrames: (422, "incompatible-frames", "The map cannot answer this frame"),
    InvalidInput: (422, "invalid-input", "The request cannot be used"),
    Unauthorised: (401, "unauthorised", "A key is needed"),
    Forbidden: (403, "forbidden", "The key lacks the scope"),
    NotFound: (404, "not-found", "Not found"),
    QuotaExceeded: (409, "quota", "The limit is reached"),
    Conflict: (409, "conflict", "The object's state forbids it"),
    TooLarge: (413, "too-large", "Too large"),
    TooMany: (429, "too-many", "Too many"),
    PreconditionFailed: (412, "changed", "It was changed meanwhile"),
    TooSlow: (408, "too-slow", "The body came too slowly"),
    Overloaded: (503, "overloaded", "Busy"),
    Unavailable: (503, "unavailable", "Unavailable"),
    CorruptArtefact: (500, "corrupt-artefact", "Stored data is damaged"),
    IsodynError: (500, "internal", "Something went wrong here"),
}


class ProblemError(BaseModel):
    location: str = Field(description="a JSON pointer, a parameter's name, or a line and column", examples=["line 7"])
    reason: str


class Problem(BaseModel):
    """RFC 9457 problem details."""

    type: str = Field(examples=[TYPE_BASE + "not-found"])
    title: str
    status: int
    detail: str
    errors: list[ProblemError] = Field(default_factory=list)
    request_id: str | None = Field(
        default=None, description="also in the header X-Request-ID, and in the server's log", examples=["5f0e8d6b4c21"]
    )


def _documented(description: str) -> dict[str, Any]:
    schema = {"$ref": "#/components/schemas/Problem"}
    return {"description": description, "content": {"application/problem+json": {"schema": schema}}}


ERROR_RESPONSES: dict[int | str, dict[str, Any]] = {
    400: _documented("The request is not well-formed HTTP or JSON"),
    401: _documented("No key, or one that is not known"),
    403: _documented("The key lacks the scope"),
    404: _documented("No such object for this key"),
    408: _documented("The body came too slowly"),
    409: _documented("The object's present state forbids it, or the organisation has as many of these as it may"),
    413: _documented("More bytes than the limit"),
    422: _documented("What was sent cannot be used; `errors` says where and why"),
    412: _documented("It is not what `If-Match` names"),
    429: _documented("More than this key may for now; see Retry-After"),
    503: _documented("Busy, or the database or the blob store cannot be reached; try again after Retry-After"),
}


def problem_response(
    status: int, kind: str, title: str, detail: str, faults: Sequence[Fault] = (), headers: dict[str, str] | None = None
) -> JSONResponse:
    """One problem document."""
    PROBLEMS.labels(kind).inc()
    problem = Problem(
        type=TYPE_BASE + kind,
        title=title,
        status=status,
        detail=detail,
        errors=[ProblemError(location=fault.location, reason=fault.reason) for fault in faults],
        request_id=request_id(),
    )
    return JSONResponse(problem.model_dump(), status, headers=headers, media_type="application/problem+json")


def add_problem_handlers(app: FastAPI) -> None:
    """Turn every error of the tree, of validation, of routing and of the database into a problem document."""
    app.add_exception_handler(IsodynError, _isodyn_error)
    app.add_exception_handler(RequestValidationError, _validation_error)
    app.add_exception_handler(HTTPException, _http_exception)
    app.add_exception_handler(OperationalError, _database_unavailable)
    app.add_exception_handler(PoolTimeout, _connections_taken)
    app.add_exception_handler(DBAPIError, _database_refused)
    app.add_exception_handler(Exception, _unexpected)


def isodyn_problem(error: IsodynError) -> JSONResponse:
    """The problem document of an error of the tree."""
    status, kind, title = next(_KINDS[cls] for cls in type(error).__mro__ if cls in _KINDS)
    headers = {"WWW-Authenticate": "Bearer"} if status == 401 else None
    if isinstance(error, (TooMany, Unavailable)) and error.retry_after_s is not None:
        headers = {"Retry-After": str(max(ceil(error.retry_after_s), 1))}
    return problem_response(status, kind, title, str(error), error.faults, headers)


async def _isodyn_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, IsodynError)
    answer = isodyn_problem(error)
    if isinstance(error, Overloaded):
        return answer  # there may be many, when there is least time to write of them
    if isinstance(error, Unavailable):
        _log.warning("%s %s: %s: %s", request.method, request.url.path, error, error.__cause__)
    elif answer.status_code >= 500:
        _tell_the_log(request, error)
    return answer


def _tell_the_log(request: Request, error: Exception) -> None:
    """A fault of ours that is answered: the server, which logs what nobody handles, never hears of it."""
    _log.error("%s %s failed", request.method, request.url.path, exc_info=error)


async def _validation_error(request: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, RequestValidationError)
    not_json = "json" not in request.headers.get("content-type", "application/json")
    return validation_problem(error.errors(), not_json)


def validation_problem(errors: Sequence[Any], not_json: bool = False) -> JSONResponse:
    """The problem document of what pydantic found in a request, or in a message."""
    faults = [_fault(each["loc"], each["msg"], not_json) for each in errors]
    detail = f"{faults[0].location}: {faults[0].reason}" if faults else "the request does not fit its description"
    return problem_response(422, "invalid-input", "The request cannot be used", detail, faults[:50])


def _fault(location: Sequence[str | int], reason: str, not_json: bool) -> Fault:
    if not_json and tuple(location) == ("body",):
        reason = "send the body as JSON, with the header Content-Type: application/json"
    return Fault("/" + "/".join(str(part) for part in location if part not in UNION_TAGS), reason)


async def _http_exception(_: Request, error: Exception) -> JSONResponse:
    assert isinstance(error, HTTPException)
    title = {404: "Not found", 405: "Method not allowed"}.get(error.status_code, "The request cannot be served")
    kind = {404: "not-found", 405: "method-not-allowed"}.get(error.status_code, "bad-request")
    return problem_response(
        error.status_code, kind, title, str(error.detail), headers=dict(error.headers) if error.headers else None
    )


async def _database_unavailable(request: Request, error: Exception) -> JSONResponse:
    _log.warning("%s %s: the database cannot be reached: %s", request.method, request.url.path, error)
    detail = "the database cannot be reached now; nothing was stored, try again"
    return problem_response(503, "unavailable", "Unavailable", detail, headers={"Retry-After": "5"})


async def _connections_taken(_: Request, __: Exception) -> JSONResponse:
    return isodyn_problem(Overloaded("every connection to the database is taken; try again", retry_after_s=2.0))


async def _database_refused(request: Request, error: Exception) -> JSONResponse:
    _tell_the_log(request, error)
    return problem_response(500, "internal", "Something went wrong here", "the database refused the statement")


async def _unexpected(request: Request, error: Exception) -> JSONResponse:
    """A fault of ours: it is raised on after the answer, and the server logs it with its traceback."""
    detail = f"an unexpected {type(error).__name__}; the server's log says more, please report it"
    headers = {REQUEST_ID_HEADER: request.state.request_id}  # this answer passes no middleware
    return problem_response(500, "internal", "Something went wrong here", detail, headers=headers)
