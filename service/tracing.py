"""OpenTelemetry spans, where the operator asks for them: OTEL_EXPORTER_OTLP_ENDPOINT set and `graspd[otel]` installed.

Off, nothing of OpenTelemetry is imported and a span costs a comparison.
"""

from __future__ import annotations

import logging
import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Final

log = logging.getLogger(__name__)
_ASKED_BY: Final = ("OTEL_EXPORTER_OTLP_ENDPOINT", "OTEL_EXPORTER_OTLP_TRACES_ENDPOINT")
_tracer: Any = None


def set_up(process: str, *, exporter: Any = None) -> None:
    """Send the spans of this process where the environment says; do nothing if it says nothing.

    Args:
        process: its name: api or worker; the spans' service is `graspd-{process}`.
        exporter: where to send them instead.
    """
    global _tracer
    if exporter is None and not any(os.environ.get(name) for name in _ASKED_BY):
        return
    try:
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor, SimpleSpanProcessor
    except ImportError:
        log.warning("no traces are sent: run `pip install 'graspd[otel]'`, or unset %s", _ASKED_BY[0])
        return
    resource = Resource.create({"service.name": os.environ.get("OTEL_SERVICE_NAME", f"graspd-{process}")})
    provider = TracerProvider(resource=resource)
    provider.add_span_processor(
        SimpleSpanProcessor(exporter) if exporter is not None else BatchSpanProcessor(OTLPSpanExporter())
    )
    _tracer = provider.get_tracer("graspd")


def stop() -> None:
    """Make no more spans."""
    global _tracer
    _tracer = None


@contextmanager
def span(name: str, *, parent: str = "", **attributes: Any) -> Iterator[dict[str, Any]]:
    """A span around what is done within; an exception marks it as failed.

    Args:
        parent: `traceparent` of the span that caused this one (W3C trace context), in whatever process.
        attributes: what it is about, as `graspd.{name}`.

    Yields:
        a dictionary; what is put there becomes attributes at the end.
    """
    later: dict[str, Any] = {}
    if _tracer is None:
        yield later
        return
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    context = TraceContextTextMapPropagator().extract({"traceparent": parent}) if parent else None
    known = {f"graspd.{key}": value for key, value in attributes.items()}
    with _tracer.start_as_current_span(name, context=context, attributes=known) as current:
        yield later
        current.set_attributes(later)


def traceparent() -> str:
    """W3C trace context of the present span; empty without one."""
    if _tracer is None:
        return ""
    from opentelemetry.trace.propagation.tracecontext import TraceContextTextMapPropagator

    carrier: dict[str, str] = {}
    TraceContextTextMapPropagator().inject(carrier)
    return carrier.get("traceparent", "")
