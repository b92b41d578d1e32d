"""Training samples: point clouds of objects on a table, and grasps of each scene as rows of numbers.

A row has the 12 + 3 J numbers of `baselines.learned.network`, in the table frame with z up.
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

#: Points per cloud; the input of a network is a part of them.
POINTS: Final = 1024
#: Least number of object pixels in a picture; pictures with fewer are omitted.
LEAST_SEEN: Final = 60


@dataclass(frozen=True)
class Scene:
    """An object at rest on one face; `shard` is the base shard of the grasps planned in the scene."""

    object: str
    shard: str
    number: int


@dataclass(frozen=True)
class Sight:
    """One picture of a scene as points of its object, in the table frame."""

    scene: Scene
    points: Floats
    """(P, 3) [m]"""
    normals: Floats
    """(P, 3) unit normals towards the camera."""
    object_pose: Floats
    """(7,) pose of the object, for labels and simulation; not an input of networks."""

    @property
    def anchor(self) -> Floats:
        """(3,) mean of the points."""
        return np.asarray(self.points.mean(axis=0))


def sights(shards: Shards, *, noise: str) -> list[Sight]:
    """Return all pictures with at least `LEAST_SEEN` pixels of the object.

    Args:
        shards: base and views shards of grasps that were planned in scenes.
        noise: noise of the depth camera; see docs/how-to/clouds.md.
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
    """(K,) 1: grasp to propose; 0: failed grasp."""
    hard: NDArray[np.bool_]
    """(K,) whether the grasp also lifts at half friction."""
    weight: Floats
    """(K,) relative frequency in training among the grasps of the scene."""

    def __len__(self) -> int:
        return len(self.rows)

    def take(self, which: NDArray[np.intp]) -> TrainedModel:
        scenes = [self.scenes[i] for i in which]
        return TrainedModel(scenes, self.rows[which], self.label[which], self.hard[which], self.weight[which])


def taught(shards: Shards, obj: str, *, valid: bool = True) -> TrainedModel:
    """Return the grasps in an object's scenes, sorted by batch: valid ones, or all with a verdict."""
    scenes: list[Scene] = []
    rows, label, hard = [], [], []
    for file in sorted(shards.select(objects=[obj]).of_kind("base"), key=lambda file: file.batch):
        shard = read_shard(shards.path(file), kind="base")
        # Grasps without a clear approach have no verdict and are omitted.
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
    """Return the object's poses (S, 7) in the scenes of a base shard."""
    return np.asarray(shard["scene/object_pose"], float)


def rows_of(grasps: GraspSet, object_pose: Floats) -> Floats:
    """Return rows (K, 12 + 3 J) from grasps in the object frame and the object's poses (K, 7)."""
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
    """Return the index of the up direction (S, 3), in the object frame, that is farthest from the others."""
    cosine = faces @ faces.T - 2.0 * np.eye(len(faces))
    return int(np.argmin(cosine.max(axis=1)))


def each_scene(taught_here: TrainedModel) -> Iterator[tuple[Scene, NDArray[np.intp]]]:
    """Yield scenes with the row numbers of their grasps."""
    rows: dict[Scene, list[int]] = {}
    for row, scene in enumerate(taught_here.scenes):
        rows.setdefault(scene, []).append(row)
    for scene, which in rows.items():
        yield scene, np.array(which, np.intp)
