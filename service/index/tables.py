"""Tables of the index, derived from the store except for `LIVE_COLUMNS` and `LIVE_TABLES`.

Each change needs another `REVISION` in `database`, except for new metrics of grasps; a test enforces this.
"""

from typing import Any, Final

from sqlalchemy import JSON, BigInteger, Boolean, Column, Float, Index, Integer, MetaData, String, Table, Text, false
from sqlalchemy.types import TypeEngine

from graspd.service.model.metrics import IndexLevel, indexed_metrics

metadata: Final = MetaData()


def required_columns(**types: TypeEngine[Any] | type[TypeEngine[Any]]) -> list[Column[Any]]:
    return [Column(name, kind, nullable=False) for name, kind in types.items()]


def owner_columns() -> list[Column[Any]]:
    widths = {"owner": 64, "project": 32}
    return [Column(name, String(width), nullable=False, server_default="") for name, width in widths.items()]


jobs: Final = Table(
    "jobs",
    metadata,
    Column("id", String(32), primary_key=True),
    *required_columns(state=String(10), priority=String(12), hand=String(64), object=String(64)),
    *required_columns(hand_digest=String(32), object_digest=String(32), request=JSON),
    Column("revisions", JSON, nullable=False, server_default='{"synthesize": 1, "scene": 1, "render": 1}'),
    Column("origin", JSON(none_as_null=True)),
    *owner_columns(),
    Column("cancelled", Boolean, nullable=False),
    # `span` is the number of batches per task.
    *required_columns(span=Integer, created=String(32)),
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
    *required_columns(job_id=String(32), stage=String(12), batch=Integer, position=Integer, count=Integer),
    *required_columns(priority=String(12), inputs=JSON, shard_id=String(32), state=String(10), ready=Boolean),
    *required_columns(done=Boolean, last_attempt=Integer, exhausted=Boolean, retried_upto=Integer),
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
    *required_columns(job_id=String(32), stage=String(12), kind=String(64), reason=Text),
    Column("trace", Text),
    Column("worker", String(128), nullable=False),
    Column("started", String(32)),
    *required_columns(ended=String(32), last=Boolean),
    Index("attempts_of_job", "job_id", "ended"),
    Index("attempts_by_kind", "stage", "kind"),
)
shards: Final = Table(
    "shards",
    metadata,
    Column("id", String(32), primary_key=True),
    *required_columns(kind=String(8), stage=String(12), key=String(128), sha256=String(64)),
    *required_columns(size_bytes=BigInteger, count=Integer, valid=Integer),
    Column("candidates", Integer, nullable=False, server_default="0"),
    Column("rechecked", Integer, nullable=False, server_default="0"),
    Column("recheck_held", Integer, nullable=False, server_default="0"),
    Column("validated", Integer, nullable=False, server_default="0"),
    *required_columns(hand=String(64), object=String(64), hand_digest=String(32), object_digest=String(32)),
    Column("batch", Integer, nullable=False),
    Column("batches", Integer, nullable=False, server_default="1"),
    *required_columns(seed=Integer, inputs=JSON, device=String(64), worker=String(128), seconds=Float),
    *required_columns(created=String(32), manifest=JSON),
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
    *required_columns(hand=String(64), object=String(64)),
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
    *required_columns(name=String(64), filename=Text, files=JSON, size_bytes=Integer, created=String(32)),
    Column("builtin", Boolean, nullable=False),
    *owner_columns(),
    Column("shared", Boolean, nullable=False, server_default=false()),
    Column("verdict", String(8)),
    Column("message", Text),
    *required_columns(repairs=JSON, facts=JSON, last_attempt=Integer),
    Column("queued", Boolean, nullable=False, default=False),
    Column("not_before", Float, nullable=False, default=0.0),
    Index("assets_by_name", "kind", "name", "created"),
)
workers: Final = Table(
    "workers",
    metadata,
    Column("name", String(128), primary_key=True),
    *required_columns(host=String(128), pid=Integer, device=String(64), device_name=String(128), stages=JSON),
    *required_columns(version=String(32), state=String(16)),
    Column("task_id", String(32)),
    *required_columns(started=String(32), seen=String(32)),
    Column("reason", String(300), nullable=False, server_default=""),
)
#: Costs of deleted shards by project, day and device, because deleted results count as usage.
spent: Final = Table(
    "spent",
    metadata,
    Column("project", String(32), primary_key=True),
    Column("day", String(10), primary_key=True),
    Column("device", String(64), primary_key=True),
    *required_columns(grasps=BigInteger, valid=BigInteger, tasks=BigInteger, seconds=Float),
)
notes: Final = Table(
    "notes", metadata, Column("name", String(64), primary_key=True), Column("value", JSON, nullable=False)
)
damage: Final = Table(
    "damage",
    metadata,
    Column("key", String(512), primary_key=True),
    *required_columns(what=Text, shard=String(64), found=String(32)),
)
_PROGRESS: Final = ("progress_done", "progress_total", "progress_message")
#: Columns and tables of current state, which the store does not contain; a rebuild keeps the tables.
LIVE_COLUMNS: Final = frozenset({"queued", "not_before", "applied", "planned", "charged", "told", "seen", *_PROGRESS})
LIVE_TABLES: Final = frozenset({"workers", "notes", "damage", "spent", "ends", "deliveries"})
datasets: Final = Table(
    "datasets",
    metadata,
    Column("name", String(64), primary_key=True),
    *required_columns(digest=String(32), hands=JSON, objects=JSON, options=JSON, revisions=JSON, cells=Integer),
    Column("created", String(32), nullable=False),
    *owner_columns(),
    *required_columns(cancelled=Boolean, events=Integer),
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
    *required_columns(hand=String(64), object=String(64), hand_digest=String(32), object_digest=String(32)),
    Column("job_id", String(32), nullable=False),
    Column("fidelity", String(64), nullable=True),
    Column("choice", JSON(none_as_null=True)),
    Index("dataset_cells_by_job", "job_id"),
)
dataset_snapshots: Final = Table(
    "dataset_snapshots",
    metadata,
    Column("dataset", String(64), primary_key=True),
    Column("digest", String(32), primary_key=True),
    *required_columns(created=String(32), complete=Boolean, shards=Integer, grasps=Integer, valid=Integer),
    Column("size_bytes", BigInteger, nullable=False),
)
object_sets: Final = Table(
    "object_sets",
    metadata,
    Column("name", String(64), primary_key=True),
    Column("digest", String(32), primary_key=True),
    *required_columns(objects=JSON, created=String(32)),
    Column("project", String(32), nullable=False, server_default=""),
)
tags: Final = Table(
    "tags",
    metadata,
    Column("id", String(32), primary_key=True),
    *required_columns(name=String(64), created=String(32), changed=String(32)),
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
    *required_columns(kind=String(8), subject=String(64), state=String(10), at=String(32)),
    Column("project", String(32), nullable=False, server_default=""),
    Column("owner", String(64), nullable=False, server_default=""),
    Index("ends_of_project", "project", "seq"),
)
webhooks: Final = Table(
    "webhooks",
    metadata,
    Column("id", String(32), primary_key=True),
    *required_columns(url=Text, states=JSON, created=String(32)),
    *owner_columns(),
    # Deliveries exist for ends up to this number.
    Column("seen", BigInteger, nullable=False, server_default="0"),
)
deliveries: Final = Table(
    "deliveries",
    metadata,
    Column("webhook", String(32), primary_key=True),
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    *required_columns(state=String(10), attempts=Integer, due=Float),
    Column("tried", String(32)),
    Column("status", Integer),
    Column("detail", String(300), nullable=False, server_default=""),
    Index("deliveries_due", "state", "due"),
)
