"""ETags: what never changes is kept for ever by its content's hash; pointers are asked for again soon."""

from collections.abc import Callable
from hashlib import sha256
from typing import Annotated

from fastapi import Header, Request, Response
from pydantic import BaseModel

from app.errors import PreconditionFailed

__all__ = [
    "AT_ONCE",
    "IfMatch",
    "check_unchanged",
    "changing",
    "immutable",
    "names_tag",
    "pointer",
    "pointer_to",
    "state",
]

FOR_EVER = "private, max-age=31536000, immutable"
IfMatch = Annotated[
    str | None, Header(alias="If-Match", max_length=200, description="the ETag of what is to be changed; else 412")
]
SHORTLY = "private, max-age=5"
AT_ONCE = "private, no-cache"


def immutable(request: Request, tag: str, make: Callable[[], bytes], media_type: str) -> Response:
    """Content that never changes under its tag; 304 without making it when the caller has it already."""
    return _answer(request, tag, make, media_type, FOR_EVER)


def changing(request: Request, tag: str, make: Callable[[], bytes], media_type: str) -> Response:
    """Content that something points to just now, under the content's own hash: asked for again soon."""
    return _answer(request, tag, make, media_type, SHORTLY)


def pointer(request: Request, view: BaseModel) -> Response:
    """The state of something that changes, under the hash of that state."""
    return pointer_to(request, view.model_dump_json().encode(), "application/json")


def state(request: Request, view: BaseModel) -> Response:
    """The same, where a change is to be seen at once."""
    content = view.model_dump_json().encode()
    return _answer(request, _tag(content), lambda: content, "application/json", AT_ONCE)


def pointer_to(request: Request, content: bytes, media_type: str) -> Response:
    """Content that is at hand, under its hash."""
    return _answer(request, _tag(content), lambda: content, media_type, SHORTLY)


def _answer(request: Request, tag: str, make: Callable[[], bytes], media_type: str, age: str) -> Response:
    headers = {"ETag": f'"{tag}"', "Cache-Control": age}
    if names_tag(request.headers.get("if-none-match", ""), tag):
        return Response(status_code=304, headers=headers)
    return Response(make(), media_type=media_type, headers=headers)


def names_tag(asked: str, tag: str) -> bool:
    """Whether If-None-Match or If-Match names the tag (RFC 9110 13.1: a list, weak marks ignored, or `*`)."""
    wanted = [each.strip().removeprefix("W/") for each in asked.split(",")]
    return f'"{tag}"' in wanted or "*" in wanted


def check_unchanged(request: Request, view: BaseModel) -> None:
    """Raise PreconditionFailed when the caller would change something that is not what it has seen: `If-Match`."""
    asked = request.headers.get("if-match")
    if asked is not None and not names_tag(asked, _tag(view.model_dump_json().encode())):
        raise PreconditionFailed("it was changed since you read it; read it again, then change it")


def _tag(content: bytes) -> str:
    return sha256(content).hexdigest()
