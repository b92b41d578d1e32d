"""Tables of datasets and of named sets of objects. `applied` and `planned` say how far the planner is."""

from __future__ import annotations

from typing import Final

from sqlalchemy import JSON, BigInteger, Boolean, Column, Index, Integer, String, Table

from service.index.tables import metadata

datasets: Final = Table(
    "datasets",
    metadata,
    Column("name", String(64), primary_key=True),
    Column("digest", String(32), nullable=False),
    Column("hands", JSON, nullable=False),
    Column("objects", JSON, nullable=False),
    Column("options", JSON, nullable=False),
    Column("revisions", JSON, nullable=False),
    Column("cells", Integer, nullable=False),
    Column("created", String(32), nullable=False),
    Column("owner", String(64), nullable=False, server_default=""),
    Column("project", String(32), nullable=False, server_default=""),
    Column("cancelled", Boolean, nullable=False),
    Column("events", Integer, nullable=False),
    Column("applied", Integer, nullable=False, default=0),
    Column("planned", Boolean, nullable=False, default=False),
    # Number of events for which its end was told; -1: it was not.
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
    Column("hand", String(64), nullable=False),
    Column("object", String(64), nullable=False),
    Column("hand_digest", String(32), nullable=False),
    Column("object_digest", String(32), nullable=False),
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
    Column("created", String(32), nullable=False),
    Column("complete", Boolean, nullable=False),
    Column("shards", Integer, nullable=False),
    Column("grasps", Integer, nullable=False),
    Column("valid", Integer, nullable=False),
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
