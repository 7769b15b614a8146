"""Every request gets an id, a span, its place in the metrics, and one line in the log.

The id is the client's own `X-Request-ID` where that is sane, else made; it is answered in the same header, in every
problem document, and is `scope["state"]["request_id"]`. The line has the route's template and the ids of key and
organisation; never a query, a header, a body or an address, because those may hold secrets or say where somebody was.
"""

import logging
import re
from time import perf_counter
from typing import Any
from uuid import uuid4

from opentelemetry import propagate, trace
from starlette.datastructures import Headers, MutableHeaders
from starlette.routing import Mount
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.telemetry.facts import add_facts
from app.telemetry.metrics import HTTP_REQUESTS, HTTP_SECONDS

__all__ = ["REQUEST_ID_HEADER", "AccessLog"]

REQUEST_ID_HEADER = "X-Request-ID"
_SANE = re.compile(r"[A-Za-z0-9._-]{1,64}")
_METHODS = frozenset({"GET", "POST", "PATCH", "DELETE", "PUT", "HEAD", "OPTIONS"})
_PROBES = frozenset({"/healthz", "/readyz", "/metrics"})

_log = logging.getLogger(__name__)
_tracer = trace.get_tracer("isodyn")


class AccessLog:
    """The outermost middleware: what it sees is what the client sees."""

    def __init__(self, app: ASGIApp) -> None:
        self.app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] not in ("http", "websocket"):
            await self.app(scope, receive, send)
            return
        state = scope.setdefault("state", {})
        if "request_id" in state:  # the page asks the API, within a request that is watched already
            try:
                await self.app(scope, receive, send)
            finally:
                state["route"] = "/view" + _template(scope)
            return
        headers = Headers(scope=scope)
        state["request_id"] = _request_id(headers.get(REQUEST_ID_HEADER))
        add_facts(request_id=state["request_id"])  # of this request's own task: nobody need take it back
        seen = _Seen(scope, receive, send)
        method = scope.get("method", "WEBSOCKET")
        with _tracer.start_as_current_span(
            method, context=propagate.extract(headers), kind=trace.SpanKind.SERVER, record_exception=False
        ) as span:
            try:
                await self.app(scope, seen.receive, seen.send)
            finally:
                route = state.get("route") or _template(scope)
                span.update_name(f"{method} {route}")
                span.set_attributes({"http.route": route, "http.response.status_code": seen.status})
                if seen.status >= 500:
                    span.set_status(trace.StatusCode.ERROR)
                _tell(scope, method if method in _METHODS else "other", route, seen)


class _Seen:
    """What passes between client and application: the status, bytes both ways; and the id goes out."""

    def __init__(self, scope: Scope, receive: Receive, send: Send) -> None:
        self._scope, self._receive, self._send = scope, receive, send
        self._start = perf_counter()
        self.status = 500 if scope["type"] == "http" else 403
        self.bytes_in = self.bytes_out = 0

    @property
    def seconds(self) -> float:
        return perf_counter() - self._start

    async def receive(self) -> Message:
        message = await self._receive()
        self.bytes_in += _size(message)
        return message

    async def send(self, message: Message) -> None:
        kind = message["type"]
        if kind in ("http.response.start", "websocket.http.response.start", "websocket.accept"):
            self.status = message.get("status", 101)
            MutableHeaders(scope=message)[REQUEST_ID_HEADER] = self._scope["state"]["request_id"]
        self.bytes_out += _size(message)
        await self._send(message)


def _request_id(told: str | None) -> str:
    return told if told is not None and _SANE.fullmatch(told) else uuid4().hex


def _template(scope: Scope) -> str:
    """Where the request went, without its ids: they would be labels without end."""
    route = scope.get("route")
    if route is None:
        return "unmatched"
    prefix = str(scope.get("root_path", ""))  # of what is mounted
    return prefix if isinstance(route, Mount) else prefix + str(route.path)


def _size(message: Message) -> int:
    return len(message.get("body") or message.get("bytes") or message.get("text") or b"")


def _tell(scope: Scope, method: str, route: str, seen: _Seen) -> None:
    if scope["type"] == "http":
        HTTP_REQUESTS.labels(method, route, seen.status).inc()
        HTTP_SECONDS.labels(method, route).observe(seen.seconds)
    else:
        method = "WEBSOCKET"
    level = logging.DEBUG if route in _PROBES else logging.INFO
    if seen.status >= 500:
        level = logging.WARNING if seen.status == 503 else logging.ERROR
    identity: Any = scope["state"].get("identity")
    _log.log(
        level, "%s %s %d %.1f ms", method, route, seen.status, 1e3 * seen.seconds,
        extra={
            "in_message": {"method", "route", "status", "duration_ms"},
            "method": method, "route": route, "status": seen.status, "duration_ms": round(1e3 * seen.seconds, 1),
            "bytes_in": seen.bytes_in, "bytes_out": seen.bytes_out,
            "key_id": getattr(identity, "key_id", None), "organisation_id": getattr(identity, "organisation_id", None),
        },
    )  # fmt: skip
