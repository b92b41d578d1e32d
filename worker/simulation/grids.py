"""Distance grid of an object, and lists of the faces near each cell.

They depend on the object, the cell size and `phong_alpha`, not on the hand. Processes on a CPU cache them on disk,
since they take a fifth of the time until a first grasp. A GPU computes them faster than a file is read."""

import sys
from collections.abc import Mapping
from functools import partial
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.engines.backend import binary_identity
from graspd.worker.objects.disk_cache import cached_arrays
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.topology import edge_faces, face_vectors
from graspd.worker.simulation.kernels import nearest, surface

Arrays = Mapping[str, NDArray[Any]]

FIELD_REACH: Final = 0.06  # margin of the grid around the object's bounding box [m]
LISTED_M: Final = 0.004  # cells closer to the surface than this plus the grid's error list their nearest faces [m]
_MOST_CELLS: Final = 96  # largest number of cells a side; a coarser grid has a larger `field_error`


def add_grid(skin: Any, obj: ObjectModel, mesh: Any, cell: float) -> None:
    """Add the distance grid and the lists of its cells to a surface, on the current Warp device.
    `skin` is a `surface.Surface` with `cells.faces`; `mesh` is its `warp.Mesh`, vertices about the centre of mass;
    `cell` is the least cell size of the grid [m]."""
    low = obj.vertices.min(axis=0) - obj.centre_of_mass - FIELD_REACH
    high = obj.vertices.max(axis=0) - obj.centre_of_mass + FIELD_REACH
    cell = max(cell, float((high - low).max()) / _MOST_CELLS)
    shape = tuple(int(n) for n in np.ceil((high - low) / cell).astype(int) + 1)
    skin.field_origin = wp.vec3(*low)
    skin.field_cell = cell
    # A distance has slope at most 1, so interpolation errs by less than half a diagonal; half a cell is allowed for.
    skin.field_error = 0.5 * cell

    def fill() -> None:
        skin.field = _sample_field(skin, shape)
        grid = (skin.field, skin.field_origin, skin.field_cell)
        skin.cells = list_cells(skin.cells.faces, mesh, *grid, LISTED_M + skin.field_error)

    if not wp.get_device().is_cpu:
        fill()
        return

    def make() -> Arrays:
        fill()
        return {"field": skin.field.numpy(), **{name: getattr(skin.cells, name).numpy() for name in _LISTS}}

    terms = (obj.content, repr(cell), repr(float(skin.alpha)), *map(binary_identity, (surface, nearest)))
    fits = partial(_is_valid_grid, shape=shape, faces=len(obj.faces))
    kept = cached_arrays("object_grids", terms, (sys.modules[__name__],), make, fits=fits)
    skin.field = wp.array(kept["field"], dtype=wp.float32)
    for name, kind in _LISTS.items():
        setattr(skin.cells, name, wp.array(kept[name], dtype=kind))


#: Arrays of the cells' lists, see `nearest.Cells`.
_LISTS: Final = {"first": wp.int32, "face": wp.int32, "key": wp.float32}


def _sample_field(skin: Any, shape: tuple[int, ...]) -> Any:
    field, inputs = wp.empty(shape, dtype=wp.float32), [skin, skin.field_origin, skin.field_cell, 4 * FIELD_REACH]
    wp.launch(surface.sample_field, dim=shape, inputs=inputs, outputs=[field])
    return field


def _is_valid_grid(kept: Arrays, shape: tuple[int, ...], faces: int) -> bool:
    """Check whether arrays fit a grid of this shape over `faces` faces, so that kernels stay in bounds."""
    kinds = {"field": np.float32, "first": np.int32, "face": np.int32, "key": np.float32}
    if set(kept) != set(kinds) or any(kept[name].dtype != kind for name, kind in kinds.items()):
        return False
    field, first, face, key = (kept[name] for name in kinds)
    count = int(np.prod([n - 1 for n in shape]))
    return bool(
        field.shape == shape
        and first.shape == (count + 1,)
        and face.shape == key.shape == (int(first[-1]),)
        and first[0] == 0
        and (np.diff(first) >= 0).all()
        and (len(face) == 0 or (face.min() >= 0 and face.max() < faces))
    )


def upload_faces(obj: ObjectModel) -> Any:
    """Return the object's faces about its centre of mass, on the current Warp device."""
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
    """Return unnormalised angle-weighted normals (F, 7, 3): inside, edges ab, bc, ca, corners a, b, c.
    Vertices at the same place count as one; faces without an area are ignored."""
    places, same = np.unique(vertices, axis=0, return_inverse=True)
    faces = same.reshape(-1)[faces]
    corner = places[faces]
    normal = face_vectors(places, faces)
    length = np.linalg.norm(normal, axis=1, keepdims=True)
    normal = np.divide(normal, length, out=np.zeros_like(normal), where=length > 1e-14)
    out = np.empty((len(faces), nearest.FEATURES, 3))
    out[:, 0] = normal
    edge = edge_faces(faces.astype(np.int64))[0].reshape(3, -1).T.reshape(-1)
    out[:, 1:4] = _group_sums(edge, np.repeat(normal, 3, axis=0)).reshape(-1, 3, 3)
    side = np.roll(corner, -1, axis=1) - corner
    side /= np.maximum(np.linalg.norm(side, axis=2, keepdims=True), 1e-30)
    angle = np.arccos(np.clip(-(side * np.roll(side, 1, axis=1)).sum(axis=2), -1.0, 1.0))
    out[:, 4:] = _group_sums(faces.reshape(-1), (angle[..., None] * normal[:, None]).reshape(-1, 3)).reshape(-1, 3, 3)
    return out


def _group_sums(group: NDArray[np.integer[Any]], rows: Floats) -> Floats:
    """Return the sum (R, 3) of each row's group."""
    total = np.zeros((int(group.max(initial=0)) + 1, 3))
    np.add.at(total, group, rows)
    return total[group]


def list_cells(faces: Any, mesh: Any, field: Any, low: Any, size: float, within: float) -> Any:
    """Return `nearest.Cells`: lists for cells of grid `field`, first corner `low`, within `within` [m]."""
    cells = nearest.Cells()
    cells.faces = faces
    shape = [n - 1 for n in field.shape]
    radius = wp.zeros(int(np.prod(shape)), dtype=wp.float32)
    count = wp.zeros(len(radius), dtype=wp.int32)
    inputs = [mesh.id, cells.faces, low, size, field, within]
    wp.launch(nearest.count_faces, len(radius), inputs=inputs, outputs=[radius, count])
    first = np.concatenate([[0], np.cumsum(count.numpy())])
    cells.first = wp.array(first, dtype=wp.int32)
    cells.face = wp.empty(int(first[-1]), dtype=wp.int32)
    cells.key = wp.empty(int(first[-1]), dtype=wp.float32)
    inputs = [mesh.id, cells.faces, low, size, wp.vec3i(*shape), radius, cells.first]
    wp.launch(nearest.list_faces, len(radius), inputs=inputs, outputs=[cells.face, cells.key])
    return cells
