"""Queries on usage: what projects used day by day, and what finished batches cost."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import ColumnElement, case, func, select

from service.index.database import Database
from service.index.project_scope import seen_shards
from service.index.tables import shards, spent
from service.index.views import UsageDay
from service.model.domain import JobRequest
from service.model.names import SHARD_KINDS
from service.model.projects import EVERYTHING, ProjectScope
from service.model.states import Stage


@dataclass(frozen=True)
class Usage:
    """Reads on what was used."""

    database: Database

    def days(self, since: str, until: str, *, scope: ProjectScope = EVERYTHING) -> list[UsageDay]:
        """Each project's use of each day on which it used anything, the newest first.

        Args:
            since, until: first and last day, such as 2026-11-22.
        """
        day = func.substr(shards.c.created, 1, 10).label("day")
        made = select(
            shards.c.charged,
            day,
            shards.c.device,
            _base(shards.c.count),
            _base(shards.c.valid),
            func.count(),
            func.sum(shards.c.seconds),
        ).where(shards.c.created >= since, shards.c.created < f"{until}T99")
        gone = select(spent).where(spent.c.day >= since, spent.c.day <= until)
        if not scope.everything:
            made = made.where(shards.c.charged == scope.project)
            gone = gone.where(spent.c.project == scope.project)
        sums: dict[tuple[str, str], dict[str, float]] = defaultdict(lambda: defaultdict(float))
        with self.database.reading() as connection:
            live = connection.execute(made.group_by(shards.c.charged, day, shards.c.device)).all()
            for project, when, device, grasps, valid, tasks, seconds in [*live, *connection.execute(gone).all()]:
                found = sums[when, project]
                found["grasps"] += int(grasps)
                found["valid"] += int(valid)
                found["tasks"] += int(tasks)
                found[_seconds_on(device)] += float(seconds)
        return [
            UsageDay(
                project=project,
                day=when,
                grasps=int(found["grasps"]),
                valid=int(found["valid"]),
                tasks=int(found["tasks"]),
                gpu_seconds=round(found["gpu_seconds"], 3),
                cpu_seconds=round(found["cpu_seconds"], 3),
            )
            for (when, project), found in sorted(sums.items(), key=lambda item: (-_number(item[0][0]), item[0][1]))
        ]

    def gpu_seconds(self, project: str, day: str) -> float:
        """Time that GPU workers spent on what the project asked for, on one day [s]."""
        return sum(one.gpu_seconds for one in self.days(day, day, scope=ProjectScope(project, everything=False)))


def _base(column: ColumnElement[Any]) -> ColumnElement[Any]:
    return func.sum(case((shards.c.kind == "base", column), else_=0))


def _seconds_on(device: str) -> str:
    return "gpu_seconds" if device.startswith("cuda") else "cpu_seconds"


def _number(day: str) -> int:
    return int(day.replace("-", ""))


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
