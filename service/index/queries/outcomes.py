"""What became of the candidates of jobs, from the manifests of their shards."""

from __future__ import annotations

from typing import Final

from sqlalchemy import ColumnElement, Connection, select

from service.index.tables import shards, tasks
from service.model.outcomes import totals
from service.model.states import Stage

#: Shards that are read at most: enough to say why, and a page stays quick.
MOST_SHARDS: Final = 1000


def outcomes_of(connection: Connection, of_jobs: ColumnElement[bool]) -> dict[str, int]:
    """Candidates that were not kept, by outcome, in the first `MOST_SHARDS` shards of the jobs whose tasks fit."""
    query = (
        select(shards.c.manifest["info"]["outcomes"])
        .join(tasks, tasks.c.shard_id == shards.c.id)
        .where(of_jobs, tasks.c.stage == Stage.SYNTHESIZE.value)
        .limit(MOST_SHARDS)
    )
    return totals(one for one in connection.scalars(query) if isinstance(one, dict))
