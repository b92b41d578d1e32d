"""Stage render: pictures of scenes in a views shard."""

from dataclasses import replace

import numpy as np

from graspd.service.model.messages import TaskMessage
from graspd.service.model.scene_spec import scene_supports
from graspd.service.model.states import Stage
from graspd.service.model.transforms import compose
from graspd.service.readers.trajectories import wrist_angles
from graspd.service.store import validity
from graspd.service.store.columns import Attribute
from graspd.service.store.shards import Shard, json_attribute
from graspd.worker.rendering import Extras, render
from graspd.worker.rendering.hands import DrawnHand
from graspd.worker.rendering.sheets import best_in_scenes
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
        drawn = _select_drawn_hand(shard, message, context)
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


def _select_drawn_hand(base: Shard, message: TaskMessage, context: TaskContext) -> DrawnHand | None:
    """Select the best valid grasp of each scene; return None if the shard has no grasps."""
    hand = hand_of(context.store, message)
    among = validity.selection_mask(base.arrays, unvalidated=message.request.validation == "none")
    rows = best_in_scenes(base.arrays, among)
    if not len(among):
        return None
    poses = np.asarray(base["scene/object_pose"], float)
    hand_poses, joints = (np.asarray(base[f"grasp/{name}"], float)[rows] for name in ("hand_pose", "joint_positions"))
    return DrawnHand(hand, rows, compose(poses, hand_poses), joints, wrist_angles(base, rows))
