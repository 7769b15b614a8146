"""ETags: what never changes is kept for ever by its content's hash; pointers are asked for again soon."""

from collections.abc import Callable
from hashlib import sha256

from fastapi import Request, Response
from pydantic import BaseModel

__all__ = ["changing", "immutable", "pointer"]

FOR_EVER = "private, max-age=31536000, immutable"
SHORTLY = "private, max-age=5"


def immutable(request: Request, tag: str, make: Callable[[], bytes], media_type: str) -> Response:
    """Content that never changes under its tag; 304 without making it when the caller has it already."""
    return _answer(request, tag, make, media_type, FOR_EVER)


def changing(request: Request, tag: str, make: Callable[[], bytes], media_type: str) -> Response:
    """Content that something points to just now, under the content's own hash: asked for again soon."""
    return _answer(request, tag, make, media_type, SHORTLY)


def pointer(request: Request, view: BaseModel) -> Response:
    """The state of something that changes, under the hash of that state."""
    content = view.model_dump_json().encode()
    return _answer(request, sha256(content).hexdigest(), lambda: content, "application/json", SHORTLY)


def _answer(request: Request, tag: str, make: Callable[[], bytes], media_type: str, age: str) -> Response:
    headers = {"ETag": f'"{tag}"', "Cache-Control": age}
    if _has(request, tag):
        return Response(status_code=304, headers=headers)
    return Response(make(), media_type=media_type, headers=headers)


def _has(request: Request, tag: str) -> bool:
    """Whether If-None-Match names the tag (RFC 9110 13.1.2: a list, weak marks ignored, or `*`)."""
    wanted = [each.strip().removeprefix("W/") for each in request.headers.get("if-none-match", "").split(",")]
    return f'"{tag}"' in wanted or "*" in wanted
