"""What goes into an export for training: grasps of many shards, the pictures of their scenes, and who is held out."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import compose, invert, pose_from_matrix
from service.readers import Pictures
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.rendering.annotate import OBJECT
from worker.simulation.surroundings import Placed

Floats = NDArray[np.float64]

#: Columns that tell where a camera stands and what it sees.
CAMERA: Final = ("camera/intrinsics", "camera/extrinsics")
SEEN: Final = (*CAMERA, "image/depth", "image/segmentation")


@dataclass(frozen=True)
class Lot:
    """Grasps of one base shard that are exported."""

    id: str
    """Of the shard."""
    name: str
    """The object's, fit for files; of two objects of one name the later one carries a piece of its digest."""
    hand: HandModel
    obj: ObjectModel
    grasps: GraspSet
    rows: NDArray[np.intp]
    """Rows that go into the export."""
    held: NDArray[np.int8]
    """(N,) verdict on every grasp: 1 valid, 0 not, -1 nobody judged."""
    columns: Mapping[str, NDArray[Any]]
    """Of the shard."""
    placed: Placed | None = None

    @property
    def tag(self) -> str:
        """Tells shards of one object apart in names of files."""
        return hashlib.sha256(self.id.encode()).hexdigest()[:8]


def held_out(digests: Mapping[str, str], share: float) -> frozenset[str]:
    """Objects that a network is tested on: `share` of them, at least one and not all, by the order of a hash.

    Args:
        digests: of each object's files, by name. Objects of the same files come to the same side.

    Returns:
        names; of a single object none, for there is nothing to hold out.
    """
    kinds = sorted(set(digests.values()), key=lambda digest: hashlib.sha256(digest.encode()).digest())
    count = min(max(1, round(share * len(kinds))), len(kinds) - 1)
    chosen = set(kinds[:count])
    return frozenset(name for name, digest in digests.items() if digest in chosen)


@dataclass(frozen=True)
class Look:
    """One picture: where it is among the pictures, and of what."""

    index: int
    base: str
    """Shard of the scene's grasps."""
    shard: str
    """The views shard."""
    scene: int
    extrinsics: Floats
    """(4, 4) table to camera."""
    object_pose: Floats
    """(7,) in the table's frame."""
    rows: NDArray[np.intp]
    """Rows of the base shard whose grasps are taken in this scene."""


def looks(pictures: Pictures) -> Iterator[Look]:
    """The pictures without their pixels. Of a pair the left one."""
    for index in range(len(pictures)):
        sample = pictures[index]
        if sample["camera/eye"] == RIGHT:
            continue
        extrinsics = np.asarray(sample["camera/extrinsics"], float)
        pose = compose(invert(pose_from_matrix(extrinsics)), sample["object/pose"])
        rows = np.asarray(sample["grasp/base_row"], np.intp)
        yield Look(index, sample["base_id"], sample["shard_id"], int(sample["scene"]), extrinsics, pose, rows)


#: The right eye of a pair, as `camera/eye` tells it.
RIGHT: Final = 2


def object_points(sample: Mapping[str, Any]) -> Floats:
    """(P, 3) what a picture shows of the object, in the camera's frame [m]."""
    depth = np.asarray(sample["image/depth"], float)
    v, u = np.nonzero((np.asarray(sample["image/segmentation"]) == OBJECT) & np.isfinite(depth))
    k, z = np.asarray(sample["camera/intrinsics"], float), depth[v, u]
    # Pixel centres stand at +0.5.
    return np.stack([(u + 0.5 - k[0, 2]) / k[0, 0] * z, (v + 0.5 - k[1, 2]) / k[1, 1] * z, z], axis=1)


def by_scene(found: Sequence[Look]) -> dict[tuple[str, int], list[Look]]:
    """Pictures of each scene of each views shard, in their order."""
    scenes: dict[tuple[str, int], list[Look]] = {}
    for look in found:
        scenes.setdefault((look.shard, look.scene), []).append(look)
    return scenes
