"""Common parts of queries: conditions of the caller's scope, and pages with opaque keyset cursors."""

from __future__ import annotations

import base64
import json
from collections.abc import Sequence
from typing import Any, Final

from pydantic_core import from_json
from sqlalchemy import Column, ColumnElement, Connection, RowMapping, Select, Table, case, exists, or_, select, tuple_

from graspd.service.index.tables import assets, jobs, tasks
from graspd.service.model.errors import InputError
from graspd.service.model.projects import ProjectScope

Tests = tuple[ColumnElement[bool], ...]


def in_scope(scope: ProjectScope, table: Table) -> Tests:
    """Return the scope's conditions on a table that has a column `project`."""
    return () if scope.everything else (table.c.project == scope.project,)


def in_scope_by_job(scope: ProjectScope, table: Table) -> Tests:
    """Return the scope's conditions on a table that has a column `job_id`."""
    of_project = select(jobs.c.id).where(jobs.c.project == scope.project)
    return () if scope.everything else (table.c.job_id.in_(of_project),)


def assets_in_scope(scope: ProjectScope) -> Tests:
    """Return the scope's conditions on hands and objects: own, built-in and shared ones."""
    if scope.everything:
        return ()
    return (or_(assets.c.project == scope.project, assets.c.builtin.is_(True), assets.c.shared.is_(True)),)


def nearest_asset(scope: ProjectScope) -> ColumnElement[int]:
    """Return the sort key of assets of one name: own ones first, then shared ones."""
    shared = or_(assets.c.builtin.is_(True), assets.c.shared.is_(True))
    return case((assets.c.project == scope.project, 0), (shared, 1), else_=2)


def shards_in_scope(scope: ProjectScope, shard: ColumnElement[Any]) -> Tests:
    """Return the conditions that a job of the scope's project makes or reuses a shard."""
    wanted = (tasks.c.shard_id == shard, tasks.c.job_id == jobs.c.id, jobs.c.project == scope.project)
    return () if scope.everything else (exists().where(*wanted),)


MAX_LIMIT: Final = 200
#: Upper bound of integers in all databases.
_MOST: Final = 2**63


def page_rows(
    connection: Connection,
    query: Select[Any],
    *key: Column[Any],
    limit: int,
    cursor: str | None,
    descending: bool = True,
) -> tuple[Sequence[RowMapping], str | None]:
    """Return the rows of a page in the order of a key, and the next page's cursor; InputError as in `decode`."""
    size = page_size(limit)
    if cursor is not None:
        start = decode(cursor, *(part.type.python_type for part in key))
        query = query.where(tuple_(*key) < start if descending else tuple_(*key) > start)
    query = query.order_by(*(part.desc() if descending else part for part in key)).limit(size + 1)
    rows = connection.execute(query).mappings().all()
    return rows[:size], encode(*(rows[size - 1][part.key] for part in key)) if len(rows) > size else None


def encode(*key: Any) -> str:
    return base64.urlsafe_b64encode(json.dumps(key, separators=(",", ":")).encode()).decode().rstrip("=")


def decode(cursor: str, *kinds: type | tuple[type, ...]) -> tuple[Any, ...]:
    """Decode the sort key of a cursor and check its types; InputError for an invalid cursor."""
    try:
        key = from_json(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)), allow_inf_nan=False)
    except ValueError:
        raise InputError("the cursor is not from this list; start without it") from None
    if not isinstance(key, list) or len(key) != len(kinds) or not all(map(isinstance, key, kinds)):
        raise InputError("the cursor belongs to another list or another order; start without it")
    if any(isinstance(part, int) and not -_MOST <= part < _MOST for part in key):
        raise InputError("the cursor is not from this list; start without it")
    return tuple(key)


def page_size(limit: int) -> int:
    return min(limit, MAX_LIMIT)
