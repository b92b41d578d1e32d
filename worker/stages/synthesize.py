"""From a hand and an object to a batch of grasps with their quality: a base shard."""

from __future__ import annotations

import math
from typing import Any, Final

from service.domain import TaskMessage
from service.shards import Attribute
from worker.context import TaskContext
from worker.grasps import GraspSet
from worker.planners import synthesize
from worker.quality.table import measure
from worker.stages.assets import hand_of, object_of
from worker.stages.gate import passes
from worker.stages.output import Output

#: Share of the progress bar that ends with the planner; the rest is the quality table.
_PLANNED: Final = 0.85


def run(message: TaskMessage, context: TaskContext) -> Output:
    """Synthesize and measure `message.count` grasps."""
    hand, obj = hand_of(context.store, message), object_of(context.store, message)
    context.check()
    request = message.request
    grasps = synthesize(
        hand,
        obj,
        count=message.count,
        method=request.method,
        fidelity=request.knobs,
        seed=request.seed,
        batch=message.batch,
        threads=context.threads,
        device=context.device,
        progress=context.part(0.0, _PLANNED),
        cancelled=context.cancelled,
    )
    quality = measure(
        hand,
        obj,
        grasps,
        friction=request.friction,
        threads=context.threads,
        progress=context.part(_PLANNED, 1.0),
        cancelled=context.cancelled,
    )
    arrays: dict[str, Any] = {**postures(grasps), **quality, "quality/valid": passes(quality)}
    attributes: dict[str, Attribute] = {
        "joint_names": list(hand.joint_names),
        "mu": request.friction,
        "root_link": hand.root_link,
    }
    return Output(arrays, attributes, {"planner_seconds": round(grasps.seconds, 4), **_json(grasps.info)})


def postures(grasps: GraspSet) -> dict[str, Any]:
    """The posture columns of a base shard."""
    parts = {"grasp": grasps.grasp, "pregrasp": grasps.pregrasp, "squeeze": grasps.squeeze}
    return {f"{name}/hand_pose": part.hand_pose for name, part in parts.items()} | {
        f"{name}/joint_positions": part.joint_positions for name, part in parts.items()
    }


def _json(info: dict[str, object]) -> dict[str, object]:
    """The planner's remarks without nan and infinity, which JSON does not know."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {str(key): plain(part) for key, part in value.items()}
        if isinstance(value, list | tuple):
            return [plain(part) for part in value]
        return None if isinstance(value, float) and not math.isfinite(value) else value

    return {key: plain(value) for key, value in info.items()}
