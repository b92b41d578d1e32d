"""The plan of an export for training: grasps of many shards, pictures of their scenes, splits, names, and the
summary."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.names import fitted
from graspd.service.model.transforms import Floats, compose, invert, pose_from_matrix
from graspd.service.readers import DepthNoise, Pictures
from graspd.service.readers.clouds import CloudView
from graspd.service.store.shards import Shard
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import PlacedGrasps


@dataclass(frozen=True)
class ExportPart:
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
    verdict: NDArray[np.int8]
    """(N,) of the validator on every grasp: 1 held, 0 dropped, -1 not validated."""
    shard: Shard
    placed: PlacedGrasps | None = None

    @property
    def tag(self) -> str:
        """Tells shards of one object apart in names of files."""
        return hashlib.sha256(self.id.encode()).hexdigest()[:8]


def held_out(kinds: Mapping[str, str], share: float) -> frozenset[str]:
    """Objects that a network is tested on: `share` of them, at least one and not all, by the order of a hash.

    Args:
        kinds: of each object by name what kind it is, see `exchange.training_export`. One kind comes to one side.

    Returns:
        names; of a single kind none, for there is nothing to hold out.
    """
    order = sorted(set(kinds.values()), key=lambda kind: hashlib.sha256(kind.encode()).digest())
    count = min(max(1, round(share * len(order))), len(order) - 1)
    chosen = set(order[:count])
    return frozenset(name for name, kind in kinds.items() if kind in chosen)


@dataclass(frozen=True)
class PictureReference:
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


def looks(pictures: Pictures) -> Iterator[PictureReference]:
    """The pictures, none of whose pixels is read. Of a pair the left one."""
    for index, place in enumerate(pictures.places):
        camera = pictures.columns_of(place, ("camera/extrinsics", "camera/eye"))
        if camera["camera/eye"] == RIGHT:
            continue
        extrinsics = np.asarray(camera["camera/extrinsics"], float)
        found = pictures.scenes_of(place).grasps(place.scene, extrinsics)
        pose = compose(invert(pose_from_matrix(extrinsics)), found["object/pose"])
        rows = np.asarray(found["grasp/base_row"], np.intp)
        yield PictureReference(index, found["base_id"], place.file.id, place.scene, extrinsics, pose, rows)


#: The right eye of a pair, as `camera/eye` tells it.
RIGHT: Final = 2


def object_points(sample: Mapping[str, Any], index: int, noise: DepthNoise | None) -> Floats:
    """(P, 3) what a picture shows of the object, in the table's frame [m]; its number decides the noise."""
    view = CloudView.of(sample, noise, np.random.default_rng(index))
    return view.points(*view.pixels(whole=False))


def by_scene(found: Sequence[PictureReference]) -> dict[tuple[str, int], list[PictureReference]]:
    """Pictures of each scene of each views shard, in their order."""
    scenes: dict[tuple[str, int], list[PictureReference]] = {}
    for look in found:
        scenes.setdefault((look.shard, look.scene), []).append(look)
    return scenes


@dataclass
class ExportSummary:
    """What came of an export."""

    counts: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    """Lines for the user: what was assumed, what was left out and why."""


def plain_name(name: str) -> str:
    """A name fit for files and addresses; a long one is cut, which the log tells."""
    return fitted(re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "unnamed")


def prim_name(name: str) -> str:
    """A name that USD allows for a prim: ASCII letters, digits and underscores, no digit first."""
    plain = re.sub(r"[^A-Za-z0-9_]+", "_", name) or "_"
    return f"_{plain}" if plain[0].isdigit() else plain


def prim_names(names: Sequence[str]) -> list[str]:
    """Names of prims with one parent: no two are the same, later ones are numbered."""
    found: list[str] = []
    for name in map(prim_name, names):
        number = 1
        while (one := name if number == 1 else f"{name}_{number}") in found:
            number += 1
        found.append(one)
    return found
