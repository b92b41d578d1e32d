"""Who sees which rows: conditions of queries."""

from __future__ import annotations

from typing import Any

from sqlalchemy import ColumnElement, Select, case, exists, or_, select

from service.index.tables import assets, attempts, datasets, jobs, object_sets, tags, tasks
from service.model.projects import Reach

Tests = tuple[ColumnElement[bool], ...]


def seen_jobs(reach: Reach) -> Tests:
    """Of jobs, or of what is joined to them."""
    return () if reach.everything else (jobs.c.project == reach.project,)


def seen_datasets(reach: Reach) -> Tests:
    return () if reach.everything else (datasets.c.project == reach.project,)


def seen_sets(reach: Reach) -> Tests:
    """Of sets of objects."""
    return () if reach.everything else (object_sets.c.project == reach.project,)


def seen_tags(reach: Reach) -> Tests:
    return () if reach.everything else (tags.c.project == reach.project,)


def seen_assets(reach: Reach) -> Tests:
    """Of hands and objects: their own, what comes with graspd, and what its project shares."""
    if reach.everything:
        return ()
    return (or_(assets.c.project == reach.project, assets.c.builtin.is_(True), assets.c.shared.is_(True)),)


def nearest_asset(reach: Reach) -> ColumnElement[int]:
    """Order of hands and objects of one name: the project's own come first, then what is shared."""
    shared = or_(assets.c.builtin.is_(True), assets.c.shared.is_(True))
    return case((assets.c.project == reach.project, 0), (shared, 1), else_=2)


def seen_tasks(reach: Reach) -> Tests:
    return () if reach.everything else (tasks.c.job_id.in_(jobs_of(reach)),)


def seen_attempts(reach: Reach) -> Tests:
    """Of failed attempts."""
    return () if reach.everything else (attempts.c.job_id.in_(jobs_of(reach)),)


def seen_shards(reach: Reach, shard: ColumnElement[Any]) -> Tests:
    """Of shards by a column that holds their id: those that a job of the project makes or has found made."""
    if reach.everything:
        return ()
    wanted = (tasks.c.shard_id == shard, tasks.c.job_id == jobs.c.id, jobs.c.project == reach.project)
    return (exists().where(*wanted),)


def jobs_of(reach: Reach) -> Select[tuple[str]]:
    """Ids of the project's jobs."""
    return select(jobs.c.id).where(jobs.c.project == reach.project)
