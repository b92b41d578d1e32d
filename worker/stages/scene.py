"""From a base shard to scenes: the object at rest on a table, and each grasp's clearance there."""

from __future__ import annotations

import numpy as np

from service.model.domain import Stage, TaskMessage
from service.store.attributes import Attribute
from service.store.manifests import load_shard
from worker.grasps import Posture
from worker.scenes import drop, transfer
from worker.scenes.clearance import count_rejections
from worker.stages.assets import hand_of, object_of
from worker.stages.context import TaskContext
from worker.stages.output import Output, batch_seed


def run(message: TaskMessage, context: TaskContext) -> Output:
    """Drop the object `request.scenes` times and carry the grasps of the base shard over."""
    base = load_shard(context.store, Stage.SYNTHESIZE, message.inputs[0])
    hand, obj = hand_of(context.store, message), object_of(context.store, message)
    context.check()
    context.progress(0.0, 1.0, "drops")
    scenes = drop(obj, count=message.request.scenes, seed=batch_seed(message))
    context.check()
    context.progress(0.7, 1.0, "table clearance")
    grasp, pregrasp = (Posture.from_columns(base.arrays, name) for name in ("grasp", "pregrasp"))
    placed = transfer(hand, grasp, pregrasp, scenes["scene/object_pose"])
    attributes: dict[str, Attribute] = {"base_shard": message.inputs[0], "root_link": hand.root_link}
    rejected = count_rejections(np.asarray(placed["grasp/rejection"], np.uint8))
    return Output({**scenes, **placed}, attributes, {"rejected": rejected})
