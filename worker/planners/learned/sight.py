"""What a camera would see of an object as it lies: its visible points, found on its mesh."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np

from service.model.transforms import Floats, cross, quat_rotate
from worker.objects.model import ObjectModel

#: Elevation of a camera above the table [rad]; share of its field of view (half of it [rad]) that the object's bounding
#: ball fills; nearest distance of the ball [m]: as pictures of a job have them.
ELEVATION: Final = (np.radians(18.0), np.radians(62.0))
HALF_FIELD: Final = np.radians(20.0)
FILL: Final = (0.7, 1.0)
NEAREST_M: Final = 0.25
#: Points of the surface, and pixels across the bounding ball, each of which shows the nearest point in it: about five
#: visible ones fall into each, so that little shows through where a thing is hollow.
DENSE: Final = 32768
PIXELS: Final = 48


@dataclass(frozen=True)
class Seen:
    """The surface of an object as cameras look at it."""

    obj: ObjectModel
    points: Floats
    """(DENSE, 3) in the object frame [m]."""
    normals: Floats
    """(DENSE, 3) unit, outward."""

    @classmethod
    def of(cls, obj: ObjectModel) -> Seen:
        """Points even over the area, the same for the same object."""
        rng = np.random.default_rng(0)
        corners = obj.vertices[obj.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        sums = np.cumsum(area)
        face = np.minimum(np.searchsorted(sums, sums[-1] * rng.random(DENSE)), len(area) - 1)
        u, v = rng.random((2, DENSE, 1))
        u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
        a, b, c = np.moveaxis(corners[face], 1, 0)
        return cls(obj, a + u * (b - a) + v * (c - a), cross[face] / np.maximum(area[face, None], 1e-20))

    def camera(self, pose: Floats, rng: np.random.Generator) -> Floats:
        """(3,) where a camera that looks at the object at `pose` (7,), z up, stands [m]."""
        azimuth, fill = rng.uniform(0, 2 * np.pi), rng.uniform(*FILL)
        elevation = np.arcsin(rng.uniform(*np.sin(ELEVATION)))  # even over the sphere
        level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        toward = np.cos(elevation) * level + np.sin(elevation) * np.array([0, 0, 1.0])
        distance = max(NEAREST_M + self.obj.radius, self.obj.radius / np.sin(fill * HALF_FIELD))
        return np.asarray(self._middle(pose) + distance * toward)

    def cloud(self, pose: Floats, camera: Floats, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Points and normals (count, 3) of the object at `pose` (7,) that a camera sees: one a pixel, of which `count`
        are drawn."""
        points, normals = quat_rotate(pose[3:], self.points) + pose[:3], quat_rotate(pose[3:], self.normals)
        rays = points - camera
        facing = np.flatnonzero((normals * rays).sum(axis=1) < 0)
        toward = camera - self._middle(pose)
        distance = float(np.linalg.norm(toward))
        toward = toward / distance
        right = cross(np.array([0, 0, 1.0]), toward)
        right = right / np.linalg.norm(right)
        depth = -(rays[facing] @ toward)
        slopes = np.stack([rays[facing] @ right, rays[facing] @ cross(toward, right)], axis=1) / depth[:, None]
        widest = np.tan(np.arcsin(self.obj.radius / distance))
        pixel = np.clip((0.5 * (slopes / widest + 1) * PIXELS).astype(int), 0, PIXELS - 1) @ np.array([1, PIXELS])
        order = np.lexsort((depth, pixel))
        shown = facing[order[np.unique(pixel[order], return_index=True)[1]]]
        drawn = shown[rng.choice(len(shown), count, replace=len(shown) < count)]
        return points[drawn], normals[drawn]

    def _middle(self, pose: Floats) -> Floats:
        return np.asarray(quat_rotate(pose[3:], self.obj.centre_of_mass) + pose[:3])
