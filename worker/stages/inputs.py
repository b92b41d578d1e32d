"""What a task reads: the shard of the stage before it."""

from __future__ import annotations

from service.model.messages import TaskMessage
from service.model.states import Stage
from service.store.packs import find_shard
from service.store.shards import Shard
from worker.stages.context import TaskContext


def input_of(message: TaskMessage, context: TaskContext, stage: Stage) -> Shard:
    """The shard that `stage` made for a task, wherever it lies; raises what `find_shard` does."""
    return find_shard(context.store, stage, message.inputs[0], (message.hand_digest, message.object_digest))
