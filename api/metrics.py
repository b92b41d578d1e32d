"""Prometheus text of one API process: its own requests, and the state of queue, index and controller."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from prometheus_client import CollectorRegistry, Counter, Histogram, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily, Metric

from graspd.service.index.queries.overview import IndexStatus
from graspd.service.model.series import HTTP_BUCKETS_S, SERIES, STAGE_BUCKETS_S, parse_field
from graspd.service.queue.port import QueueStatus

CONTENT_TYPE: Final = "text/plain; version=0.0.4; charset=utf-8"

Values = dict[str, dict[tuple[str, ...], float]]


class Metrics:
    """Counts and durations of this process's requests, rendered together with a snapshot of the service."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        count, time = SERIES["graspd_http_requests_total"], SERIES["graspd_http_request_seconds"]
        self._requests = Counter(count.name, count.meaning, count.labels, registry=self.registry)
        self._seconds = Histogram(time.name, time.meaning, time.labels, registry=self.registry, buckets=HTTP_BUCKETS_S)

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        self._requests.labels(method, route, str(status)).inc()
        self._seconds.labels(method, route).observe(seconds)

    def render(self, service: MetricsSnapshot) -> bytes:
        snapshot = CollectorRegistry()
        snapshot.register(service)
        return generate_latest(self.registry) + generate_latest(snapshot)


class MetricsSnapshot:
    """State of the service at a scrape. Series of parts that do not answer are omitted."""

    def __init__(self) -> None:
        self._values: Values = defaultdict(dict)
        self._sums: Mapping[str, float] = {}

    def add_parts(self, latencies_s: Mapping[str, float | None]) -> None:
        for part, seconds in latencies_s.items():
            self._set("graspd_part_up", part, value=float(seconds is not None))
            if seconds is not None:
                self._set("graspd_part_latency_seconds", part, value=seconds)

    def add_queue(self, queue: QueueStatus, *, is_kept: bool) -> None:
        for (priority, stage), depth in queue.depth.items():
            self._set("graspd_queue_depth", priority, stage, value=depth)
            oldest = queue.oldest_s.get((priority, stage), 0.0)
            self._set("graspd_queue_oldest_task_seconds", priority, stage, value=oldest)
            self._set("graspd_tasks_running", priority, stage, value=queue.running.get((priority, stage), 0))
        states = [beat.state for beat, _ in queue.workers.values()]
        for state in ("checking", "idle", "busy", "stopping", "quarantined"):
            self._set("graspd_workers", state, value=states.count(state))
        for name, (beat, age_s) in queue.workers.items():
            self._set("graspd_worker_lease_age_seconds", name, beat.device, value=age_s)
        self._set("graspd_controller_up", value=float(is_kept))

    def add_index(self, index: IndexStatus) -> None:
        for state, count in index.jobs.items():
            self._set("graspd_jobs_unfinished", state, value=count)
            self._set("graspd_job_oldest_seconds", state, value=index.oldest_s[state])
        self._set("graspd_store_damaged", value=index.damaged)
        self._set("graspd_grasps_per_second", "all", value=index.grasps_per_s)
        self._set("graspd_grasps_per_second", "valid", value=index.valid_per_s)

    def add_sums(self, sums: Mapping[str, float]) -> None:
        self._sums = sums

    def collect(self) -> Iterator[Metric]:
        """Yield all metrics; part of the collector interface of prometheus_client."""
        for name, samples in self._values.items():
            family = GaugeMetricFamily(name, SERIES[name].meaning, labels=SERIES[name].labels)
            for labels, value in samples.items():
                family.add_metric(labels, value)
            yield family
        yield from _metric_families(self._sums)

    def _set(self, name: str, *labels: object, value: float) -> None:
        self._values[name][tuple(map(str, labels))] = value


def _metric_families(sums: Mapping[str, float]) -> Iterable[Metric]:
    """Yield counters and histograms of the controller; fields without a known series are omitted."""
    found: Values = defaultdict(dict)
    for text, amount in sums.items():
        if (parsed := parse_field(text)) is not None:
            found[parsed[0]][parsed[1]] = amount
    for series in SERIES.values():
        if series.source != "controller":
            continue
        if series.kind == "histogram":
            yield _histogram(series.name, series.meaning, found)
            continue
        family = CounterMetricFamily(series.name, series.meaning, labels=series.labels)
        for labels, amount in sorted(found[series.name].items()):
            if len(labels) == len(series.labels):
                family.add_metric(labels, amount)
        yield family


def _histogram(name: str, meaning: str, found: Values) -> Metric:
    family: Any = HistogramMetricFamily(name, meaning, labels=SERIES[name].labels)
    bounds = [*map(str, STAGE_BUCKETS_S), "+Inf"]
    for labels, total in sorted(found[f"{name}_sum"].items()):
        reached, buckets = 0.0, []
        for bound in bounds:
            reached += found[f"{name}_bucket"].get((*labels, bound), 0.0)
            buckets.append((bound, reached))
        family.add_metric(labels, buckets, sum_value=total)
    return family
