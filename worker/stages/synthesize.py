"""From a hand and an object to a batch of grasps with their quality: a base shard."""

from __future__ import annotations

import math
from typing import Any

from service.model.domain import TaskMessage
from worker.certified import certified_grasps
from worker.files.base_attributes import base_attributes
from worker.stages.assets import hand_of, object_of
from worker.stages.context import TaskContext
from worker.stages.output import Output
from worker.stages.pieces import pieces_of


def run(message: TaskMessage, context: TaskContext) -> Output:
    """Grasps of one batch with quality and verdict: `message.count` valid ones, as far as the job's budget goes."""
    hand, obj = hand_of(context.store, message), object_of(context.store, message)
    context.check()
    found = certified_grasps(
        hand,
        obj,
        message.request,
        count=message.count,
        batch=message.batch,
        pieces=lambda prepared: pieces_of(context.store, prepared),
        run=context.run,
    )
    seconds = {f"{name}_seconds": round(value, 4) for name, value in found.seconds.items()}
    info = {**seconds, "rejected": found.rejected, "planned": found.planned, **_json(found.grasps.info)}
    said = base_attributes(hand, message.request, tried=found.tried, verdict_key=found.verdict_key)
    return Output({**found.grasps.to_columns(), **found.columns}, said, info)


def _json(info: dict[str, object]) -> dict[str, object]:
    """The planner's remarks without nan and infinity, which JSON does not know."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(key): plain(part) for key, part in value.items()}
        if isinstance(value, list | tuple):
            return [plain(part) for part in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {key: plain(value) for key, value in info.items()}
