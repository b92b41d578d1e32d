"""Columns and indexes of the metrics in the table of grasps: those that the schema lacks are added when it is opened.

So a new metric needs no migration. Grasps whose shards lack it hold NULL. A column whose metric is no longer in the
table stays and is not read; so an older graspd, which names the columns it writes, goes on with a newer index.
"""

from __future__ import annotations

from alembic.migration import MigrationContext
from alembic.operations import Operations
from sqlalchemy import Column, Connection, inspect

from service.index.tables import METRICS, grasps
from service.model.metrics import indexed


def add_missing(connection: Connection) -> list[str]:
    """Add what is missing, within the caller's transaction; the names of the columns added."""
    found = inspect(connection)
    there = {column["name"] for column in found.get_columns(grasps.name)}
    missing = [metric.name for metric in indexed() if metric.name not in there]
    operations = Operations(MigrationContext.configure(connection))
    for name in missing:
        operations.add_column(grasps.name, Column(name, grasps.c[name].type, nullable=True))
    made = {index["name"] for index in found.get_indexes(grasps.name)}
    for name in METRICS:
        if f"grasps_{name}" not in made:
            operations.create_index(f"grasps_{name}", grasps.name, [name, "shard_id", "row"])
    return missing
