"""HEAD where there is GET, and an ETag on every JSON document under `/v1`: whoever has it already is answered 304.

Endpoints that know a tag without making the document (`app.api.caching`) give their own.
"""

from hashlib import sha256

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.api.caching import AT_ONCE, names_tag

__all__ = ["EntityTags"]


class EntityTags:
    """Streams pass as they are, and have no HEAD."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http" or scope["method"] not in ("GET", "HEAD") or not scope["path"].startswith("/v1/"):
            await self.app(scope, receive, send)
            return
        if scope["method"] == "GET":
            await self.app(scope, receive, _Tagging(scope, send))
            return
        if scope["path"].endswith("/events"):
            await self.app(scope, receive, send)
            return
        inner: Scope = {**scope, "method": "GET"}

        async def without_body(message: Message) -> None:
            await send({**message, "body": b""} if message["type"] == "http.response.body" else message)

        try:
            await self.app(inner, receive, _Tagging(scope, without_body))
        finally:
            scope.update({name: inner[name] for name in ("route", "isodyn.key") if name in inner})


class _Tagging:
    """Sends one answer on: a document that comes whole gets its tag, or becomes a 304."""

    def __init__(self, scope: Scope, send: Send) -> None:
        self._asked, self._send = Headers(scope=scope).get("if-none-match", ""), send
        self._start: Message | None = None

    async def __call__(self, message: Message) -> None:
        if message["type"] == "http.response.start" and _is_document(message):
            self._start = message  # until its body is known
            return
        if self._start is not None:
            start, self._start = self._start, None
            if not message.get("more_body", False):
                start, message = self._tagged(start, message)
            await self._send(start)
        await self._send(message)

    def _tagged(self, start: Message, message: Message) -> tuple[Message, Message]:
        tag = sha256(message.get("body", b"")).hexdigest()
        headers = MutableHeaders(raw=list(start["headers"]))
        headers["ETag"] = f'"{tag}"'
        headers.setdefault("Cache-Control", AT_ONCE)
        if not names_tag(self._asked, tag):
            return {**start, "headers": headers.raw}, message
        del headers["content-length"], headers["content-type"]
        return {**start, "status": 304, "headers": headers.raw}, {**message, "body": b""}


def _is_document(start: Message) -> bool:
    headers = Headers(raw=start["headers"])
    return start["status"] == 200 and "etag" not in headers and headers.get("content-type", "") == "application/json"
