"""Stage render: pictures of scenes in a views shard."""

from dataclasses import replace

import numpy as np

from graspd.service.model.messages import TaskMessage
from graspd.service.model.scene_spec import scene_supports
from graspd.service.model.states import Stage
from graspd.service.store.columns import Attribute
from graspd.service.store.shards import json_attribute
from graspd.worker.rendering import Extras, render
from graspd.worker.rendering.sheets import best_grasps_drawn
from graspd.worker.scenes.neighbours import Neighbours
from graspd.worker.stages.assets import hand_of, load_input, neighbour_attributes, neighbours_of, object_of
from graspd.worker.stages.context import Output, TaskContext, batch_seed


def run(message: TaskMessage, context: TaskContext) -> Output:
    """Render `request.views` camera placements of each scene; with the hand if grasps were planned there."""
    request = message.request
    stage = Stage.SYNTHESIZE if request.in_scene else Stage.SCENE
    shard = load_input(message, context, stage)
    obj = object_of(context.store, message)
    attributes: dict[str, Attribute] = {"scene_shard": message.inputs[0]}
    extras = Extras(channels=request.channels)
    if request.in_scene:
        others = neighbours_of(context.store, message)
        beside = Neighbours(others, np.asarray(shard["scene/neighbour_pose"], float)) if others else None
        drawn = best_grasps_drawn(shard, hand_of(context.store, message), unvalidated=request.validation == "none")
        extras = replace(extras, supports=scene_supports(request.scene_spec), drawn=drawn, neighbours=beside)
        attributes = {"base_shard": message.inputs[0], "scene": json_attribute(request.scene_spec.to_attribute())}
        attributes |= neighbour_attributes(message)
    context.check()
    pictures = render(
        obj,
        np.asarray(shard["scene/object_pose"], float),
        views=request.views,
        stereo=request.stereo,
        width=request.width,
        height=request.height,
        seed=batch_seed(message),
        run=context.run.with_progress_range(0.0, 1.0),
        extras=extras,
    )
    return Output(pictures, attributes)
