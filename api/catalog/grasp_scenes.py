"""What a base shard says of the scene of one grasp and of its way there: approach, grasp, lift."""

from __future__ import annotations

import math
import re
from itertools import zip_longest
from typing import Final

from api.models import GraspScene, Neighbour, Waypoint
from service.model.scene_kinds import supports_in
from service.readers.ways import scene_spec_of, stop_places, way_of
from service.store.columns import SCHEMAS
from service.store.shards import Shard

_LIFT: Final = "quality/lift_outcome"
#: What the numbers of the column mean, as its description in the schema says.
LIFT_OUTCOMES: Final = {
    int(code): words for code, words in re.findall(r"(\d) ([a-z ]+)", SCHEMAS["base"][_LIFT].description)
}


def way(file: Shard, row: int) -> list[Waypoint]:
    """The postures of a grasp in turn."""
    points = way_of(file, row)
    return [
        Waypoint(
            name=point.name,
            place=place,
            hand_pose=point.hand_pose.tolist(),
            joint_positions=point.joint_positions.tolist(),
            carried=point.carried.tolist(),
        )
        for point, place in zip(points, stop_places(points).tolist(), strict=True)
    ]


def scene(file: Shard, row: int) -> GraspScene | None:
    """The scene of a grasp; None if it was planned around a free object.

    Raises:
        InputError: what the shard says of its scene is no scene.
    """
    spec = scene_spec_of(file)
    if spec is None or spec.kind == "free" or "grasp/scene_index" not in file.arrays:
        return None
    number = int(file["grasp/scene_index"][row])
    tried = int(file[_LIFT][row]) if _LIFT in file.arrays else 0
    clearance = float(file["quality/clearance_m"][row]) if "quality/clearance_m" in file.arrays else math.nan
    return GraspScene(
        kind=spec.kind,
        number=number,
        object_pose=file["scene/object_pose"][number].tolist(),
        supports=list(supports_in(spec)),
        neighbours=_neighbours(file, number),
        clearance_m=clearance if math.isfinite(clearance) else None,
        lift=LIFT_OUTCOMES.get(tried, "unknown") if tried else None,
        lift_hard=_verdict(file, "quality/lift_hard", row),
    )


def _neighbours(file: Shard, number: int) -> list[Neighbour]:
    if "scene/neighbour_pose" not in file.arrays:
        return []
    names, digests = (file.attributes.get(key) for key in ("neighbours", "neighbour_digests"))
    poses = file["scene/neighbour_pose"][number].tolist()
    known = zip_longest(names if isinstance(names, list) else [], digests if isinstance(digests, list) else [])
    return [
        Neighbour(name=str(name), digest=str(digest), pose=pose)
        for (name, digest), pose in zip(known, poses, strict=False)
    ]


def _verdict(file: Shard, path: str, row: int) -> bool | None:
    column = file.arrays.get(path)
    return None if column is None or column[row] < 0 else bool(column[row])
