"""What cameras saw of objects on a table, and the grasps of each scene as rows of numbers that a network learns.

A row has the 12 + 3 J numbers of `baselines.learned.network`, in the frame of the table, z up, counted from its
origin.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.baselines.learned.network import Proposals, encode
from graspd.service.model.transforms import compose, quat_rotate
from graspd.service.readers import Pictures, Shards
from graspd.service.store.shards import Shard, read_shard
from graspd.worker.grasps import GraspSet

Floats = NDArray[np.float64]

#: Points of a cloud that are kept; fewer are shown to a network at a time.
POINTS: Final = 1024
#: A picture that shows less of its object is left out [pixels].
LEAST_SEEN: Final = 60


@dataclass(frozen=True)
class Scene:
    """One object as it lies on one face; `shard` is the base shard of the grasps that were planned there."""

    object: str
    shard: str
    number: int


@dataclass(frozen=True)
class Sight:
    """One picture of a scene as points of its object, in the frame of the table."""

    scene: Scene
    points: Floats
    """(P, 3) [m]"""
    normals: Floats
    """(P, 3) unit, toward the camera."""
    object_pose: Floats
    """(7,) where the object lies: for labels and for the simulator, never shown to who proposes."""

    @property
    def anchor(self) -> Floats:
        """(3,) mean of the points."""
        return np.asarray(self.points.mean(axis=0))


def sights(shards: Shards, *, noise: str) -> list[Sight]:
    """All pictures that show enough of their object.

    Args:
        shards: base and views shards of grasps that were planned in scenes.
        noise: of the depth camera; see docs/how-to/clouds.md.
    """
    clouds = Pictures(shards, valid=False).clouds(POINTS, noise=noise, frame="table")
    found = []
    for place, sample in zip(clouds.pictures.places, clouds, strict=True):
        if sample["cloud/seen"] >= LEAST_SEEN:
            scene = Scene(sample["object"], place.scene_shard, place.scene)
            points, normals = (sample[f"cloud/{what}"].astype(float) for what in ("points", "normals"))
            found.append(Sight(scene, points, normals, np.asarray(sample["object/pose"])))
    return found


@dataclass(frozen=True)
class TrainedModel:
    """Grasps of one object in its scenes."""

    scenes: Sequence[Scene]
    """(K,)"""
    rows: Floats
    """(K, 12 + 3 J)"""
    label: Floats
    """(K,) 1: to be proposed; 0: an example of what fails."""
    hard: NDArray[np.bool_]
    """(K,) whether it lifts at half the friction too."""
    weight: Floats
    """(K,) how often a grasp is shown, beside the others of its scene."""

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, which: NDArray[np.intp]) -> TrainedModel:
        scenes = [self.scenes[i] for i in which]
        return TrainedModel(scenes, self.rows[which], self.label[which], self.hard[which], self.weight[which])


def taught(shards: Shards, obj: str, *, valid: bool = True) -> TrainedModel:
    """The grasps of an object that were planned in its scenes, in the order of their batches."""
    scenes: list[Scene] = []
    rows, label, hard = [], [], []
    for file in sorted(shards.only(objects=[obj]).of("base"), key=lambda file: file.batch):
        shard = read_shard(shards.path(file), kind="base")
        # What is not clear on its way has no verdict: it is no example of anything.
        kept = np.flatnonzero(
            np.asarray(shard["quality/valid"]) == 1 if valid else np.asarray(shard["quality/success"], int) >= 0
        )
        number = np.asarray(shard["grasp/scene_index"], np.intp)[kept]
        scenes += [Scene(obj, file.id, int(one)) for one in number]
        rows.append(rows_of(GraspSet.from_columns(shard.arrays).take(kept), poses_of(shard)[number]))
        label.append(np.asarray(shard["quality/valid"], float)[kept])
        hard.append(np.asarray(shard["quality/lift_hard"])[kept] == 1)
    return TrainedModel(scenes, np.concatenate(rows), np.concatenate(label), np.concatenate(hard), np.ones(len(scenes)))


def poses_of(shard: Shard) -> Floats:
    """(S, 7) where the object lies in each scene of a base shard."""
    return np.asarray(shard["scene/object_pose"], float)


def rows_of(grasps: GraspSet, object_pose: Floats) -> Floats:
    """(K, 12 + 3 J) from grasps in the object's frame, which lies at `object_pose` (K, 7)."""
    assert grasps.approach is not None
    way = grasps.approach[:, -1, :3] - grasps.approach[:, 0, :3]
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    proposals = Proposals(
        compose(object_pose, np.asarray(grasps.grasp.hand_pose, float)),
        quat_rotate(object_pose[:, 3:], way),
        *(np.asarray(part.joint_positions, float) for part in (grasps.grasp, grasps.pregrasp, grasps.squeeze)),
    )
    return encode(proposals, np.zeros(3))


def apart(faces: Floats) -> int:
    """Of directions that look up (S, 3) in the object's frame, the one that is farthest from all others."""
    cosine = faces @ faces.T - 2.0 * np.eye(len(faces))
    return int(np.argmin(cosine.max(axis=1)))


def each_scene(taught_here: TrainedModel) -> Iterator[tuple[Scene, NDArray[np.intp]]]:
    """Scenes with the rows of their grasps."""
    rows: dict[Scene, list[int]] = {}
    for row, scene in enumerate(taught_here.scenes):
        rows.setdefault(scene, []).append(row)
    for scene, which in rows.items():
        yield scene, np.array(which, np.intp)
