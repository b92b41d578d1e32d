"""Pictures with the grasps of their scene, from views, scene and base shards."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model import transforms
from graspd.service.model.errors import InputError
from graspd.service.readers.files import ShardFile, Shards
from graspd.service.readers.rows import RowTable
from graspd.service.store import validity
from graspd.service.store.columns import check_column_names
from graspd.service.store.shards import open_shard, read_shard

if TYPE_CHECKING:
    from graspd.service.readers.clouds import Clouds

Array = NDArray[Any]

DEFAULT_COLUMNS: Final = (
    *("image/rgb", "image/depth", "image/segmentation"),
    *("camera/intrinsics", "camera/extrinsics", "box/bounding_box_2d_tight"),
)
_KEPT: Final = 64
#: Number of cached row tables of shards: about 1 kB each.
_TABLES: Final = 4096


@dataclass(frozen=True)
class PictureAddress:
    file: ShardFile
    scene_shard: str
    """Id of the shard with the scene: a scene shard, or a base shard with grasps planned in scenes."""
    scene: int
    row: int

    @property
    def names(self) -> dict[str, Any]:
        file = self.file
        return {"hand": file.hand, "object": file.object, "shard_id": file.id, "row": self.row, "scene": self.scene}


class Pictures(Sequence[dict[str, Any]]):
    """Pictures of views shards. `pictures[i]` is a dictionary of column rows and the grasps of its scene.

    The grasps are arrays of K rows, where K differs between scenes and may be 0:

        grasp/hand_pose (K, 7) in the camera frame [m], quaternion w x y z
        grasp/joint_positions (K, J) [rad or m]
        grasp/base_row (K,) row in the base shard `base_id`
        quality/epsilon and other `grasp_quality` columns (K, ...)

    `object/pose` (7,) is the pose of the object in the camera frame. The left picture of a stereo pair comes first.
    """

    def __init__(
        self,
        shards: Shards,
        columns: Sequence[str] = DEFAULT_COLUMNS,
        *,
        grasp_quality: Sequence[str] = ("quality/epsilon",),
        clear: bool = True,
        valid: bool = True,
        unvalidated: bool = False,
        with_grasps_only: bool = False,
    ) -> None:
        """Args:
            shards: views shards, and their scene and base shards.
            columns: columns of the picture in a sample.
            grasp_quality: base columns of the grasps.
            clear: only grasps that are clear of table and neighbours in this scene.
            valid: only valid grasps; False: all grasps of the base shards.
            unvalidated: select instead only feasible grasps without validation.
            with_grasps_only: omit pictures of scenes without a grasp.

        Raises InputError for an unknown column, NotFoundError for a missing scene or base shard.
        """
        check_column_names("views", columns)
        check_column_names("base", grasp_quality)
        self.shards, self.columns, self._quality = shards, tuple(columns), tuple(grasp_quality)
        self._which = {"clear": clear, "valid": valid, "unvalidated": unvalidated}
        self._scenes: OrderedDict[str, Scenes] = OrderedDict()
        self._tables: OrderedDict[str, RowTable] = OrderedDict()
        self.places: list[PictureAddress] = []
        for file in shards.of_kind("views"):
            self._add(file, with_grasps_only=with_grasps_only)

    def __len__(self) -> int:
        return len(self.places)

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[i] for i in range(*index.indices(len(self)))]
        place = self.places[index]
        sample = self.columns_of(place, {*self.columns, "camera/extrinsics"})
        extrinsics = np.asarray(sample["camera/extrinsics"], float)
        sample = {name: sample[name] for name in self.columns}
        return sample | self.scenes_of(place.scene_shard).grasps(place.scene, extrinsics) | place.names

    def columns_of(self, place: PictureAddress, columns: Iterable[str]) -> dict[str, Array]:
        wanted = list(columns)
        return self._table(place.file, wanted).row(self.shards.path(place.file), place.row, wanted)

    def clouds(self, points: int = 1024, **options: Any) -> Clouds:
        """Return the pictures as labelled point clouds; see `Clouds` for the options."""
        from graspd.service.readers.clouds import Clouds

        return Clouds(self, points, **options)

    def _add(self, file: ShardFile, *, with_grasps_only: bool) -> None:
        with open_shard(self.shards.path(file)) as opened:
            scenes = np.asarray(opened["camera/scene_index"])
            # For grasps planned in scenes, the base shard contains the scenes.
            scene_shard = str(opened.attrs.get("base_shard") or opened.attrs.get("scene_shard") or "")
            if not scene_shard:
                raise InputError(f"shard {file.id} lacks the name of its scene shard; render it again: graspd render")
            if absent := [name for name in self.columns if name not in opened]:
                raise InputError(f"shard {file.id[:12]} of {file.object} has no column {absent[0]!r}")
        held = self.scenes_of(scene_shard)
        for row, scene in enumerate(scenes):
            if not with_grasps_only or len(held.base_rows(int(scene))):
                self.places.append(PictureAddress(file, scene_shard, int(scene), row))

    def _table(self, file: ShardFile, columns: Sequence[str]) -> RowTable:
        table = self._tables.get(file.id)
        known = table.columns if table else set()
        if table is None or not known >= set(columns):
            with open_shard(self.shards.path(file)) as opened:
                table = RowTable.from_file(opened, {*columns, *known}, str(file.path or file.key))
            self._tables[file.id] = table
            if len(self._tables) > _TABLES:
                self._tables.popitem(last=False)
        return table

    def scenes_of(self, shard: str) -> Scenes:
        found = self._scenes.get(shard)
        if found is None:  # Concurrent threads may both read the scenes, with equal results.
            found = self._scenes[shard] = Scenes(self.shards, shard, self._quality, **self._which)
            if len(self._scenes) > _KEPT:
                self._scenes.popitem(last=False)
        return found


class Scenes:
    """Scenes of one shard with their grasps: a scene shard, or a base shard with grasps planned in scenes.

    `base` is the base shard of the grasps, `base_id` its id.
    """

    def __init__(
        self, shards: Shards, shard: str, quality: Sequence[str], *, clear: bool, valid: bool, unvalidated: bool
    ) -> None:
        file = shards.by_id(shard)
        scenes = read_shard(shards.path(file), kind=file.kind)
        planned = file.kind == "base"
        self.base_id = shard if planned else str(scenes.attributes["base_shard"])
        self.base = base = scenes if planned else read_shard(shards.path(shards.by_id(self.base_id)), kind="base")
        self._object = np.asarray(scenes["scene/object_pose"], float)
        scene = np.asarray(scenes["grasp/scene_index"])
        row = np.arange(len(scene)) if planned else np.asarray(scenes["grasp/base_index"])
        free = np.asarray(base["quality/success"]) >= 0 if planned else np.asarray(scenes["grasp/valid"]) == 1
        mask = free if clear else np.ones(len(scene), bool)
        if valid or unvalidated:
            mask = mask & validity.selection_mask(base.arrays, unvalidated=unvalidated)[row]
        kept = np.flatnonzero(mask)
        self._scene, self._row = scene[kept], row[kept]
        pose = np.asarray(scenes["grasp/hand_pose"], float)[kept]
        self._pose = transforms.compose(self._object[self._scene], pose) if planned else pose
        columns = [name for name in ("grasp/joint_positions", *quality) if name in base.arrays]
        self._columns = {name: np.asarray(base[name])[self._row] for name in columns}

    def object_pose(self, scene: int) -> NDArray[np.float64]:
        return self._object[scene]

    def base_rows(self, scene: int) -> NDArray[np.intp]:
        return self._row[self._rows_of_scene(scene)]

    def _rows_of_scene(self, scene: int) -> NDArray[np.intp]:
        return np.flatnonzero(self._scene == scene)

    def grasps(self, scene: int, extrinsics: NDArray[np.float64]) -> dict[str, Any]:
        """Return the grasps of one scene in the frame of the camera with these extrinsics (4, 4)."""
        rows, camera = self._rows_of_scene(scene), transforms.pose_from_matrix(extrinsics)
        pose = transforms.compose(camera, self._pose[rows])
        found: dict[str, Any] = {"grasp/hand_pose": pose, "grasp/base_row": self._row[rows], "base_id": self.base_id}
        found["object/pose"] = transforms.compose(camera, self._object[scene])
        return found | {name: column[rows] for name, column in self._columns.items()}
