"""What a task reads: the shard of the stage before it."""

from __future__ import annotations

from service.model.messages import TaskMessage
from service.model.states import Stage
from service.store.manifests import load_shard
from service.store.shards import Shard
from worker.stages.context import TaskContext


def input_of(message: TaskMessage, context: TaskContext, stage: Stage) -> Shard:
    """The shard that `stage` made for a task; raises what `load_shard` does."""
    return load_shard(context.store, stage, message.inputs[0])
