"""Lists of near faces for the cells of a distance grid; see `worker.simulation.kernels.nearest`."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from service.model.transforms import Floats
from worker.objects.model import ObjectModel
from worker.simulation.kernels import nearest


def faces_of(obj: ObjectModel) -> Any:
    """The object's faces about its centre of mass, on the present Warp device."""
    corners = (obj.vertices - obj.centre_of_mass)[obj.faces]
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    square = np.stack([(ab * ab).sum(1), (ab * ac).sum(1), (ac * ac).sum(1)], axis=1)
    face: Any = nearest.Face
    packed: Any = np.empty(len(corners), dtype=np.dtype(face.numpy_dtype()))
    for name, value in (("a", corners[:, 0]), ("ab", ab), ("ac", ac), ("square", square)):
        packed[name] = value
    faces = nearest.Faces()
    faces.face = wp.array(packed, dtype=face)
    faces.normal = wp.array(feature_normals(obj.vertices, obj.faces).reshape(-1, 3), dtype=wp.vec3)
    return faces


def feature_normals(vertices: Floats, faces: NDArray[np.integer[Any]]) -> Floats:
    """(F, 7, 3) angle-weighted normals, of any length: inside, edges ab, bc, ca, corners a, b, c of each face.

    Vertices at the same place count as one. Faces without an area have no say.
    """
    places, same = np.unique(vertices, axis=0, return_inverse=True)
    faces = same.reshape(-1)[faces]
    corner = places[faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 1e-14)
    out = np.empty((len(faces), nearest.FEATURES, 3))
    out[:, 0] = normal
    ends = np.stack([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]], axis=1)
    _, edge = np.unique(np.sort(ends, axis=2).reshape(-1, 2), axis=0, return_inverse=True)
    edge = edge.reshape(-1)
    out[:, 1:4] = _summed(edge, np.repeat(normal, 3, axis=0)).reshape(-1, 3, 3)
    side = np.roll(corner, -1, axis=1) - corner
    side /= np.maximum(np.linalg.norm(side, axis=2, keepdims=True), 1e-30)
    angle = np.arccos(np.clip(-(side * np.roll(side, 1, axis=1)).sum(axis=2), -1.0, 1.0))
    out[:, 4:] = _summed(faces.reshape(-1), (angle[..., None] * normal[:, None]).reshape(-1, 3)).reshape(-1, 3, 3)
    return out


def _summed(group: NDArray[np.integer[Any]], rows: Floats) -> Floats:
    """Each row's sum over its group (R, 3)."""
    total = np.zeros((int(group.max(initial=0)) + 1, 3))
    np.add.at(total, group, rows)
    return total[group]


def list_cells(faces: Any, mesh: Any, field: Any, low: Any, size: float, within: float) -> Any:
    """Lists of the `faces` of `faces_of` for the cells of the grid `field`, whose first corner is `low`, that come
    within so much of the surface."""
    cells = nearest.Cells()
    cells.faces = faces
    shape = [n - 1 for n in field.shape]
    radius = wp.zeros(int(np.prod(shape)), dtype=wp.float32)
    count = wp.zeros(len(radius), dtype=wp.int32)
    wp.launch(
        nearest.count_faces,
        len(radius),
        inputs=[mesh.id, cells.faces, low, size, field, within],
        outputs=[radius, count],
    )
    first = np.concatenate([[0], np.cumsum(count.numpy())])
    cells.first = wp.array(first, dtype=wp.int32)
    cells.face = wp.empty(int(first[-1]), dtype=wp.int32)
    cells.key = wp.empty(int(first[-1]), dtype=wp.float32)
    wp.launch(
        nearest.list_faces,
        len(radius),
        inputs=[mesh.id, cells.faces, low, size, wp.vec3i(*shape), radius, cells.first],
        outputs=[cells.face, cells.key],
    )
    return cells
