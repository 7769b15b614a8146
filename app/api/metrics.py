"""What `/metrics` shows of one web process."""

from time import perf_counter

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram
from starlette.types import ASGIApp, Message, Receive, Scope, Send

__all__ = ["Metrics", "MetricsMiddleware"]

_METHODS = frozenset({"GET", "POST", "PATCH", "DELETE", "PUT", "HEAD", "OPTIONS"})


class Metrics:
    """The counters of one web process."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        labels = ("method", "route", "status")
        self.requests = Counter("isodyn_http_requests", "Requests served", labels, registry=self.registry)
        self.seconds = Histogram(
            "isodyn_http_request_seconds", "Time to serve a request", ("method", "route"), registry=self.registry
        )
        self.cached_bytes = Gauge("isodyn_grid_cache_bytes", "Memory of maps held ready", registry=self.registry)
        self.cached_maps = Gauge("isodyn_grid_cache_maps", "Maps held ready", registry=self.registry)


class MetricsMiddleware:
    """Count and time each request under its route's template, never under its path (ids would be labels)."""

    def __init__(self, app: ASGIApp, metrics: Metrics) -> None:
        self.app, self.metrics = app, metrics

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        status, start = 500, perf_counter()

        async def watch(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
            await send(message)

        try:
            await self.app(scope, receive, watch)
        finally:
            route = getattr(scope.get("route"), "path", "unmatched")
            method = scope["method"] if scope["method"] in _METHODS else "other"
            self.metrics.requests.labels(method, route, status).inc()
            self.metrics.seconds.labels(method, route).observe(perf_counter() - start)
