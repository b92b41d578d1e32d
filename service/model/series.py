"""Definitions of all time series of `/metrics`, and names of the stored sums."""

import json
from dataclasses import dataclass
from typing import Final, Literal

from pydantic_core import from_json

STAGE_BUCKETS_S: Final = (0.1, 0.3, 1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1000.0)
HTTP_BUCKETS_S: Final = (0.002, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 1.0, 5.0)
#: Labels of series of tasks.
_TASK: Final = ("priority", "stage")


@dataclass(frozen=True)
class Series:
    name: str
    kind: Literal["gauge", "counter", "histogram"]
    labels: tuple[str, ...]
    meaning: str
    source: Literal["queue", "index", "probe", "controller", "process"]


_ALL: Final = (
    Series("graspd_queue_depth", "gauge", _TASK, "waiting tasks", "queue"),
    Series("graspd_queue_oldest_task_seconds", "gauge", _TASK, "age of the oldest waiting task", "queue"),
    Series("graspd_tasks_running", "gauge", _TASK, "tasks that workers are running", "queue"),
    Series("graspd_workers", "gauge", ("state",), "workers: checking, idle, busy, stopping, quarantined", "queue"),
    Series("graspd_worker_lease_age_seconds", "gauge", ("worker", "device"), "time since the last heartbeat", "queue"),
    Series("graspd_controller_up", "gauge", (), "1: a controller sent a heartbeat recently", "queue"),
    Series("graspd_jobs_unfinished", "gauge", ("state",), "queued and running jobs, counted up to 10,000", "index"),
    Series("graspd_job_oldest_seconds", "gauge", ("state",), "age of the oldest queued and running job", "index"),
    Series("graspd_grasps_per_second", "gauge", ("verdict",), "stored grasps per second of the last minute", "index"),
    Series("graspd_store_damaged", "gauge", (), "objects of the store known to be damaged or missing", "index"),
    Series("graspd_part_up", "gauge", ("part",), "1: the part (redis, index or store) responds", "probe"),
    Series("graspd_part_latency_seconds", "gauge", ("part",), "response time of a ping, read or small write", "probe"),
    Series("graspd_grasps_total", "counter", ("verdict",), "grasps (all, valid), tested candidates", "controller"),
    Series("graspd_shards_total", "counter", ("stage",), "shards written", "controller"),
    Series("graspd_shard_bytes_total", "counter", ("stage",), "bytes of the shards written", "controller"),
    Series("graspd_stage_seconds", "histogram", ("stage",), "duration of one task on a worker", "controller"),
    Series("graspd_task_failures_total", "counter", ("stage", "kind"), "failed attempts by error", "controller"),
    Series(
        "graspd_task_handbacks_total",
        "counter",
        ("stage", "kind"),
        "unfinished tasks that workers gave back: deferred, returned, cancelled",
        "controller",
    ),
    Series("graspd_jobs_ended_total", "counter", ("state",), "finished jobs by final state", "controller"),
    Series("graspd_http_requests_total", "counter", ("method", "route", "status"), "HTTP requests answered", "process"),
    Series("graspd_http_request_seconds", "histogram", ("method", "route"), "response time", "process"),
)

SERIES: Final[dict[str, Series]] = {series.name: series for series in _ALL}


def field_name(name: str, *labels: str) -> str:
    return json.dumps([name, *labels])


def parse_field(text: str) -> tuple[str, tuple[str, ...]] | None:
    try:
        name, *labels = from_json(text)
    except (ValueError, TypeError):
        return None
    return (name, tuple(map(str, labels))) if isinstance(name, str) else None
