"""Every series of `/metrics`, and what the controller counts of them as it indexes.

`docs/reference/metrics.md` has a table of them. The sums lie in one hash in Redis, so every API process shows the same.

They start from zero when Redis is lost, which Prometheus takes for a restart; an event that comes twice counts twice.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Final, Literal

from pydantic_core import from_json

from graspd.service.model.states import State
from graspd.service.store.manifests import ShardManifest

#: Upper bounds of the histogram of stage times [s].
STAGE_BUCKETS_S: Final = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
#: Upper bounds of the histogram of answers [s].
HTTP_BUCKETS_S: Final = (0.002, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0)


@dataclass(frozen=True)
class Series:
    """One name of Prometheus."""

    name: str
    kind: Literal["gauge", "counter", "histogram"]
    labels: tuple[str, ...]
    meaning: str
    source: Literal["queue", "index", "probe", "controller", "process"]


_ALL: Final = (
    Series("graspd_queue_depth", "gauge", ("priority", "stage"), "tasks that wait in the queue", "queue"),
    Series("graspd_queue_oldest_task_seconds", "gauge", ("priority", "stage"), "age of the oldest of them", "queue"),
    Series("graspd_tasks_running", "gauge", ("priority", "stage"), "tasks in a worker's hands", "queue"),
    Series(
        "graspd_workers",
        "gauge",
        ("state",),
        "workers by what they do: checking, idle, busy, stopping, quarantined",
        "queue",
    ),
    Series("graspd_worker_lease_age_seconds", "gauge", ("worker", "device"), "time since its last beat", "queue"),
    Series("graspd_controller_up", "gauge", (), "1: a controller gave a sign of life lately", "queue"),
    Series("graspd_jobs_unfinished", "gauge", ("state",), "queued and running jobs, counted up to 10,000", "index"),
    Series("graspd_job_oldest_seconds", "gauge", ("state",), "age of the oldest queued and running job", "index"),
    Series("graspd_grasps_per_second", "gauge", ("verdict",), "grasps kept in the last minute: all, valid", "index"),
    Series("graspd_store_damaged", "gauge", (), "objects of the store known to be damaged or missing", "index"),
    Series("graspd_part_up", "gauge", ("part",), "1: redis, index or store answers", "probe"),
    Series("graspd_part_latency_seconds", "gauge", ("part",), "time of a ping, a read, a small write", "probe"),
    Series(
        "graspd_grasps_total",
        "counter",
        ("verdict",),
        "grasps kept: all, valid; candidates: validated",
        "controller",
    ),
    Series("graspd_shards_total", "counter", ("stage",), "shards written", "controller"),
    Series("graspd_shard_bytes_total", "counter", ("stage",), "bytes of them", "controller"),
    Series("graspd_stage_seconds", "histogram", ("stage",), "time a worker spent on one task", "controller"),
    Series(
        "graspd_task_failures_total", "counter", ("stage", "kind"), "failed attempts by the error's name", "controller"
    ),
    Series("graspd_task_handbacks_total", "counter", ("stage", "kind"), "deferred, returned, cancelled", "controller"),
    Series(
        "graspd_jobs_ended_total", "counter", ("state",), "jobs that succeeded, failed or were cancelled", "controller"
    ),
    Series("graspd_http_requests_total", "counter", ("method", "route", "status"), "requests answered", "process"),
    Series("graspd_http_request_seconds", "histogram", ("method", "route"), "time to answer", "process"),
)

SERIES: Final[dict[str, Series]] = {series.name: series for series in _ALL}


def series_table() -> str:
    """Markdown table of all series."""
    lines = ["| series | type | labels | meaning | from |", "| --- | --- | --- | --- | --- |"]
    for series in SERIES.values():
        labels = ", ".join(f"`{label}`" for label in series.labels)
        lines.append(f"| `{series.name}` | {series.kind} | {labels} | {series.meaning} | {series.source} |")
    return "\n".join(lines)


#: Names of errors that get a series of their own; more than an engine raises, and a bound if somebody forges them.
MOST_KINDS: Final = 60
OTHER_KIND: Final = "other"


class Tally:
    """Counts in memory; `flush` adds that to the sums in one go."""

    def __init__(self, count: Callable[[Mapping[str, float]], None]) -> None:
        """`count` adds to the sums."""
        self._count = count
        self._amounts: defaultdict[str, float] = defaultdict(float)
        self._kinds: set[tuple[str, str]] = set()

    def made(self, manifests: Iterable[ShardManifest]) -> None:
        """Shards that were indexed."""
        for manifest in manifests:
            stage = manifest.stage.value
            self._add("graspd_shards_total", stage)
            self._add("graspd_shard_bytes_total", stage, amount=manifest.size_bytes)
            self._observe("graspd_stage_seconds", stage, seconds=manifest.seconds)
            if manifest.kind == "base":
                self._add("graspd_grasps_total", "all", amount=manifest.count)
                self._add("graspd_grasps_total", "valid", amount=manifest.valid)
                self._add("graspd_grasps_total", "validated", amount=manifest.validated)

    def failed(self, stage: str, kind: str) -> None:
        """An attempt of a task failed."""
        if (stage, kind) not in self._kinds:
            if len(self._kinds) >= MOST_KINDS:
                kind = OTHER_KIND
            self._kinds.add((stage, kind))
        self._add("graspd_task_failures_total", stage, kind)

    def handed_back(self, stage: str, kind: str) -> None:
        """A task was deferred, returned or cancelled."""
        self._add("graspd_task_handbacks_total", stage, kind)

    def ended(self, state: State) -> None:
        """A job came to its end."""
        self._add("graspd_jobs_ended_total", state.value)

    def flush(self) -> None:
        """Add what was counted to the sums; QueueUnavailable keeps it for the next time."""
        if self._amounts:
            self._count(self._amounts)
            self._amounts.clear()

    def _observe(self, name: str, *labels: str, seconds: float) -> None:
        bound = next((bound for bound in STAGE_BUCKETS_S if seconds <= bound), None)
        self._amounts[field(f"{name}_bucket", *labels, "+Inf" if bound is None else str(bound))] += 1
        self._amounts[field(f"{name}_sum", *labels)] += seconds

    def _add(self, name: str, *labels: str, amount: float = 1) -> None:
        assert len(SERIES[name].labels) == len(labels)
        self._amounts[field(name, *labels)] += amount


def field(name: str, *labels: str) -> str:
    """Name of a sum: the series and the values of its labels."""
    return json.dumps([name, *labels])


def parse_field(text: str) -> tuple[str, tuple[str, ...]] | None:
    """Series and label values of a sum; None if it is not one of ours."""
    try:
        name, *labels = from_json(text)
    except (ValueError, TypeError):
        return None
    return (name, tuple(map(str, labels))) if isinstance(name, str) else None
