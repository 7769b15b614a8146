"""Log lines: one event a line on standard error, text for people or JSON for machines, with the facts of its work."""

import logging
import sys
import threading
import time
from types import TracebackType
from typing import Any, Literal

from opentelemetry import trace
from pythonjsonlogger.core import RESERVED_ATTRS
from pythonjsonlogger.json import JsonFormatter

from app.telemetry.facts import facts

__all__ = ["LogFormat", "LogLevel", "configure_logs"]

LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]

_OURS = ("app", "workers")
_NAMES = {"levelname": "level", "name": "logger"}
_NOT_SAID = {*RESERVED_ATTRS, "message", "asctime", "taskName", "color_message", "in_message"}


def configure_logs(format: LogFormat, level: LogLevel) -> None:
    """Set up the log of this process: `level` for Isodyn itself, for libraries never below warnings."""
    handler = logging.StreamHandler()
    handler.addFilter(_say_facts)
    handler.setFormatter(_Json() if format == "json" else _Text())
    ours = logging.getLevelNamesMapping()[level.upper()]
    logging.basicConfig(level=max(ours, logging.WARNING), handlers=[handler], force=True)
    for name in _OURS:
        logging.getLogger(name).setLevel(ours)
    _take_over("dbos")
    logging.captureWarnings(True)
    sys.excepthook = _say_last_words
    threading.excepthook = _say_last_words_of_thread


def _say_facts(record: logging.LogRecord) -> bool:
    for name, value in facts().items():
        record.__dict__.setdefault(name, value)
    span = trace.get_current_span().get_span_context()
    if span.is_valid:
        record.trace_id = trace.format_trace_id(span.trace_id)
    return True


def _take_over(library: str) -> None:
    """Let a library that would write lines of its own style write ours."""
    logger = logging.getLogger(library)
    logger.handlers = [logging.NullHandler()]
    logger.propagate = True


def _say_last_words(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    if issubclass(kind, KeyboardInterrupt):
        sys.__excepthook__(kind, error, trace)
        return
    logging.getLogger("app").critical("the process ends by an error", exc_info=(kind, error, trace))


def _say_last_words_of_thread(told: threading.ExceptHookArgs) -> None:
    if told.exc_value is not None and not issubclass(told.exc_type, SystemExit):
        name = told.thread.name if told.thread else "unknown"
        logging.getLogger("app").critical(
            "thread %s ends by an error", name, exc_info=(told.exc_type, told.exc_value, told.exc_traceback)
        )


class _Json(JsonFormatter):
    """`{"time": ..., "level": ..., "logger": ..., "message": ..., facts and figures ...}`"""

    def __init__(self) -> None:
        super().__init__(["levelname", "name", "message"], rename_fields=_NAMES, timestamp="time",
                         reserved_attrs=[*_NOT_SAID])  # fmt: skip


class _Text(logging.Formatter):
    """`2026-01-31T12:00:00.123Z INFO app.api.access_log: GET /v1/buildings 200 3.1 ms request_id=...`"""

    converter = time.gmtime  # type: ignore[assignment]
    default_time_format = "%Y-%m-%dT%H:%M:%S"
    default_msec_format = "%s.%03dZ"

    def __init__(self) -> None:
        super().__init__("%(asctime)s %(levelname)s %(name)s: %(message)s")

    def formatMessage(self, record: logging.LogRecord) -> str:
        said = _NOT_SAID | getattr(record, "in_message", set())
        more: dict[str, Any] = {name: value for name, value in vars(record).items() if name not in said}
        return " ".join(
            [super().formatMessage(record), *(f"{k}={v}" for k, v in more.items() if v is not None)]
        )  # fmt: skip
