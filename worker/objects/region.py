"""Region of an object that grasps may touch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats


@dataclass(frozen=True)
class ContactRegion:
    """Intersections of half-spaces (K, 4): n.x <= d as (n, d), object frame [m]."""

    touch: Floats | None = None
    """Contacts must be inside; None: anywhere."""
    avoid: Floats | None = None
    """Contacts must be outside; None: anywhere."""

    @property
    def is_whole(self) -> bool:
        return self.touch is None and self.avoid is None

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Return a mask (...) of places (..., 3) on the object that a grasp may touch."""
        out = np.ones(points.shape[:-1], bool)
        for planes, inside in ((self.touch, True), (self.avoid, False)):
            if planes is not None:
                out &= (points @ planes[:, :3].T <= planes[:, 3]).all(axis=-1) == inside
        return out


WHOLE: Final = ContactRegion()
