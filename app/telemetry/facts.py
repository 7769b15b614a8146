"""What is worked on now: facts that every log line says, from the request or the job that it belongs to.

They lie in a context variable, so they follow the work through `await`, `run_in_threadpool` and `ContextExecutor`.
"""

from collections.abc import Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar, copy_context
from types import MappingProxyType
from typing import Any

__all__ = ["ContextExecutor", "add_facts", "facts", "request_id", "with_facts"]

_NONE: Mapping[str, str] = MappingProxyType({})
_facts: ContextVar[Mapping[str, str]] = ContextVar("facts", default=_NONE)


def facts() -> Mapping[str, str]:
    """The facts by name: request_id of a request; job_id, workflow_id and floor_id of a job, and who asked for it."""
    return _facts.get()


def request_id() -> str | None:
    """The id of the request that is served, or of the one that asked for the job that runs."""
    return _facts.get().get("request_id")


def add_facts(**more: str | None) -> None:
    """Say these from here to the end of this request or job; what is None is not said."""
    _facts.set({**_facts.get(), **{name: value for name, value in more.items() if value is not None}})


@contextmanager
def with_facts(**more: str | None) -> Iterator[None]:
    """Say these within the block."""
    before = _facts.get()
    add_facts(**more)
    try:
        yield
    finally:
        _facts.set(before)


class ContextExecutor(ThreadPoolExecutor):
    """A thread pool whose work keeps the context of whoever submits it: its facts, and the span it belongs to."""

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        return super().submit(copy_context().run, fn, *args, **kwargs)
