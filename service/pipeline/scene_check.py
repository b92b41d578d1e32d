"""What can be said of a scene before any worker has seen it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from service.index.views import AssetView
from service.model.domain import JobOptions
from service.model.errors import SceneError
from service.model.scene_spec import HalfSpace, Pose, Supports
from service.model.transforms import quat_conjugate, quat_rotate

#: A centre of mass may lie this deep in a support [m]: what is checked was measured on another mesh than is grasped.
_SUNK_M: Final = 1e-3


def check_scene(options: JobOptions, obj: AssetView, beside: Sequence[AssetView] = ()) -> None:
    """Refuse a thing whose centre of mass lies in a support: the centre is in the hull, so the hull stands there too.

    Where the check of an object did not measure its centre, and for all that needs meshes, the first task tells.

    Args:
        options: with the scene.
        obj: the object that is grasped.
        beside: the neighbours of the scene, in their order.

    Raises:
        SceneError: the target or a neighbour stands in a support.
    """
    place = options.place
    _check_pose(obj, "target", place.target, place.supports)
    for asset, one in zip(beside, place.neighbours, strict=True):
        _check_pose(asset, "neighbour", one.pose, place.supports)


def _check_pose(obj: AssetView, word: str, pose: Pose | None, supports: Supports) -> None:
    centre = obj.facts.get("centre_of_mass_m")
    if pose is None or not isinstance(centre, list) or len(centre) != 3:
        return
    target = np.asarray(pose)
    at = quat_rotate(target[3:], np.asarray(centre, float)) + target[:3]
    for number, support in enumerate(supports):
        if isinstance(support, HalfSpace):
            normal = np.asarray(support.normal)
            depth = float(support.offset - normal @ at) / float(np.linalg.norm(normal))
        else:
            box = np.asarray(support.pose)
            inside = quat_rotate(quat_conjugate(box[3:]), at - box[:3])
            depth = float((np.asarray(support.size) / 2 - np.abs(inside)).min())
        if depth > _SUNK_M:
            raise SceneError(
                f"{obj.name} stands in support {number} of its scene: its centre lies {1e3 * depth:.0f} mm deep; move "
                f"the {word} or the support"
            )
