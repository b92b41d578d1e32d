"""Transfer of grasps to another hand: same type, contact region and approach, validated anew."""

from typing import Any, Final

import numpy as np

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.metrics import GraspType
from graspd.service.model.options import validate
from graspd.service.model.transforms import Floats, quat_rotate
from graspd.service.store import validity
from graspd.service.store.columns import Attribute
from graspd.service.store.shards import Shard, json_attribute
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.files.provenance import (
    base_attributes,
    hand_of_shard,
    id_of_columns,
    object_of_shard,
    path_attributes,
)
from graspd.worker.generation import ValidatedBatch, validated_grasps
from graspd.worker.grasps import Posture, join_columns
from graspd.worker.hands.digits import digit_names
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.contact import LINK_CONTACT_M
from graspd.worker.quality.probe import HAND_POINTS, probe_of

#: Distance by which the contact region exceeds the box around the contacts of the other hand [m].
MARGIN_M: Final = 0.015
#: Largest angle between the palms' approaches [deg].
CONE_DEG: Final = 60.0
#: Root attributes that are those of the other hand's grasps.
_INHERITED: Final = ("object", "object_digest", "object_source", "object_options", "method", "fidelity")
#: Candidates per grasp.
BUDGET: Final = 8.0


def contact_boxes(hand: HandModel, obj: ObjectModel, grasp: Posture) -> Floats:
    """Return the boxes (N, 2, 3) around all contacts of N grasps: corners in the object frame [m].
    Boxes of grasps without contact are nan."""
    found = probe_of(hand, obj, hand_points=HAND_POINTS, object_points=64).nearest_points(grasp)
    near = (np.abs(found.distance) < LINK_CONTACT_M)[..., None]
    low, high = (np.where(near, found.closest, sign * np.inf) for sign in (1, -1))
    boxes = np.stack([low.min(axis=1), high.max(axis=1)], axis=1)
    return np.where(np.isfinite(boxes), boxes, np.nan)


def requests_of(
    shard: Shard, source: HandModel, target: HandModel, obj: ObjectModel, seed: int
) -> dict[int, JobOptions]:
    """Return the request for each valid grasp of a base shard, by row.
    A type that the target hand cannot make is not required."""
    rows = np.flatnonzero(validity.valid_mask(shard.arrays))
    grasp = Posture.from_columns(shard.arrays).take(rows)
    boxes = contact_boxes(source, obj, grasp)
    approach = quat_rotate(grasp.hand_pose[:, 3:], source.palm.approach)
    kinds = np.asarray(shard.arrays.get("quality/grasp_type", np.zeros(len(shard["quality/valid"]))), int)[rows]
    found = {}
    for row, (low, high), axis, kind in zip(rows.tolist(), boxes, approach, kinds.tolist(), strict=True):
        if np.isnan(low).any():
            continue
        bounds = [f"{name} > {value - MARGIN_M:.4f}" for name, value in zip("xyz", low, strict=True)]
        bounds += [f"{name} < {value + MARGIN_M:.4f}" for name, value in zip("xyz", high, strict=True)]
        lateral = kind == GraspType.LATERAL and not digit_names(target)
        given: dict[str, Any] = {
            "type": "any" if kind == GraspType.NONE or lateral else GraspType(kind).name.lower(),
            "touch_region": ", ".join(bounds),
            "approach_cone": ", ".join(f"{value:.4f}" for value in axis) + f", {CONE_DEG:g}",
        }
        found[row] = validate(JobOptions, given | {"grasps": 1, "seed": seed + row, "budget": BUDGET, "rechecks": 0})
    return found


def transfer_grasps(
    shard: Shard,
    hand: str,
    *,
    source_hand: str | None = None,
    obj: str | None = None,
    seed: int = 0,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Plan and validate a grasp of `hand` for each valid free grasp of a base shard.
    Return arrays and attributes of a base shard; attribute `transferred_from` lists the rows of the shard.
    Raises InputError: the grasps are in scenes, no grasp is valid, or no grasp is found."""
    if "scene" in shard.attributes:
        raise InputError(f"{shard.path} has grasps in scenes: transfer grasps of a free object")
    source, target = hand_of_shard(shard, source_hand), hand_from_path(hand)
    thing = object_of_shard(shard, obj)
    requests = requests_of(shard, source, target, thing, seed)
    if not requests:
        raise InputError(f"{shard.path} has no valid grasp to transfer")
    batches: dict[int, ValidatedBatch] = {}
    for number, (row, request) in enumerate(requests.items()):
        run.progress(number, len(requests), "transfer")
        run.check("transfer")
        batches[row] = validated_grasps(target, thing, request, count=1, run=run.without_progress())
    rows = [row for row, batch in batches.items() if len(batch.grasps)]
    if not rows:
        raise InputError(f"none of {len(requests)} grasps of {shard.path} can be transferred to {target.name}")
    kept = [batches[row] for row in rows]
    arrays = join_columns([{**batch.grasps.to_columns(), **batch.columns} for batch in kept])
    candidates = sum(batch.candidates for batch in batches.values())
    request = requests[rows[0]].model_copy(update={"type": "any", "touch_region": "", "approach_cone": ""})
    attributes = base_attributes(target, thing, request, candidates=candidates, verdict_key=kept[0].verdict_key)
    told: dict[str, Attribute] = {
        "hand": target.name,
        "hand_digest": target.digest,
        **{name: shard.attributes[name] for name in _INHERITED if name in shard.attributes},
        "transferred_from": json_attribute({"shard": str(shard.attributes.get("shard_id", "")), "rows": rows}),
        "shard_id": id_of_columns(arrays),
    }
    return arrays, attributes | told | path_attributes(hand, "", {})
