"""Stage synthesize: grasps of a hand on an object with their quality, in a base shard."""

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.base import json_value
from graspd.service.model.errors import InputError, LoadError, SceneError
from graspd.service.model.messages import TaskMessage
from graspd.service.model.planning import format_outcomes, sum_outcomes
from graspd.service.model.states import Stage
from graspd.service.store.columns import Attribute
from graspd.service.store.validity import second_engine_counts
from graspd.worker.batched_generation import validated_batches
from graspd.worker.files.provenance import base_attributes
from graspd.worker.generation import ValidatedBatch
from graspd.worker.planners import NoStartFound, planner
from graspd.worker.stages import assets
from graspd.worker.stages.context import Output, TaskContext
from graspd.worker.stages.ranges import join_outputs, sizes_of

#: Columns of the scene shard that the base shard repeats, so that it can be used alone.
_OF_SCENES: Final = ("scene/object_pose", "scene/rest_probability", "scene/neighbour_pose")


def run(message: TaskMessage, context: TaskContext) -> Output:
    """Plan and validate `message.count` grasps within the job's budget.
    Raises SceneError: the hand does not reach into the scenes, the method cannot plan in them, or the first batch finds
    no grasp. LoadError: a job's first batch finds none because the payload is far too small."""
    hand, obj = assets.hand_of(context.store, message), assets.object_of(context.store, message)
    assets.cache_network(context.store, message)
    columns = _scene_columns(message, context)
    scenes = [assets.scenes_of(context.store, message, part) for part in columns]
    context.check()
    try:
        found = validated_batches(
            hand,
            obj,
            message.request,
            sizes=sizes_of(message),
            first=message.batch,
            join=context.join,
            scenes=scenes or None,
            pieces=lambda prepared: assets.load_pieces(context.store, prepared),
            run=context.run,
            checked=partial(_stop_if_empty, message, in_scenes=bool(scenes)),
            empty_on=(NoStartFound,) if scenes else (),
        )
    except InputError as error:
        # Errors of hand and object have other classes. These two mean that the hand does not reach into the scenes.
        if scenes and type(error) in (InputError, NoStartFound):
            raise SceneError(str(error)) from None
        raise
    made = [_create_output(one, part) for one, part in zip(found, columns or [{}] * len(found), strict=True)]
    if message.request.second_engines:
        made = [replace(one, info={**one.info, "second_engine": second_engine_counts(one.arrays)}) for one in made]
    attributes = base_attributes(
        hand,
        obj,
        message.request,
        candidates=sum(one.candidates for one in found),
        verdict_key=found[0].verdict_key,
        outcomes=sum_outcomes(one.outcomes for one in found),
    )
    of_scenes: dict[str, Attribute] = {"scene_shard": message.inputs[0]} if scenes else {}
    of_scenes |= assets.neighbour_attributes(message)
    whole = join_outputs(message, made)
    return replace(whole, attributes={**whole.attributes, **attributes, **of_scenes})


def _create_output(found: ValidatedBatch, columns: Mapping[str, NDArray[Any]]) -> Output:
    info: dict[str, Any] = {f"{name}_seconds": round(value, 4) for name, value in found.seconds.items()}
    info |= {name: round(value, 4) for name, value in found.shares.items()}
    info |= {"rejected": found.rejected, "outcomes": found.outcomes, "planned": found.planned}
    info |= json_value(found.grasps.info)
    return Output({**found.grasps.to_columns(), **found.columns, **columns}, info=info)


def _scene_columns(message: TaskMessage, context: TaskContext) -> list[dict[str, NDArray[Any]]]:
    request = message.request
    if not request.in_scene:
        return []
    try:
        planner(request.method, request.options, in_scenes=True)
    except InputError as error:
        raise SceneError(str(error)) from None
    shard = assets.load_input(message, context, Stage.SCENE)
    there = {name: np.asarray(shard[name], float) for name in _OF_SCENES if name in shard.arrays}
    count = len(sizes_of(message))
    parts = {name: np.split(column, count) for name, column in there.items()}
    return [{name: column[number] for name, column in parts.items()} for number in range(count)]


def _stop_if_empty(message: TaskMessage, batch: int, found: ValidatedBatch, *, in_scenes: bool) -> None:
    """Stop a job whose first batch finds nothing, since the other batches would find nothing either."""
    request, limit = message.request, found.limit
    if batch or request.want == "candidates" or len(found.grasps):
        return
    none = f"none of {found.planned} candidates is {request.counted_status}"
    if limit is not None and limit.is_far_exceeded:
        raise LoadError(f"{none}: {limit.line}")
    if in_scenes:
        reasons = [format_outcomes(found.outcomes), found.narrow, limit.line if limit is not None else ""]
        lost = "; ".join(filter(None, reasons))
        raise SceneError(
            f"{none} in its scene ({request.scene_spec.kind}): {lost}; give "
            f"a larger budget than {request.budget:g} candidates for each grasp, or another pose, scene, hand or seed"
        )
