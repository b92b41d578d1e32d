"""What a base shard says at its root of the grasps in it; `service.store.columns` has the schema."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from service.model.domain import JobOptions
from service.store.columns import Attribute
from service.store.shards import json_attribute
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel


def base_attributes(
    hand: HandModel,
    obj: ObjectModel,
    request: JobOptions,
    *,
    tried: int,
    verdict_key: str | None,
    outcomes: Mapping[str, int] = MappingProxyType({}),
) -> dict[str, Attribute]:
    """The hand's joints, what was asked for, in which scene, how many grasps were tried, and who judged them.

    Args:
        hand: the hand.
        obj: the object as it was judged.
        request: friction, want, referee and scene.
        tried: grasps tried until the last one kept.
        verdict_key: digest of the terms of the verdicts; None: nobody judged.
        outcomes: tries that were not kept, by what became of them.
    """
    said: dict[str, Attribute] = {
        "joint_names": list(hand.joint_names),
        "mu": request.friction,
        "root_link": hand.root_link,
        "object_mass_kg": obj.mass,
        "object_friction": obj.friction,
        "want": request.want,
        "tried": tried,
    }
    if outcomes:
        said["outcomes"] = json_attribute(dict(outcomes))
    if request.in_scene:
        said |= {"scene": json_attribute(request.place.told())} | wrist_attributes(hand)
    if request.models:
        said["robust"] = json_attribute({"models": request.models, "wanted": request.robust})
    if verdict_key is None:
        return said | {"verdict_level": "none"}
    return said | {"verdict_level": request.referee, "verdict_key": verdict_key}


def wrist_attributes(hand: HandModel) -> dict[str, Attribute]:
    """What names the columns of `grasp/wrist_positions`, which grasps in scenes have."""
    wrist = () if hand.mounting is None else hand.mounting.joint_names
    return {"wrist_joint_names": list(wrist)} if wrist else {}
