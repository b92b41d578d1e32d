"""What the index says at the moment of a scrape. Each read has a bound that does not grow with the index."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

from sqlalchemy import Select, func, select

from service.index.database import Database
from service.index.tables import damage, jobs, shards
from service.model.clock import age_of
from service.model.states import State

#: Unfinished jobs are counted up to here.
MOST_JOBS: Final = 10_000
RATE_WINDOW_S: Final = 60
UNFINISHED: Final = (State.QUEUED, State.RUNNING)


@dataclass(frozen=True)
class IndexNow:
    """Unfinished jobs, and what was made in the last minute."""

    jobs: Mapping[State, int]
    oldest_s: Mapping[State, float]
    grasps_per_s: float
    valid_per_s: float
    damaged: int
    """Objects of the store that are known to be damaged or missing, counted up to `MOST_JOBS`."""


def read_index(database: Database) -> IndexNow:
    """Unfinished jobs up to `MOST_JOBS`, the oldest of each state, and the shards of the last minute."""
    since = datetime.now(UTC) - timedelta(seconds=RATE_WINDOW_S)
    counted, oldest = {}, {}
    with database.reading() as connection:
        for state in UNFINISHED:
            counted[state] = int(connection.scalar(count_jobs(state)) or 0)
            first = connection.scalar(oldest_job(state))
            oldest[state] = (first and age_of(first)) or 0.0
        damaged = int(connection.scalar(count_damage()) or 0)
        made, valid = connection.execute(made_since(since)).one()
    return IndexNow(counted, oldest, int(made or 0) / RATE_WINDOW_S, int(valid or 0) / RATE_WINDOW_S, damaged)


def count_jobs(state: State) -> Select[Any]:
    """Number of jobs in a state, up to `MOST_JOBS`."""
    some = select(jobs.c.id).where(jobs.c.state == state.value).limit(MOST_JOBS).subquery()
    return select(func.count()).select_from(some)


def count_damage() -> Select[Any]:
    """Number of damaged objects, up to `MOST_JOBS`."""
    return select(func.count()).select_from(select(damage.c.key).limit(MOST_JOBS).subquery())


def oldest_job(state: State) -> Select[Any]:
    """When the oldest job in a state was submitted."""
    return select(jobs.c.created).where(jobs.c.state == state.value).order_by(jobs.c.created).limit(1)


def made_since(when: datetime) -> Select[Any]:
    """Grasps and valid grasps of the base shards made since."""
    text = when.isoformat(timespec="milliseconds").replace("+00:00", "Z")
    base = (shards.c.kind == "base", shards.c.created >= text)
    return select(func.sum(shards.c.count), func.sum(shards.c.valid)).where(*base)
