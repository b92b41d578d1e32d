"""Sources of training data, with the same number of grasps per object in the same scenes and pictures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from examples.train_grasp_predictor.filtered import filtered, nothing, valid_grasps
from examples.train_grasp_predictor.samples import Floats, Scene, TrainedModel, apart, each_scene, poses_of, taught
from graspd.service.model.transforms import quat_conjugate, quat_rotate
from graspd.service.readers import Shards
from graspd.service.store.shards import read_shard
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import UP

#: Ablations: smaller sizes, and quarters selected by similarity instead of the first quarter.
QUARTER, SIXTEENTH = "scenes, a quarter", "scenes, a sixteenth"
ALIKE, UNLIKE = "scenes, the quarter most alike", "scenes, the quarter most unlike"
FAILED, HARD = "scenes, failures told", "scenes, by half the friction"
SCENES: Final = "scenes in the loop"
#: Weight in training of grasps that also lift at half friction; other grasps have weight 1.
HARD_WEIGHT: Final = 4.0
#: Length equivalent to one radian in distances of grasps [m].
_RADIAN_M: Final = 0.05


class Held:
    """Scenes excluded from training: one face of each object, the face that differs most from the others."""

    def __init__(self, shards: Shards, objects: Sequence[str]) -> None:
        self.face: dict[str, int] = {}
        self.poses: dict[Scene, Floats] = {}
        for obj in objects:
            for file in shards.select(objects=[obj]).of_kind("base"):
                poses = poses_of(read_shard(shards.path(file), kind="base"))
                self.poses |= {Scene(obj, file.id, number): pose for number, pose in enumerate(poses)}
                if obj not in self.face and len(poses) > 1:
                    up = quat_rotate(quat_conjugate(poses[:, 3:]), np.broadcast_to(UP, (len(poses), 3)))
                    self.face[obj] = apart(up)

    def back(self, scene: Scene) -> bool:
        return self.face.get(scene.object) == scene.number

    def trained(self, given: TrainedModel) -> TrainedModel:
        return given.take(np.array([i for i, scene in enumerate(given.scenes) if not self.back(scene)], np.intp))


def in_scenes(shards: Shards, obj: str, held: Held, count: int) -> TrainedModel:
    """Return the first `count` grasps planned in training scenes of an object."""
    return first(held.trained(taught(shards, obj)), count)


def first(given: TrainedModel, count: int) -> TrainedModel:
    """Return the first `count` grasps, or all if there are fewer."""
    return given.take(np.arange(min(count, len(given))))


def put_into(
    free: Shards, hand: HandModel, obj: ObjectModel, name: str, like: TrainedModel, held: Held, *, seed: int
) -> TrainedModel:
    """Return up to as many free grasps as `like` has, transferred to its scenes and filtered."""
    scenes, counts = zip(*((scene, len(rows)) for scene, rows in each_scene(like)), strict=True)
    poses = np.array([held.poses[scene] for scene in scenes])
    grasps = valid_grasps(free, name)
    return filtered(hand, obj, grasps, scenes, poses, np.array(counts), seed=seed) if grasps else nothing(hand)


def spread(given: TrainedModel, held: Held, count: int, *, alike: bool) -> TrainedModel:
    """Return `count` similar (`alike`) or dissimilar grasps of an object, beginning with the medoid.
    Similar grasps are the nearest to the medoid; each dissimilar grasp is the farthest from those before it."""
    place = _of_object(given, held)
    apart_by = np.linalg.norm(place[:, None] - place[None], axis=2)
    if alike:
        return given.take(np.argsort(apart_by[int(apart_by.sum(axis=1).argmin())], kind="stable")[:count])
    chosen = [int(apart_by.sum(axis=1).argmin())]
    nearest = apart_by[chosen[0]].copy()
    while len(chosen) < min(count, len(place)):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, apart_by[chosen[-1]])
    return given.take(np.array(chosen, np.intp))


def _of_object(given: TrainedModel, held: Held) -> Floats:
    """Return hand poses (K, D) in the object frame: position, rotation columns and joints as lengths [m]."""
    pose = np.array([held.poses[scene] for scene in given.scenes])
    back = quat_conjugate(pose[:, 3:])
    position = quat_rotate(back, given.rows[:, :3] - pose[:, :3])
    columns = [quat_rotate(back, given.rows[:, first : first + 3]) for first in (3, 6)]
    joints = given.rows[:, 12 : 12 + (given.rows.shape[1] - 12) // 3]
    return np.concatenate([position, *(_RADIAN_M * part for part in (*columns, joints))], axis=1)


def with_failures(shards: Shards, obj: str, held: Held, count: int) -> TrainedModel:
    """Return the first `count` validated grasps in training scenes of an object, with any verdict."""
    return first(held.trained(taught(shards, obj, valid=False)), count)


def by_friction(given: TrainedModel) -> TrainedModel:
    """Return the grasps with larger weights for those that lift at half friction."""
    return replace(given, weight=np.where(given.hard, HARD_WEIGHT, 1.0))
