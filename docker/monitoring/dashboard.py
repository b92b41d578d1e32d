"""Write the Grafana dashboard `grafana.json`: `python docker/monitoring/dashboard.py`.

The JSON repeats the same settings for every panel; here each panel is one row of a table. Import `grafana.json` in
Grafana (Dashboards, New, Import) and choose the Prometheus that scrapes graspd.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

_WIDE, _HIGH = 24, 8
#: Title, Grafana unit, width (of 24), and legend -> expression. An empty legend makes a tile with one value.
ROWS: dict[str, list[tuple[str, str, int, dict[str, str]]]] = {
    "Now": [
        ("Valid grasps per second", "short", 4, {"": 'max(graspd_grasps_per_second{verdict="valid"})'}),
        ("Workers", "short", 4, {"": 'max(sum without (state) (graspd_workers{state=~"idle|busy"}))'}),
        ("Waiting tasks", "short", 4, {"": "sum(max by (priority, stage) (graspd_queue_depth))"}),
        ("Unfinished jobs", "short", 4, {"": "sum(max by (state) (graspd_jobs_unfinished))"}),
        ("Controller", "bool_yes_no", 4, {"": "max(graspd_controller_up)"}),
        ("Damaged objects", "short", 4, {"": "max(graspd_store_damaged)"}),
    ],
    "Work": [
        (
            "Grasps per second",
            "short",
            12,
            {"{{verdict}}": "max by (verdict) (rate(graspd_grasps_total[$__rate_interval]))"},
        ),
        (
            "Shards per second",
            "short",
            12,
            {"{{stage}}": "max by (stage) (rate(graspd_shards_total[$__rate_interval]))"},
        ),
        ("Waiting tasks", "short", 8, {"{{priority}} {{stage}}": "max by (priority, stage) (graspd_queue_depth)"}),
        (
            "Age of the oldest waiting task",
            "s",
            8,
            {"{{priority}} {{stage}}": "max by (priority, stage) (graspd_queue_oldest_task_seconds)"},
        ),
        ("Age of the oldest job", "s", 8, {"{{state}}": "max by (state) (graspd_job_oldest_seconds)"}),
    ],
    "Workers": [
        ("Workers", "short", 8, {"{{state}}": "max by (state) (graspd_workers)"}),
        (
            "Running tasks",
            "short",
            8,
            {"{{stage}}": "sum by (stage) (max by (priority, stage) (graspd_tasks_running))"},
        ),
        ("Oldest heartbeats", "s", 8, {"{{worker}}": "topk(5, max by (worker) (graspd_worker_lease_age_seconds))"}),
        (
            "Duration of a task, median and 95th percentile",
            "s",
            12,
            {
                "{{stage}} p50": "histogram_quantile(0.5, "
                "max by (stage, le) (rate(graspd_stage_seconds_bucket[$__rate_interval])))",
                "{{stage}} p95": "histogram_quantile(0.95, "
                "max by (stage, le) (rate(graspd_stage_seconds_bucket[$__rate_interval])))",
            },
        ),
        (
            "Failures and returned tasks per hour",
            "short",
            12,
            {
                "{{stage}} {{kind}}": "max by (stage, kind) (increase(graspd_task_failures_total[1h])) > 0",
                "{{stage}} {{kind}} (returned)": "max by (stage, kind) (increase(graspd_task_handbacks_total[1h])) > 0",
            },
        ),
    ],
    "Service": [
        ("Ended jobs per hour", "short", 12, {"{{state}}": "max by (state) (increase(graspd_jobs_ended_total[1h]))"}),
        (
            "Bytes written per second",
            "Bps",
            12,
            {"{{stage}}": "max by (stage) (rate(graspd_shard_bytes_total[$__rate_interval]))"},
        ),
        ("Response time of the parts", "s", 12, {"{{part}}": "max by (part) (graspd_part_latency_seconds)"}),
        ("Parts that respond", "bool_yes_no", 12, {"{{part}}": "min by (part) (graspd_part_up)"}),
        (
            "Requests per second",
            "reqps",
            12,
            {"{{status}}": "sum by (status) (rate(graspd_http_requests_total[$__rate_interval]))"},
        ),
        (
            "Response time, 95th percentile",
            "s",
            12,
            {
                "{{route}}": "topk(8, histogram_quantile(0.95, "
                "sum by (route, le) (rate(graspd_http_request_seconds_bucket[$__rate_interval]))))"
            },
        ),
    ],
}
_SOURCE = {"type": "prometheus", "uid": "${source}"}


def dashboard() -> dict[str, Any]:
    """Return the dashboard as JSON data."""
    panels: list[dict[str, Any]] = []
    y = 0
    for name, row in ROWS.items():
        panels.append(
            {"type": "row", "title": name, "id": len(panels) + 1, "collapsed": False, "panels": []}
            | {"gridPos": {"x": 0, "y": y, "w": _WIDE, "h": 1}}
        )
        y, x = y + 1, 0
        height = 4 if all("" in drawn for *_, drawn in row) else _HIGH
        for title, unit, width, drawn in row:
            if x + width > _WIDE:
                x, y = 0, y + height
            place = {"x": x, "y": y, "w": width, "h": height}
            panels.append(_panel(len(panels) + 1, title, unit, place, drawn))
            x += width
        y += height
    source = {"name": "source", "label": "Prometheus", "type": "datasource", "query": "prometheus", "current": {}}
    return {
        "title": "graspd",
        "uid": "graspd",
        "tags": ["graspd"],
        "schemaVersion": 39,
        "editable": True,
        "refresh": "30s",
        "time": {"from": "now-6h", "to": "now"},
        "templating": {"list": [source]},
        "panels": panels,
    }


def _panel(number: int, title: str, unit: str, place: dict[str, int], drawn: dict[str, str]) -> dict[str, Any]:
    return {
        "type": "stat" if "" in drawn else "timeseries",
        "id": number,
        "title": title,
        "gridPos": place,
        "datasource": _SOURCE,
        "fieldConfig": {"defaults": {"unit": unit, "min": 0}, "overrides": []},
        "options": {"colorMode": "none"} if "" in drawn else {"legend": {"displayMode": "list", "placement": "bottom"}},
        "targets": [
            {"refId": chr(ord("A") + place), "datasource": _SOURCE, "expr": expression, "legendFormat": legend}
            for place, (legend, expression) in enumerate(drawn.items())
        ],
    }


def text() -> str:
    """Return the text of `grafana.json`."""
    return json.dumps(dashboard(), indent=2) + "\n"


if __name__ == "__main__":
    Path(__file__).with_name("grafana.json").write_text(text())
