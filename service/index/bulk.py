"""Bulk writes: PostgreSQL gets the rows as one JSON document, SQLite one by one, which is fast there."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

from sqlalchemy import Connection, Table, TextClause, bindparam, text, update
from sqlalchemy.dialects import sqlite

Row = Mapping[str, Any]
#: Rows per statement: some megabytes of text.
_ROWS: Final = 10_000


def upsert(connection: Connection, table: Table, rows: Sequence[Row], *, keep: Sequence[str] = ()) -> None:
    """Insert rows; for existing primary keys update all given columns except `keep`.

    All rows have the same columns. Of two rows with one key the last one counts.
    """
    if not rows:
        return
    if connection.dialect.name == "postgresql":
        statement = _upsert_postgresql(table, tuple(rows[0]), tuple(keep))
        keys = [column.name for column in table.primary_key]
        once = list({tuple(row[key] for key in keys): row for row in rows}.values())
        _in_parts(connection, statement, once)
        return
    keys = [column.name for column in table.primary_key]
    # One statement run for many rows: to build a statement with a thousand rows takes longer than to run it.
    insert: Any = sqlite.insert(table)
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
    if connection.dialect.name == "postgresql":
        _in_parts(connection, _update_postgresql(table, tuple(rows[0])), rows, state=state)
        return
    values: dict[str, Any] = {name: bindparam(f"new_{name}") for name in rows[0] if name != "id"}
    statement = update(table).where(table.c.id == bindparam("new_id"), table.c.state == state).values(**values)
    connection.execute(statement, [{f"new_{name}": value for name, value in row.items()} for row in rows])


def _in_parts(connection: Connection, statement: TextClause, rows: Sequence[Row], **given: str) -> None:
    for start in range(0, len(rows), _ROWS):
        connection.execute(statement, {"rows": json.dumps([*rows[start : start + _ROWS]]), **given})


# The names come from our own tables, never from a request.
@lru_cache
def _upsert_postgresql(table: Table, names: tuple[str, ...], keep: tuple[str, ...]) -> TextClause:
    keys = [column.name for column in table.primary_key]
    columns = ", ".join(map(_quoted, names))
    changed = [f"{_quoted(n)} = excluded.{_quoted(n)}" for n in names if n not in keys and n not in keep]
    action = f"UPDATE SET {', '.join(changed)}" if changed else "NOTHING"
    return text(
        f"INSERT INTO {_quoted(table.name)} ({columns}) SELECT {columns} FROM {_given(table)} "
        f"ON CONFLICT ({', '.join(map(_quoted, keys))}) DO {action}"
    )


@lru_cache
def _update_postgresql(table: Table, names: tuple[str, ...]) -> TextClause:
    name = _quoted(table.name)
    changed = ", ".join(f"{_quoted(n)} = given.{_quoted(n)}" for n in names if n != "id")
    return text(
        f"UPDATE {name} SET {changed} FROM {_given(table)} WHERE {name}.id = given.id AND {name}.state = :state"
    )


def _given(table: Table) -> str:
    """Return the document as rows of the table's own type, which checks each value."""
    return f"json_populate_recordset(NULL::{_quoted(table.name)}, CAST(:rows AS json)) AS given"


def _quoted(name: str) -> str:
    return f'"{name}"'
