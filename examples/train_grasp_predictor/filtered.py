"""Grasps that were planned around a free object, put into scenes: those whose way the table allows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from examples.train_grasp_predictor.execution import table
from examples.train_grasp_predictor.samples import Floats, Scene, TrainedModel, rows_of
from graspd.service.readers import Shards
from graspd.service.store.shards import read_shard
from graspd.worker.grasps import GraspSet, joined
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes.trajectory import plan_trajectory
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.simulation.obstacles import MARGIN_M, obstacle_clearance

#: Grasps whose way is planned at a time.
_TOGETHER: Final = 32


def valid_grasps(shards: Shards, obj: str) -> GraspSet | None:
    """The valid grasps of an object, of all batches; None: there is none."""
    found = []
    for file in sorted(shards.only(objects=[obj]).of("base"), key=lambda file: file.batch):
        shard = read_shard(shards.path(file), kind="base")
        kept = np.flatnonzero(shard["quality/valid"] == 1)
        if len(kept):
            found.append(GraspSet.from_columns(shard.arrays).take(kept))
    return joined(found) if found else None


def filtered(
    hand: HandModel,
    obj: ObjectModel,
    free: GraspSet,
    scenes: Sequence[Scene],
    object_pose: Floats,
    wanted: NDArray[np.intp],
    *,
    seed: int,
) -> TrainedModel:
    """As many grasps as other data have in the same scenes, as far as there are.

    What a scene has no grasp for is made up for in the others of the object.

    Args:
        hand: the hand.
        obj: the object.
        free: grasps around it.
        scenes: S scenes.
        object_pose: (S, 7) where it lies in them.
        wanted: (S,) how many grasps the other data have in each.
        seed: of the order in which grasps are tried.
    """
    rng = np.random.default_rng(seed)
    order = np.array([rng.permutation(len(free)) for _ in scenes])
    standing = [order[s][_stands(free, order[s], pose, hand)] for s, pose in enumerate(object_pose)]
    kept = np.zeros(len(scenes), int)
    parts: list[GraspSet] = []
    owner: list[int] = []
    missing = int(wanted.sum())
    for most in (wanted, np.full(len(scenes), missing)):
        for s, pose in enumerate(object_pose):
            while standing[s].size and kept[s] < most[s] and missing:
                now, standing[s] = standing[s][:_TOGETHER], standing[s][_TOGETHER:]
                grasps = _on_their_way(hand, obj, free.take(now), pose)
                grasps = grasps.take(slice(0, min(missing, int(most[s] - kept[s]))))
                if len(grasps):
                    parts.append(grasps)
                    owner += [s] * len(grasps)
                    kept[s] += len(grasps)
                    missing -= len(grasps)
    if not parts:
        return nothing(hand)
    return _to_be_proposed([scenes[s] for s in owner], rows_of(joined(parts), object_pose[owner]))


def nothing(hand: HandModel) -> TrainedModel:
    """No grasp."""
    return _to_be_proposed([], np.zeros((0, 12 + 3 * len(hand.joint_names))))


def _to_be_proposed(scenes: Sequence[Scene], rows: Floats) -> TrainedModel:
    """Grasps that nobody lifted, which all count alike."""
    return TrainedModel(scenes, rows, np.ones(len(rows)), np.zeros(len(rows), bool), np.ones(len(rows)))


def _stands(free: GraspSet, order: NDArray[np.intp], pose: Floats, hand: HandModel) -> NDArray[np.bool_]:
    """(N,) whether the hand stands clear of the table at the grasp."""
    scene = PlacedGrasps(table().obstacles, pose[None], np.zeros(1, np.intp)).scenes
    return np.asarray(obstacle_clearance(hand, free.grasp.take(order), list(scene)) >= MARGIN_M)


def _on_their_way(hand: HandModel, obj: ObjectModel, grasps: GraspSet, pose: Floats) -> GraspSet:
    """Those of the grasps whose way in and out is clear, with it."""
    placed = PlacedGrasps(table().obstacles, pose[None], np.zeros(len(grasps), np.intp))
    way = plan_trajectory(hand, obj, grasps, placed)
    found = replace(grasps, approach=way.approach, coming=way.open, lift=way.lift, scene=placed.index)
    return found.take(np.flatnonzero(way.clear))
