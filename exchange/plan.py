"""Plan of an export for training: grasps of many shards, pictures, splits, names, and the summary."""

import hashlib
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain, count
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from typer import Option

from graspd.service.model.names import shorten_name
from graspd.service.model.transforms import Floats, compose, invert, pose_from_matrix
from graspd.service.readers import Pictures
from graspd.service.store.shards import Shard
from graspd.worker.files.subsets import EveryOption, UnvalidatedOption
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import PlacedGrasps


@dataclass(frozen=True)
class ExportOptions:
    """Options of `graspd export`."""

    hand: Annotated[str | None, Option(help="Hand file; default: found by its digest.")] = None
    obj: Annotated[str | None, Option("--object", help="Object file; default: found by its digest.")] = None
    unvalidated: UnvalidatedOption = False
    every: EveryOption = False
    depth: Annotated[str, Option(help="Depth: exr (float, metres) or png (16 bit, steps of 0.1 mm).")] = "exr"
    best: Annotated[int, Option(min=0, help="For robots: number of best grasps by epsilon; 0: all.")] = 0
    tool: Annotated[
        str | None, Option("--tool-frame", help="For robots: link of the hand, or x y z qw qx qy qz in its root.")
    ] = None
    speed: Annotated[float, Option(help="For robots: share of the velocity limits.")] = 0.5
    arm: Annotated[str | None, Option(help="For robots: ur10e, franka or a URDF; grasps in reach.")] = None
    mount: Annotated[str | None, Option(help="Link of the arm on which the hand is mounted.")] = None
    base: Annotated[str | None, Option(help="Pose of the arm's base in the scene or object: x y z qw qx qy qz.")] = None
    mount_pose: Annotated[str | None, Option(help="Pose of the hand in the mount: x y z qw qx qy qz.")] = None
    held_out: Annotated[float, Option(help="For training and splits: share of held-out objects.")] = 0.2
    noise: Annotated[str, Option(help="For training: noise of depth, stereo or structured_light.")] = ""


@dataclass(frozen=True)
class ExportPart:
    """Exported grasps of one base shard."""

    id: str
    name: str  # name of the object, fit for files; a repeated name gets a part of the later object's digest
    hand: HandModel
    obj: ObjectModel
    grasps: GraspSet
    rows: NDArray[np.intp]
    verdict: NDArray[np.int8]  # (N,) verdicts: 1 held, 0 dropped, -1 not validated
    shard: Shard
    placed: PlacedGrasps | None = None

    @property
    def id_hash(self) -> str:
        """Part of file names that distinguishes shards of one object."""
        return hashlib.sha256(self.id.encode()).hexdigest()[:8]


def held_out_objects(kinds: Mapping[str, str], share: float) -> frozenset[str]:
    """Return the objects of a share of the families, which a hash selects.
    `kinds` has the family of each object. At least one family is held out and at least one is not; a single family is
    not held out."""
    order = sorted(set(kinds.values()), key=lambda kind: hashlib.sha256(kind.encode()).digest())
    chosen = order[: min(max(1, round(share * len(order))), len(order) - 1)]
    return frozenset(name for name, kind in kinds.items() if kind in chosen)


@dataclass(frozen=True)
class PictureReference:
    """One picture: its index among the pictures, and its scene."""

    index: int
    base: str  # id of the shard with the scene's grasps
    shard: str  # id of the views shard
    scene: int
    extrinsics: Floats  # (4, 4) transformation from the table's frame to the camera's
    object_pose: Floats  # (7,) object pose in the table's frame
    rows: NDArray[np.intp]  # rows of the base shard whose grasps belong to this scene


def pictures_without_pixels(pictures: Pictures) -> Iterator[PictureReference]:
    """Yield references to all pictures, except right pictures of stereo pairs."""
    for index, place in enumerate(pictures.places):
        camera = pictures.columns_of(place, ("camera/extrinsics", "camera/eye"))
        if camera["camera/eye"] == RIGHT:
            continue
        extrinsics = np.asarray(camera["camera/extrinsics"], float)
        found = pictures.scenes_of(place.scene_shard).grasps(place.scene, extrinsics)
        pose = compose(invert(pose_from_matrix(extrinsics)), found["object/pose"])
        rows = np.asarray(found["grasp/base_row"], np.intp)
        yield PictureReference(index, found["base_id"], place.file.id, place.scene, extrinsics, pose, rows)


RIGHT: Final = 2  # value of `camera/eye` for the right picture of a stereo pair


def group_by_scene(pictures: Pictures) -> list[list[PictureReference]]:
    """Return the pictures of each scene of each views shard."""
    scenes: dict[tuple[str, int], list[PictureReference]] = defaultdict(list)
    for look in pictures_without_pixels(pictures):
        scenes[look.shard, look.scene].append(look)
    return list(scenes.values())


@dataclass
class ExportSummary:
    """Result of an export."""

    counts: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    """Messages for the user: assumptions, omissions and their reasons."""


def plain_name(name: str) -> str:
    """Return a name fit for files and URLs; long names are cut, with a log message."""
    return shorten_name(re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-.") or "unnamed")


def prim_name(name: str) -> str:
    """Return a valid USD prim name: ASCII letters, digits and underscores, no leading digit."""
    plain = re.sub(r"[^A-Za-z0-9_]+", "_", name) or "_"
    return f"_{plain}" if plain[0].isdigit() else plain


def prim_names(names: Sequence[str]) -> list[str]:
    """Return names of prims with one parent; repeated ones are numbered."""
    found: list[str] = []
    for name in map(prim_name, names):
        numbered = chain([name], (f"{name}_{number}" for number in count(2)))
        found.append(next(one for one in numbered if one not in found))
    return found
