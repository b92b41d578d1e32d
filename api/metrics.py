"""Prometheus metrics of the API process, in a registry of their own."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

from service.domain import Lane, Stage
from service.index.views import Stats

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"


class Metrics:
    """Counts and times what this process answered; gauges of the service are set at each scrape."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        labels = ("method", "route", "status")
        self._requests = Counter("graspd_http_requests", "answered requests", labels, registry=self.registry)
        self._seconds = Histogram(
            "graspd_http_request_seconds",
            "time to answer [s]",
            ("method", "route"),
            registry=self.registry,
            buckets=(0.002, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0),
        )
        self._up = Gauge("graspd_part_up", "1: the part answers", ("part",), registry=self.registry)
        self._latency = Gauge(
            "graspd_part_latency_seconds", "time the part took to answer [s]", ("part",), registry=self.registry
        )
        self._jobs = Gauge("graspd_jobs", "jobs by state", ("state",), registry=self.registry)
        self._tasks = Gauge("graspd_tasks", "tasks by state", ("state",), registry=self.registry)
        self._waiting = Gauge("graspd_queue_depth", "waiting tasks", ("lane", "stage"), registry=self.registry)
        self._grasps = Gauge("graspd_grasps", "grasps in the index", ("verdict",), registry=self.registry)
        self._workers = Gauge("graspd_workers", "workers that hold their lease", registry=self.registry)

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one answered request."""
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(method, route).observe(seconds)

    def set_part(self, part: str, latency_s: float | None) -> None:
        """State of redis, index or store; None: it does not answer."""
        self._up.labels(part).set(latency_s is not None)
        if latency_s is not None:
            self._latency.labels(part).set(latency_s)

    def set_counts(self, stats: Stats, depths: Mapping[tuple[Lane, Stage], int]) -> None:
        """What the index and the queue say now."""
        for state, count in stats.jobs.items():
            self._jobs.labels(state).set(count)
        for state, count in stats.tasks.items():
            self._tasks.labels(state).set(count)
        self._waiting.clear()
        for (lane, stage), count in depths.items():
            self._waiting.labels(lane, stage).set(count)
        self._grasps.labels("all").set(stats.grasps)
        self._grasps.labels("valid").set(stats.valid)
        self._workers.set(stats.workers)

    def render(self) -> bytes:
        """Text exposition format."""
        return generate_latest(self.registry)
