"""Region of an object that grasps may touch."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.objects.parts import Voxels


@dataclass(frozen=True)
class ContactRegion:
    """Intersections of half-spaces (K, 4), n.x <= d as (n, d), object frame [m]; or voxels of a part."""

    touch: Floats | Voxels | None = None
    """Contacts must be inside; None: anywhere."""
    avoid: Floats | Voxels | None = None
    """Contacts must be outside; None: anywhere."""

    @property
    def is_whole(self) -> bool:
        return self.touch is None and self.avoid is None

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Return a mask (...) of places (..., 3) on the object that a grasp may touch."""
        out = np.ones(points.shape[:-1], bool)
        for planes, inside in ((self.touch, True), (self.avoid, False)):
            if isinstance(planes, Voxels):
                out &= planes.contains(points) == inside
            elif planes is not None:
                out &= (points @ planes[:, :3].T <= planes[:, 3]).all(axis=-1) == inside
        return out

    @property
    def forbidden(self) -> Voxels | None:
        """Voxels that a grasp must not touch; both voxel regions of an object have the same grid."""
        found = [(one, inside) for one, inside in ((self.touch, True), (self.avoid, False)) if isinstance(one, Voxels)]
        if not found:
            return None
        return replace(found[0][0], inside=np.any([one.inside != inside for one, inside in found], axis=0))


WHOLE: Final = ContactRegion()
