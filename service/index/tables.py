"""Tables of the index. `LIVE_COLUMNS` are current state (progress, queue marks), others are derived.

Each change, except for metrics of grasps, needs another `REVISION` in `database`; a test enforces this. `applied` and
`planned` of datasets are the progress of the controller; tags are users' names for grasps.
"""

from __future__ import annotations

from typing import Any, Final

from sqlalchemy import JSON, BigInteger, Boolean, Column, Float, Index, Integer, MetaData, String, Table, Text, false
from sqlalchemy.types import TypeEngine

from graspd.service.model.metrics import IndexLevel, indexed_metrics

metadata: Final = MetaData()


def required_columns(kind: TypeEngine[Any] | type[TypeEngine[Any]], *names: str) -> list[Column[Any]]:
    return [Column(name, kind, nullable=False) for name in names]


def owner_columns() -> list[Column[Any]]:
    widths = {"owner": 64, "project": 32}
    return [Column(name, String(width), nullable=False, server_default="") for name, width in widths.items()]


jobs: Final = Table(
    "jobs",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("state", String(10), nullable=False),
    Column("priority", String(12), nullable=False),
    *required_columns(String(64), "hand", "object"),
    *required_columns(String(32), "hand_digest", "object_digest"),
    Column("request", JSON, nullable=False),
    Column("revisions", JSON, nullable=False, server_default='{"synthesize": 1, "scene": 1, "render": 1}'),
    Column("origin", JSON(none_as_null=True)),
    *owner_columns(),
    Column("cancelled", Boolean, nullable=False),
    # Number of batches per task.
    Column("span", Integer, nullable=False),
    Column("created", String(32), nullable=False),
    Column("finished", String(32)),
    Column("reason", Text),
    # Digests of the neighbours, separated by spaces; a list would need a table.
    Column("neighbours", String(300), nullable=False, server_default=""),
    Column("choice", JSON(none_as_null=True)),
    Column("network_digest", String(32), nullable=False, server_default=""),
    Index("jobs_beside", "neighbours"),
    Index("jobs_newest", "created", "id"),
    Index("jobs_by_state", "state", "created", "id"),
    Index("jobs_by_pair", "hand", "object"),
    Index("jobs_of_project", "project", "created", "id"),
)
tasks: Final = Table(
    "tasks",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("job_id", String(32), nullable=False),
    Column("stage", String(12), nullable=False),
    *required_columns(Integer, "batch", "position", "count"),
    Column("priority", String(12), nullable=False),
    Column("inputs", JSON, nullable=False),
    Column("shard_id", String(32), nullable=False),
    Column("state", String(10), nullable=False),
    *required_columns(Boolean, "ready", "done"),
    Column("last_attempt", Integer, nullable=False),
    Column("exhausted", Boolean, nullable=False),
    Column("retried_upto", Integer, nullable=False),
    Column("reason", Text),
    Column("worker", String(128)),
    Column("device", String(64)),
    Column("seconds", Float),
    Column("finished", String(32)),
    Column("created", String(32), nullable=False),
    Column("queued", Boolean, nullable=False, default=False),
    Column("not_before", Float, nullable=False, default=0.0),
    Column("progress_done", Float, nullable=False, default=0.0),
    Column("progress_total", Float, nullable=False, default=0.0),
    Column("progress_message", Text),
    Index("tasks_of_job", "job_id", "batch", "position"),
    Index("tasks_by_state", "job_id", "state"),
    Index("tasks_by_shard", "shard_id"),
    Index("tasks_waiting", "job_id", "ready", "queued", "batch"),
    Index("tasks_in_queue", "queued", "ready"),
    Index("tasks_finished", "finished"),
)
attempts: Final = Table(
    "attempts",
    metadata,
    Column("task_id", String(32), primary_key=True),
    Column("number", Integer, primary_key=True),
    Column("job_id", String(32), nullable=False),
    Column("stage", String(12), nullable=False),
    Column("kind", String(64), nullable=False),
    Column("reason", Text, nullable=False),
    Column("trace", Text),
    Column("worker", String(128), nullable=False),
    Column("started", String(32)),
    Column("ended", String(32), nullable=False),
    Column("last", Boolean, nullable=False),
    Index("attempts_of_job", "job_id", "ended"),
    Index("attempts_by_kind", "stage", "kind"),
)
shards: Final = Table(
    "shards",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("kind", String(8), nullable=False),
    Column("stage", String(12), nullable=False),
    Column("key", String(128), nullable=False),
    Column("sha256", String(64), nullable=False),
    Column("size_bytes", BigInteger, nullable=False),
    *required_columns(Integer, "count", "valid"),
    Column("candidates", Integer, nullable=False, server_default="0"),
    Column("rechecked", Integer, nullable=False, server_default="0"),
    Column("recheck_held", Integer, nullable=False, server_default="0"),
    Column("validated", Integer, nullable=False, server_default="0"),
    *required_columns(String(64), "hand", "object"),
    *required_columns(String(32), "hand_digest", "object_digest"),
    Column("batch", Integer, nullable=False),
    Column("batches", Integer, nullable=False, server_default="1"),
    Column("seed", Integer, nullable=False),
    Column("inputs", JSON, nullable=False),
    Column("device", String(64), nullable=False),
    Column("worker", String(128), nullable=False),
    Column("seconds", Float, nullable=False),
    Column("created", String(32), nullable=False),
    Column("manifest", JSON, nullable=False),
    Column("charged", String(32), nullable=False, server_default=""),
    Index("shards_newest", "created", "id"),
    Index("shards_by_kind", "kind", "created", "id"),
    # Sums over shards read only these columns: a row itself is as long as its manifest.
    Index("shards_sums", "kind", "hand", "object", "count", "valid", "candidates", "size_bytes", "validated"),
    Index("shards_of_task", "id", "count", "valid", "candidates", "rechecked", "recheck_held", "validated"),
    Index("shards_made", "created", "kind", "count", "valid", "seconds"),
    Index("shards_charged", "created", "charged", "kind", "device", "count", "valid", "seconds", "size_bytes"),
)
#: Metrics for bounds and sorting.
METRICS: Final = tuple(metric.name for metric in indexed_metrics(IndexLevel.SORTED))
grasps: Final = Table(
    "grasps",
    metadata,
    Column("shard_id", String(32), primary_key=True),
    Column("row", Integer, primary_key=True),
    *required_columns(String(64), "hand", "object"),
    *(Column(metric.name, Integer if metric.whole else Float) for metric in indexed_metrics()),
    Column("valid", Boolean, nullable=False),
    Column("success", Boolean),
    Column("verdict_level", String(12)),
    Column("scene_kind", String(8), nullable=False, server_default="free"),
    Column("neighbours", Integer, nullable=False, server_default="0"),
    Column("lift_hard", Boolean),
    Column("robust_weakest", String(16)),
    Column("created", String(32), nullable=False),
    *(Index(f"grasps_{name}", name, "shard_id", "row") for name in (*METRICS, "created")),
    Index("grasps_by_pair", "hand", "object", "epsilon", "shard_id", "row"),
    Index("grasps_by_hand", "hand", "epsilon", "shard_id", "row"),
    Index("grasps_by_object", "object", "epsilon", "shard_id", "row"),
    sqlite_with_rowid=False,
)
assets: Final = Table(
    "assets",
    metadata,
    Column("kind", String(8), primary_key=True),
    Column("digest", String(32), primary_key=True),
    Column("name", String(64), nullable=False),
    Column("filename", Text, nullable=False),
    Column("files", JSON, nullable=False),
    Column("size_bytes", Integer, nullable=False),
    Column("created", String(32), nullable=False),
    Column("builtin", Boolean, nullable=False),
    *owner_columns(),
    Column("shared", Boolean, nullable=False, server_default=false()),
    Column("verdict", String(8)),
    Column("message", Text),
    *required_columns(JSON, "repairs", "facts"),
    Column("last_attempt", Integer, nullable=False),
    Column("queued", Boolean, nullable=False, default=False),
    Column("not_before", Float, nullable=False, default=0.0),
    Index("assets_by_name", "kind", "name", "created"),
)
workers: Final = Table(
    "workers",
    metadata,
    Column("name", String(128), primary_key=True),
    Column("host", String(128), nullable=False),
    Column("pid", Integer, nullable=False),
    Column("device", String(64), nullable=False),
    Column("device_name", String(128), nullable=False),
    Column("stages", JSON, nullable=False),
    Column("version", String(32), nullable=False),
    Column("state", String(16), nullable=False),
    Column("task_id", String(32)),
    *required_columns(String(32), "started", "seen"),
    Column("reason", String(300), nullable=False, server_default=""),
)
#: Costs of deleted shards by project, day and device, because deleted results count as usage.
spent: Final = Table(
    "spent",
    metadata,
    Column("project", String(32), primary_key=True),
    Column("day", String(10), primary_key=True),
    Column("device", String(64), primary_key=True),
    *required_columns(BigInteger, "grasps", "valid", "tasks"),
    Column("seconds", Float, nullable=False),
)
notes: Final = Table(
    "notes", metadata, Column("name", String(64), primary_key=True), Column("value", JSON, nullable=False)
)
damage: Final = Table(
    "damage",
    metadata,
    Column("key", String(512), primary_key=True),
    Column("what", Text, nullable=False),
    Column("shard", String(64), nullable=False),
    Column("found", String(32), nullable=False),
)
_PROGRESS: Final = ("progress_done", "progress_total", "progress_message")
#: Columns and tables of current state, which do not follow from the store; a rebuild keeps the tables.
LIVE_COLUMNS: Final = frozenset({"queued", "not_before", "applied", "planned", "charged", "told", "seen", *_PROGRESS})
LIVE_TABLES: Final = frozenset({"workers", "notes", "damage", "spent", "ends", "deliveries"})
datasets: Final = Table(
    "datasets",
    metadata,
    Column("name", String(64), primary_key=True),
    Column("digest", String(32), nullable=False),
    *required_columns(JSON, "hands", "objects", "options", "revisions"),
    Column("cells", Integer, nullable=False),
    Column("created", String(32), nullable=False),
    *owner_columns(),
    Column("cancelled", Boolean, nullable=False),
    Column("events", Integer, nullable=False),
    Column("applied", Integer, nullable=False, default=0),
    Column("planned", Boolean, nullable=False, default=False),
    # Number of events at the last reported end; -1 before the first report.
    Column("told", Integer, nullable=False, server_default="-1"),
    Column("neighbours", String(300), nullable=False, server_default=""),
    Column("network_digest", String(32), nullable=False, server_default=""),
    Index("datasets_newest", "created", "name"),
)
dataset_cells: Final = Table(
    "dataset_cells",
    metadata,
    Column("dataset", String(64), primary_key=True),
    Column("position", Integer, primary_key=True),
    *required_columns(String(64), "hand", "object"),
    *required_columns(String(32), "hand_digest", "object_digest", "job_id"),
    Column("fidelity", String(64), nullable=True),
    Column("choice", JSON(none_as_null=True)),
    Index("dataset_cells_by_job", "job_id"),
)
dataset_snapshots: Final = Table(
    "dataset_snapshots",
    metadata,
    Column("dataset", String(64), primary_key=True),
    Column("digest", String(32), primary_key=True),
    Column("created", String(32), nullable=False),
    Column("complete", Boolean, nullable=False),
    *required_columns(Integer, "shards", "grasps", "valid"),
    Column("size_bytes", BigInteger, nullable=False),
)
object_sets: Final = Table(
    "object_sets",
    metadata,
    Column("name", String(64), primary_key=True),
    Column("digest", String(32), primary_key=True),
    Column("objects", JSON, nullable=False),
    Column("created", String(32), nullable=False),
    Column("project", String(32), nullable=False, server_default=""),
)
tags: Final = Table(
    "tags",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("name", String(64), nullable=False),
    *required_columns(String(32), "created", "changed"),
    *owner_columns(),
    Index("tags_by_name", "name", "project"),
)
#: Grasps of a tag. Some may be missing, because their shards were deleted with the last job that needed them.
tagged: Final = Table(
    "tagged",
    metadata,
    Column("tag", String(32), primary_key=True),
    Column("shard_id", String(32), primary_key=True),
    Column("row", Integer, primary_key=True),
    Index("tagged_grasps", "shard_id", "row"),
)
#: Ended jobs and datasets: current state, which the store does not contain.
ends: Final = Table(
    "ends",
    metadata,
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    Column("kind", String(8), nullable=False),
    Column("subject", String(64), nullable=False),
    Column("state", String(10), nullable=False),
    Column("at", String(32), nullable=False),
    Column("project", String(32), nullable=False, server_default=""),
    Column("owner", String(64), nullable=False, server_default=""),
    Index("ends_of_project", "project", "seq"),
)
webhooks: Final = Table(
    "webhooks",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("url", Text, nullable=False),
    Column("states", JSON, nullable=False),
    Column("created", String(32), nullable=False),
    *owner_columns(),
    # Current state: ends up to this number have deliveries.
    Column("seen", BigInteger, nullable=False, server_default="0"),
)
deliveries: Final = Table(
    "deliveries",
    metadata,
    Column("webhook", String(32), primary_key=True),
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    Column("state", String(10), nullable=False),
    Column("attempts", Integer, nullable=False),
    Column("due", Float, nullable=False),
    Column("tried", String(32)),
    Column("status", Integer),
    Column("detail", String(300), nullable=False, server_default=""),
    Index("deliveries_due", "state", "due"),
)
