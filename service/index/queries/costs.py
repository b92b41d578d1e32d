"""What finished batches cost: the measurements behind the estimate of a dataset."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from sqlalchemy import select

from service.index.database import Database
from service.index.project_scope import seen_shards
from service.index.tables import shards
from service.model.domain import JobRequest
from service.model.names import SHARD_KINDS
from service.model.projects import EVERYTHING, ProjectScope
from service.model.states import Stage

#: Tasks looked at of each stage, the newest first: what a machine did long ago says less.
_NEWEST: Final = 2000


@dataclass(frozen=True)
class BatchCost:
    """The finished batches of a task: what was asked, what they took, what came out."""

    hand: str
    object: str
    device: str
    request: JobRequest
    seconds: float
    count: int
    valid: int
    tried: int
    size_bytes: int
    batches: int = 1

    @property
    def kept(self) -> int:
        """Grasps that count towards those asked for: valid ones, or where nobody judged all that stayed."""
        return self.valid if self.request.counted == "valid" else self.count


@dataclass(frozen=True)
class Costs:
    """Reads on costs."""

    database: Database

    def of_batches(self, stage: Stage, *, limit: int = _NEWEST, scope: ProjectScope = EVERYTHING) -> list[BatchCost]:
        """The newest finished batches of a stage, those of at most `limit` tasks."""
        columns = [shards.c[name] for name in BatchCost.__dataclass_fields__ if name != "request"]
        query = (
            select(*columns, shards.c.manifest["request"].label("request"))
            .where(shards.c.kind == SHARD_KINDS[stage], *seen_shards(scope, shards.c.id))
            .order_by(shards.c.created.desc(), shards.c.id.desc())
            .limit(limit)
        )
        with self.database.reading() as connection:
            rows = connection.execute(query).mappings().all()
        return [BatchCost(**{**row, "request": JobRequest.model_validate(row["request"])}) for row in rows]
