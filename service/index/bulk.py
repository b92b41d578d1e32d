"""Writes of many rows: one statement run for each row, which is faster to build than one with all of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import Connection, Table, bindparam, update
from sqlalchemy.dialects import postgresql, sqlite

Row = Mapping[str, Any]


def upsert(connection: Connection, table: Table, rows: Sequence[Row], *, keep: Sequence[str] = ()) -> None:
    """Insert rows; for existing primary keys update all given columns except `keep`.

    All rows have the same columns. Of two rows with one key the last one counts.
    """
    if not rows:
        return
    keys = [column.name for column in table.primary_key]
    insert: Any = (postgresql if connection.dialect.name == "postgresql" else sqlite).insert(table)
    changed = {name: insert.excluded[name] for name in rows[0] if name not in keys and name not in keep}
    if changed:
        statement = insert.on_conflict_do_update(index_elements=keys, set_=changed)
    else:
        statement = insert.on_conflict_do_nothing(index_elements=keys)
    connection.execute(statement, list(rows))


def update_rows(connection: Connection, table: Table, rows: Sequence[Row], *, state: str) -> None:
    """Update rows by `id`, if their column `state` still has that value."""
    if not rows:
        return
    values: dict[str, Any] = {name: bindparam(f"new_{name}") for name in rows[0] if name != "id"}
    statement = update(table).where(table.c.id == bindparam("new_id"), table.c.state == state).values(**values)
    connection.execute(statement, [{f"new_{name}": value for name, value in row.items()} for row in rows])
