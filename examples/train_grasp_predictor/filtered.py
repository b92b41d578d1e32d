"""Free grasps transferred to scenes, without those that collide with the table."""

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
from graspd.worker.grasps import GraspSet, join_grasp_sets
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes.trajectory import plan_trajectory
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.simulation.obstacles import MARGIN_M, obstacle_clearance

#: Grasps per call of the trajectory planner.
_TOGETHER: Final = 32


def valid_grasps(shards: Shards, obj: str) -> GraspSet | None:
    """Return the valid grasps of an object from all batches; None if there are none."""
    found = []
    for file in sorted(shards.select(objects=[obj]).of_kind("base"), key=lambda file: file.batch):
        shard = read_shard(shards.path(file), kind="base")
        kept = np.flatnonzero(shard["quality/valid"] == 1)
        if len(kept):
            found.append(GraspSet.from_columns(shard.arrays).take(kept))
    return join_grasp_sets(found) if found else None


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
    """Transfer up to as many free grasps to the scenes as another source has there.

    If a scene gets too few grasps, other scenes of the object get more.

    Args:
        hand: the hand.
        obj: the object.
        free: free grasps of the object.
        scenes: S scenes.
        object_pose: (S, 7) pose of the object in each scene.
        wanted: (S,) number of grasps that the other source has in each scene.
        seed: seed of the order in which grasps are tested.
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
    return _to_be_proposed([scenes[s] for s in owner], rows_of(join_grasp_sets(parts), object_pose[owner]))


def nothing(hand: HandModel) -> TrainedModel:
    """Return an empty set of grasps."""
    return _to_be_proposed([], np.zeros((0, 12 + 3 * len(hand.joint_names))))


def _to_be_proposed(scenes: Sequence[Scene], rows: Floats) -> TrainedModel:
    """Return grasps without lift tests, with equal weights."""
    return TrainedModel(scenes, rows, np.ones(len(rows)), np.zeros(len(rows), bool), np.ones(len(rows)))


def _stands(free: GraspSet, order: NDArray[np.intp], pose: Floats, hand: HandModel) -> NDArray[np.bool_]:
    """Check (N,) whether the hand is clear of the table at the grasp."""
    scene = PlacedGrasps(table().obstacles, pose[None], np.zeros(1, np.intp)).scenes
    return np.asarray(obstacle_clearance(hand, free.grasp.take(order), list(scene)) >= MARGIN_M)


def _on_their_way(hand: HandModel, obj: ObjectModel, grasps: GraspSet, pose: Floats) -> GraspSet:
    """Return the grasps with a clear approach and lift, with these trajectories."""
    placed = PlacedGrasps(table().obstacles, pose[None], np.zeros(len(grasps), np.intp))
    way = plan_trajectory(hand, obj, grasps, placed)
    found = replace(grasps, approach=way.approach, coming=way.open, lift=way.lift, scene=placed.index)
    return found.take(np.flatnonzero(way.clear))
