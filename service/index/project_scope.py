"""Common parts of queries: conditions of the caller's scope, and opaque keyset cursors of pages."""

from __future__ import annotations

import base64
import json
from typing import Any, Final

from pydantic_core import from_json
from sqlalchemy import ColumnElement, Select, case, exists, or_, select

from graspd.service.index.tables import assets, attempts, datasets, jobs, object_sets, tags, tasks
from graspd.service.model.errors import InputError
from graspd.service.model.projects import ProjectScope

Tests = tuple[ColumnElement[bool], ...]


def seen_jobs(scope: ProjectScope) -> Tests:
    """Return the conditions on jobs, or on tables joined to them."""
    return () if scope.everything else (jobs.c.project == scope.project,)


def seen_datasets(scope: ProjectScope) -> Tests:
    return () if scope.everything else (datasets.c.project == scope.project,)


def seen_sets(scope: ProjectScope) -> Tests:
    """Return the conditions on sets of objects."""
    return () if scope.everything else (object_sets.c.project == scope.project,)


def seen_tags(scope: ProjectScope) -> Tests:
    return () if scope.everything else (tags.c.project == scope.project,)


def seen_assets(scope: ProjectScope) -> Tests:
    """Return the conditions on hands and objects: the project's own, built-in and shared ones."""
    if scope.everything:
        return ()
    return (or_(assets.c.project == scope.project, assets.c.builtin.is_(True), assets.c.shared.is_(True)),)


def nearest_asset(scope: ProjectScope) -> ColumnElement[int]:
    """Return the order of assets of one name: the project's own come first, then shared ones."""
    shared = or_(assets.c.builtin.is_(True), assets.c.shared.is_(True))
    return case((assets.c.project == scope.project, 0), (shared, 1), else_=2)


def seen_tasks(scope: ProjectScope) -> Tests:
    return () if scope.everything else (tasks.c.job_id.in_(jobs_of(scope)),)


def seen_attempts(scope: ProjectScope) -> Tests:
    """Return the conditions on failed attempts."""
    return () if scope.everything else (attempts.c.job_id.in_(jobs_of(scope)),)


def seen_shards(scope: ProjectScope, shard: ColumnElement[Any]) -> Tests:
    """Return the conditions on shard ids: those that a job of the project makes or reuses."""
    if scope.everything:
        return ()
    wanted = (tasks.c.shard_id == shard, tasks.c.job_id == jobs.c.id, jobs.c.project == scope.project)
    return (exists().where(*wanted),)


def jobs_of(scope: ProjectScope) -> Select[tuple[str]]:
    """Return the ids of the project's jobs."""
    return select(jobs.c.id).where(jobs.c.project == scope.project)


MAX_LIMIT: Final = 200
#: Upper bound of whole numbers in all databases.
_MOST: Final = 2**63


def encode(*key: Any) -> str:
    """Encode a sort key as text, safe in a URL."""
    return base64.urlsafe_b64encode(json.dumps(key, separators=(",", ":")).encode()).decode().rstrip("=")


def decode(cursor: str, *kinds: type | tuple[type, ...]) -> tuple[Any, ...]:
    """Decode the sort key of a cursor and check its types; InputError for an invalid cursor."""
    try:
        key = from_json(base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)), allow_inf_nan=False)
    except ValueError:
        raise InputError("the cursor is not one that this list gave out; start without it") from None
    if not isinstance(key, list) or len(key) != len(kinds) or not all(map(isinstance, key, kinds)):
        raise InputError("the cursor belongs to another list or another order; start without it")
    if any(isinstance(part, int) and not -_MOST <= part < _MOST for part in key):
        raise InputError("the cursor is not one that this list gave out; start without it")
    return tuple(key)


def page_size(limit: int) -> int:
    """Return a limit between 1 and `MAX_LIMIT`."""
    if limit < 1:
        raise InputError("the limit must be at least 1")
    return min(limit, MAX_LIMIT)
