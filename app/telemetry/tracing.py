"""Traces by OpenTelemetry, where they are wanted. The code names its spans in any case; unsent they cost little.

A `traceparent` that came with a request is in the log's lines and goes on to its jobs also where no traces are sent.
"""

import os

from opentelemetry import propagate, trace
from opentelemetry.context import Context

from app.errors import InvalidInput

__all__ = ["configure_tracing", "flush_traces", "link_to", "traced_from", "traceparent"]


def configure_tracing(wanted: bool, service: str) -> None:
    """Send this process's spans by OTLP over HTTP if `wanted`, or if OTEL_EXPORTER_OTLP_ENDPOINT says where to.

    Everything else is told by OpenTelemetry's own variables. Raises InvalidInput where its SDK is not installed.
    """
    if not wanted and not os.environ.get("OTEL_EXPORTER_OTLP_ENDPOINT"):
        return
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
    except ImportError as error:
        raise InvalidInput(
            "traces are wanted (ISODYN_OTEL or OTEL_EXPORTER_OTLP_ENDPOINT), but what sends them is not installed: "
            "pip install 'isodyn[otel]', or unset these"
        ) from error
    named = {} if os.environ.get("OTEL_SERVICE_NAME") else {"service.name": service}
    provider = TracerProvider(resource=Resource.create(named))
    provider.add_span_processor(BatchSpanProcessor(OTLPSpanExporter()))
    trace.set_tracer_provider(provider)


def flush_traces() -> None:
    """Send what has not been sent, before a process ends without its exit handlers."""
    flush = getattr(trace.get_tracer_provider(), "force_flush", None)
    if flush is not None:
        flush(2000)


def traceparent() -> str | None:
    """The place in a trace where we are, as W3C writes it; None outside of one."""
    carrier: dict[str, str] = {}
    propagate.inject(carrier)
    return carrier.get("traceparent")


def traced_from(told: str | None) -> Context:
    """A context that goes on from there: for `opentelemetry.context.attach`, or a span's `context`."""
    return propagate.extract({} if told is None else {"traceparent": told})


def link_to(told: str | None) -> None:
    """Link the current span to that place: this happens because of it, but not within it."""
    span = trace.get_current_span(traced_from(told)).get_span_context()
    if told is not None and span.is_valid:
        trace.get_current_span().add_link(span)
