"""Statements as spans of the request or job that they belong to; values are never in them, only their places."""

from typing import Any

from opentelemetry import trace
from sqlalchemy import Connection, Engine, event
from sqlalchemy.engine import ExceptionContext

__all__ = ["trace_statements"]

_tracer = trace.get_tracer("isodyn")
_SPAN = "isodyn_span"


def trace_statements(engine: Engine) -> None:
    """From here on every statement on the engine is a span where somebody traces."""
    event.listen(engine, "before_cursor_execute", _begin)
    event.listen(engine, "after_cursor_execute", _end)
    event.listen(engine, "handle_error", _fail)


def _begin(connection: Connection, _cursor: Any, statement: str, *_: Any) -> None:
    if trace.get_current_span().is_recording():
        attributes = {"db.system.name": connection.dialect.name, "db.query.text": statement}
        name = statement.split(None, 1)[0].upper()
        connection.info[_SPAN] = _tracer.start_span(name, kind=trace.SpanKind.CLIENT, attributes=attributes)


def _end(connection: Connection, *_: Any) -> None:
    if (span := connection.info.pop(_SPAN, None)) is not None:
        span.end()


def _fail(failed: ExceptionContext) -> None:
    if failed.connection is not None and (span := failed.connection.info.pop(_SPAN, None)) is not None:
        span.set_status(trace.StatusCode.ERROR, type(failed.original_exception).__name__)
        span.end()
