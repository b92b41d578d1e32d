"""What can be said of a scene before any worker has seen it."""

from __future__ import annotations

from typing import Final

import numpy as np

from service.index.views import AssetView
from service.model.domain import JobOptions
from service.model.errors import SceneError
from service.model.scene_spec import HalfSpace
from service.model.transforms import quat_conjugate, quat_rotate

#: A centre of mass may lie this deep in a support [m]: what is checked was measured on another mesh than is grasped.
_SUNK_M: Final = 1e-3


def check_scene(options: JobOptions, obj: AssetView) -> None:
    """Refuse a target whose centre of mass lies in a support: the centre is in the hull, so the hull stands there too.

    Where the check of the object did not measure its centre, and for all that needs the mesh, the first task tells.

    Raises:
        SceneError: the target stands in a support.
    """
    place, centre = options.place, obj.facts.get("centre_of_mass_m")
    if place.target is None or not isinstance(centre, list) or len(centre) != 3:
        return
    target = np.asarray(place.target)
    at = quat_rotate(target[3:], np.asarray(centre, float)) + target[:3]
    for number, support in enumerate(place.supports):
        if isinstance(support, HalfSpace):
            normal = np.asarray(support.normal)
            depth = float(support.offset - normal @ at) / float(np.linalg.norm(normal))
        else:
            pose = np.asarray(support.pose)
            inside = quat_rotate(quat_conjugate(pose[3:]), at - pose[:3])
            depth = float((np.asarray(support.size) / 2 - np.abs(inside)).min())
        if depth > _SUNK_M:
            raise SceneError(
                f"{obj.name} stands in support {number} of its scene: its centre lies {1e3 * depth:.0f} mm deep; move "
                "the target or the support"
            )
