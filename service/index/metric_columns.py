"""Columns and indexes of the metrics in the table of grasps: those that the schema lacks are added when it is opened.

So a new metric needs no other revision. Grasps whose shards lack it hold NULL. A column whose metric is gone stays.
"""

from __future__ import annotations

from sqlalchemy import Connection, inspect

from service.index.tables import grasps
from service.model.metrics import indexed


def add_missing(connection: Connection) -> list[str]:
    """Add what is missing, within the caller's transaction; the names of the columns added."""
    found = inspect(connection)
    there = {column["name"] for column in found.get_columns(grasps.name)}
    missing = [metric.name for metric in indexed() if metric.name not in there]
    for name in missing:
        kind = grasps.c[name].type.compile(connection.dialect)
        connection.exec_driver_sql(f"ALTER TABLE {grasps.name} ADD COLUMN {name} {kind}")
    made = {index["name"] for index in found.get_indexes(grasps.name)}
    for index in grasps.indexes:
        if index.name not in made:
            index.create(connection)
    return missing
