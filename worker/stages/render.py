"""From a scene shard to pictures of it: a views shard."""

from __future__ import annotations

import numpy as np

from service.model.domain import Stage, TaskMessage
from service.store.manifests import load_shard
from worker.rendering import Extras, render
from worker.stages.assets import object_of
from worker.stages.context import TaskContext
from worker.stages.output import Output, batch_seed


def run(message: TaskMessage, context: TaskContext) -> Output:
    """Render `request.views` camera placements of each scene."""
    scene = load_shard(context.store, Stage.SCENE, message.inputs[0])
    obj = object_of(context.store, message)
    context.check()
    request = message.request
    pictures = render(
        obj,
        np.asarray(scene["scene/object_pose"], float),
        views=request.views,
        stereo=request.stereo,
        width=request.width,
        height=request.height,
        seed=batch_seed(message),
        run=context.run.part(0.0, 1.0),
        extras=Extras(channels=request.channels),
    )
    return Output(pictures, {"scene_shard": message.inputs[0]})
