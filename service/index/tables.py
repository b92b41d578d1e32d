"""Tables of the index, derived from the store except for `LIVE_COLUMNS` and `LIVE_TABLES`.

Each change needs another `REVISION` in `database`, except for new metrics of grasps; a test enforces this.
"""

from typing import Any, Final

from sqlalchemy import JSON, BigInteger, Boolean, Column, Float, Index, Integer, MetaData, String, Table, Text, false

from graspd.service.model.metrics import IndexLevel, indexed_metrics

metadata: Final = MetaData()


def make_table(name: str, *parts: Column[Any] | Index, **options: Any) -> Table:
    return Table(name, metadata, *parts, **options)


def make_columns(types: dict[str, Any], **options: Any) -> list[Column[Any]]:
    return [Column(name, kind, **options) for name, kind in types.items()]


def key_columns(**types: Any) -> list[Column[Any]]:
    return make_columns(types, primary_key=True)


def required_columns(default: str | None = None, **types: Any) -> list[Column[Any]]:
    """Return columns without NULL; `default` is their value in SQL for rows that lack them."""
    return make_columns(types, nullable=False, server_default=default)


def optional_columns(**types: Any) -> list[Column[Any]]:
    return make_columns(types)


def owner_columns() -> list[Column[Any]]:
    return required_columns("", owner=String(64), project=String(32))


jobs: Final = make_table(
    "jobs",
    *key_columns(id=String(32)),
    *required_columns(state=String(10), priority=String(12), hand=String(64), object=String(64)),
    *required_columns(hand_digest=String(32), object_digest=String(32), request=JSON),
    Column("revisions", JSON, nullable=False, server_default='{"synthesize": 1, "scene": 1, "render": 1}'),
    *optional_columns(origin=JSON(none_as_null=True)),
    *owner_columns(),
    # `span` is the number of batches per task.
    *required_columns(cancelled=Boolean, span=Integer, created=String(32)),
    *optional_columns(finished=String(32), reason=Text),
    # Digests of the neighbours, separated by spaces; a list would need a table.
    *required_columns("", neighbours=String(300)),
    *optional_columns(choice=JSON(none_as_null=True)),
    *required_columns("", network_digest=String(32)),
    Index("jobs_beside", "neighbours"),
    Index("jobs_newest", "created", "id"),
    Index("jobs_by_state", "state", "created", "id"),
    Index("jobs_by_pair", "hand", "object"),
    Index("jobs_of_project", "project", "created", "id"),
)
tasks: Final = make_table(
    "tasks",
    *key_columns(id=String(32)),
    *required_columns(job_id=String(32), stage=String(12), batch=Integer, position=Integer, count=Integer),
    *required_columns(priority=String(12), inputs=JSON, shard_id=String(32), state=String(10), ready=Boolean),
    *required_columns(done=Boolean, last_attempt=Integer, exhausted=Boolean, retried_upto=Integer),
    *optional_columns(reason=Text, worker=String(128), device=String(64), seconds=Float, finished=String(32)),
    *required_columns(created=String(32)),
    Column("queued", Boolean, nullable=False, default=False),
    Column("not_before", Float, nullable=False, default=0.0),
    Column("progress_done", Float, nullable=False, default=0.0),
    Column("progress_total", Float, nullable=False, default=0.0),
    *optional_columns(progress_message=Text),
    Index("tasks_of_job", "job_id", "batch", "position"),
    Index("tasks_by_state", "job_id", "state"),
    Index("tasks_by_shard", "shard_id"),
    Index("tasks_waiting", "job_id", "ready", "queued", "batch"),
    Index("tasks_in_queue", "queued", "ready"),
    Index("tasks_finished", "finished"),
)
attempts: Final = make_table(
    "attempts",
    *key_columns(task_id=String(32), number=Integer),
    *required_columns(job_id=String(32), stage=String(12), kind=String(64), reason=Text),
    *optional_columns(trace=Text),
    *required_columns(worker=String(128)),
    *optional_columns(started=String(32)),
    *required_columns(ended=String(32), last=Boolean),
    Index("attempts_of_job", "job_id", "ended"),
    Index("attempts_by_kind", "stage", "kind"),
)
shards: Final = make_table(
    "shards",
    *key_columns(id=String(32)),
    *required_columns(kind=String(8), stage=String(12), key=String(128), sha256=String(64)),
    *required_columns(size_bytes=BigInteger, count=Integer, valid=Integer),
    *required_columns("0", candidates=Integer, rechecked=Integer, recheck_held=Integer, validated=Integer),
    *required_columns(hand=String(64), object=String(64), hand_digest=String(32), object_digest=String(32)),
    *required_columns(batch=Integer),
    *required_columns("1", batches=Integer),
    *required_columns(seed=Integer, inputs=JSON, device=String(64), worker=String(128), seconds=Float),
    *required_columns(created=String(32), manifest=JSON),
    *required_columns("", charged=String(32)),
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
grasps: Final = make_table(
    "grasps",
    *key_columns(shard_id=String(32), row=Integer),
    *required_columns(hand=String(64), object=String(64)),
    *(Column(metric.name, Integer if metric.whole else Float) for metric in indexed_metrics()),
    *required_columns(valid=Boolean),
    *optional_columns(success=Boolean, verdict_level=String(12)),
    *required_columns("free", scene_kind=String(8)),
    *required_columns("0", neighbours=Integer),
    *optional_columns(lift_hard=Boolean, robust_weakest=String(16)),
    *required_columns(created=String(32)),
    *(Index(f"grasps_{name}", name, "shard_id", "row") for name in (*METRICS, "created")),
    Index("grasps_by_pair", "hand", "object", "epsilon", "shard_id", "row"),
    Index("grasps_by_hand", "hand", "epsilon", "shard_id", "row"),
    Index("grasps_by_object", "object", "epsilon", "shard_id", "row"),
    sqlite_with_rowid=False,
)
assets: Final = make_table(
    "assets",
    *key_columns(kind=String(8), digest=String(32)),
    *required_columns(name=String(64), filename=Text, files=JSON, size_bytes=Integer, created=String(32)),
    *required_columns(builtin=Boolean),
    *owner_columns(),
    Column("shared", Boolean, nullable=False, server_default=false()),
    *optional_columns(verdict=String(8), message=Text),
    *required_columns(repairs=JSON, facts=JSON, last_attempt=Integer),
    Column("queued", Boolean, nullable=False, default=False),
    Column("not_before", Float, nullable=False, default=0.0),
    Index("assets_by_name", "kind", "name", "created"),
)
workers: Final = make_table(
    "workers",
    *key_columns(name=String(128)),
    *required_columns(host=String(128), pid=Integer, device=String(64), device_name=String(128), stages=JSON),
    *required_columns(version=String(32), state=String(16)),
    *optional_columns(task_id=String(32)),
    *required_columns(started=String(32), seen=String(32)),
    *required_columns("", reason=String(300)),
)
#: Costs of deleted shards by project, day and device, because deleted results count as usage.
spent: Final = make_table(
    "spent",
    *key_columns(project=String(32), day=String(10), device=String(64)),
    *required_columns(grasps=BigInteger, valid=BigInteger, tasks=BigInteger, seconds=Float),
)
notes: Final = make_table("notes", *key_columns(name=String(64)), *required_columns(value=JSON))
damage: Final = make_table(
    "damage", *key_columns(key=String(512)), *required_columns(what=Text, shard=String(64), found=String(32))
)
_PROGRESS: Final = ("progress_done", "progress_total", "progress_message")
#: Columns and tables of current state, which the store does not contain; a rebuild keeps the tables.
LIVE_COLUMNS: Final = frozenset({"queued", "not_before", "applied", "planned", "charged", "told", "seen", *_PROGRESS})
LIVE_TABLES: Final = frozenset({"workers", "notes", "damage", "spent", "ends", "deliveries"})
datasets: Final = make_table(
    "datasets",
    *key_columns(name=String(64)),
    *required_columns(digest=String(32), hands=JSON, objects=JSON, options=JSON, revisions=JSON, cells=Integer),
    *required_columns(created=String(32)),
    *owner_columns(),
    *required_columns(cancelled=Boolean, events=Integer),
    Column("applied", Integer, nullable=False, default=0),
    Column("planned", Boolean, nullable=False, default=False),
    # Number of events at the last reported end; -1 before the first report.
    *required_columns("-1", told=Integer),
    *required_columns("", neighbours=String(300), network_digest=String(32)),
    Index("datasets_newest", "created", "name"),
)
dataset_cells: Final = make_table(
    "dataset_cells",
    *key_columns(dataset=String(64), position=Integer),
    *required_columns(hand=String(64), object=String(64), hand_digest=String(32), object_digest=String(32)),
    *required_columns(job_id=String(32)),
    *optional_columns(fidelity=String(64), choice=JSON(none_as_null=True)),
    Index("dataset_cells_by_job", "job_id"),
)
dataset_snapshots: Final = make_table(
    "dataset_snapshots",
    *key_columns(dataset=String(64), digest=String(32)),
    *required_columns(created=String(32), complete=Boolean, shards=Integer, grasps=Integer, valid=Integer),
    *required_columns(size_bytes=BigInteger),
)
object_sets: Final = make_table(
    "object_sets",
    *key_columns(name=String(64), digest=String(32)),
    *required_columns(objects=JSON, created=String(32)),
    *required_columns("", project=String(32)),
)
tags: Final = make_table(
    "tags",
    *key_columns(id=String(32)),
    *required_columns(name=String(64), created=String(32), changed=String(32)),
    *owner_columns(),
    Index("tags_by_name", "name", "project"),
)
#: Grasps of a tag. Some may be missing, because their shards were deleted with the last job that needed them.
tagged: Final = make_table(
    "tagged", *key_columns(tag=String(32), shard_id=String(32), row=Integer), Index("tagged_grasps", "shard_id", "row")
)
#: Ended jobs and datasets: current state, which the store does not contain.
ends: Final = make_table(
    "ends",
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    *required_columns(kind=String(8), subject=String(64), state=String(10), at=String(32)),
    *required_columns("", project=String(32), owner=String(64)),
    Index("ends_of_project", "project", "seq"),
)
webhooks: Final = make_table(
    "webhooks",
    *key_columns(id=String(32)),
    *required_columns(url=Text, states=JSON, created=String(32)),
    *owner_columns(),
    # Deliveries exist for ends up to this number.
    *required_columns("0", seen=BigInteger),
)
deliveries: Final = make_table(
    "deliveries",
    *key_columns(webhook=String(32)),
    Column("seq", BigInteger, primary_key=True, autoincrement=False),
    *required_columns(state=String(10), attempts=Integer, due=Float),
    *optional_columns(tried=String(32), status=Integer),
    *required_columns("", detail=String(300)),
    Index("deliveries_due", "state", "due"),
)
