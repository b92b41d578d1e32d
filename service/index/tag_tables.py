"""Tables of tags: names that users give to grasps."""

from __future__ import annotations

from typing import Final

from sqlalchemy import Column, Index, Integer, String, Table

from service.index.tables import metadata

tags: Final = Table(
    "tags",
    metadata,
    Column("id", String(32), primary_key=True),
    Column("name", String(64), nullable=False),
    Column("created", String(32), nullable=False),
    Column("changed", String(32), nullable=False),
    Column("owner", String(64), nullable=False, server_default=""),
    Column("project", String(32), nullable=False, server_default=""),
    Index("tags_by_name", "name", "project"),
)

#: Grasps that a tag names. Some may be gone: their shards left with the last job that needed them.
tagged: Final = Table(
    "tagged",
    metadata,
    Column("tag", String(32), primary_key=True),
    Column("shard_id", String(32), primary_key=True),
    Column("row", Integer, primary_key=True),
    Index("tagged_grasps", "shard_id", "row"),
)
