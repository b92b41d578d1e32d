"""Stage scene: makes scenes in which grasps are then planned, or transfers free grasps to scenes."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import MeshError, SceneError
from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import Stage
from graspd.service.store.columns import Attribute
from graspd.service.store.shards import Shard, json_attribute
from graspd.worker.files.provenance import wrist_attributes
from graspd.worker.grasps import Posture
from graspd.worker.scenes import drop, transfer_grasps
from graspd.worker.scenes.clearance import count_rejections
from graspd.worker.scenes.placement import scenes_of
from graspd.worker.stages.assets import hand_of, load_input, neighbour_attributes, neighbours_of, object_of
from graspd.worker.stages.context import Output, TaskContext, batch_seed
from graspd.worker.stages.ranges import base_rows, join_outputs, split_into_batches

#: Empty grasp columns of a scene shard in which grasps are yet to be planned.
_NO_GRASPS: Final[dict[str, NDArray[Any]]] = {
    "grasp/base_index": np.zeros(0, np.int32),
    "grasp/scene_index": np.zeros(0, np.int32),
    "grasp/hand_pose": np.zeros((0, 7)),
    "grasp/table_clearance_m": np.zeros(0),
    "grasp/valid": np.zeros(0, np.uint8),
}


def run(message: TaskMessage, context: TaskContext) -> Output:
    """Make the scenes of each batch."""
    parts = split_into_batches(message)

    def report_scene(number: int) -> TaskContext:
        context.check()
        context.progress(number, len(parts), "scenes")
        return context

    if message.request.in_scene:
        return join_outputs(message, [_make_scenes(part, report_scene(number)) for number, part in enumerate(parts)])
    base = load_input(message, context, Stage.SYNTHESIZE)
    rows = base_rows(base, message)
    made = [_transfer_to_scenes(part, report_scene(number), base, rows[number]) for number, part in enumerate(parts)]
    return join_outputs(message, made, base_rows=rows)


def _make_scenes(message: TaskMessage, context: TaskContext) -> Output:
    """Place the object and its neighbours in `request.scenes` scenes.
    Raises SceneError: they do not fit, penetrate each other, or do not come to rest."""
    hand, obj = hand_of(context.store, message), object_of(context.store, message)
    place = message.request.scene_spec
    # The first batch has the same scenes as `graspd synth` with the same seed.
    seed = batch_seed(message) if message.batch else message.request.seed
    others = neighbours_of(context.store, message)
    context.check()
    try:
        _, scenes = scenes_of(place, obj, others, count=message.request.scenes, seed=seed)
    except MeshError as error:
        raise SceneError(str(error)) from None
    attributes: dict[str, Attribute] = {"scene": json_attribute(place.to_attribute()), "root_link": hand.root_link}
    return Output({**scenes, **_NO_GRASPS}, attributes | neighbour_attributes(message))


def _transfer_to_scenes(message: TaskMessage, context: TaskContext, base: Shard, rows: range) -> Output:
    """Drop the object `request.scenes` times; transfer the base shard's grasps `rows`, numbered from 0."""
    hand, obj = hand_of(context.store, message), object_of(context.store, message)
    context.check()
    scenes = drop(obj, count=message.request.scenes, seed=batch_seed(message))
    context.check()
    grasp, pregrasp = (
        Posture.from_columns(base.arrays, name).take(np.array(rows, int)) for name in ("grasp", "pregrasp")
    )
    placed = transfer_grasps(hand, grasp, pregrasp, scenes["scene/object_pose"])
    attributes: dict[str, Attribute] = {"base_shard": message.inputs[0], "root_link": hand.root_link}
    attributes |= wrist_attributes(hand)
    rejected = count_rejections(np.asarray(placed["grasp/rejection"], np.uint8))
    return Output({**scenes, **placed}, attributes, {"rejected": rejected})
