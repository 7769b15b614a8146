"""Each operation of a blob store is timed, counted when it fails, and a span."""

from collections.abc import Callable
from functools import wraps
from typing import ParamSpec, TypeVar

from opentelemetry import trace

from app.errors import NotFound
from app.telemetry.metrics import BLOB_ERRORS, BLOB_SECONDS

__all__ = ["observed"]

P = ParamSpec("P")
R = TypeVar("R")

_tracer = trace.get_tracer("isodyn")


def observed(operation: Callable[P, R]) -> Callable[P, R]:
    """The operation under its own name. A blob that is not there is an answer, not a failure."""
    name = operation.__name__
    seconds, errors = BLOB_SECONDS.labels(name), BLOB_ERRORS.labels(name)

    @wraps(operation)
    def observe(*args: P.args, **kwargs: P.kwargs) -> R:
        with _tracer.start_as_current_span(f"blob {name}"), seconds.time():
            try:
                return operation(*args, **kwargs)
            except NotFound:
                raise
            except Exception:
                errors.inc()
                raise

    return observe
