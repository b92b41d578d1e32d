"""Visual elements of a hand's links with their colours and mesh files, loaded at the first use.

Only pictures need visual elements. An unreadable file is therefore left out and does not make a hand unusable."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import count
from typing import Final

import numpy as np

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats, apply
from graspd.service.store.mesh_files import MAX_NAMES, appearance_files, find_mesh, resolve_appearance_file
from graspd.worker.hands.primitives import tessellate
from graspd.worker.hands.robot import Ints, Shape
from graspd.worker.objects.formats import Nearby, Soup, read_mesh
from graspd.worker.objects.topology import drop_unused_vertices

#: Largest total number of faces of a hand's visual meshes: more would not change a picture.
MAX_FACES: Final = 400_000


@dataclass(frozen=True)
class VisualMesh:
    """Triangle mesh of one colour on a body."""

    body: int
    vertices: Floats  # (V, 3) in the body frame [m]
    faces: Ints  # (F, 3)
    colour: tuple[float, float, float] | None  # sRGB, 0 .. 1; None if not stated.


@dataclass(frozen=True)
class PlacedShape:
    """Visual element, its body, its pose (7,) in the body's frame, and its link."""

    shape: Shape
    body: int
    pose: Floats
    link: str


@dataclass(frozen=True)
class Visuals:
    """Visual elements of a hand; `meshes` loads their files at the first use."""

    placed: Sequence[PlacedShape] = ()
    files: Mapping[str, bytes] = field(default_factory=dict, repr=False)
    base: str = ""  # folder of the robot's description inside `files`

    @cached_property
    def content(self) -> str:
        """Digest of all data that determine the meshes."""
        whole = hashlib.sha256()
        for item in self.placed:
            shape = item.shape
            whole.update(repr((item.body, item.link, shape.kind, shape.size, shape.filename, shape.colour)).encode())
            whole.update(np.round(item.pose, 12).tobytes())
            for part in shape.mesh or ():
                whole.update(np.ascontiguousarray(part).tobytes())
            if shape.filename and (name := _file_of(item, self.files, self.base)):
                for file in (name, *appearance_files(name, self.files)):
                    whole.update(hashlib.sha256(self.files[file]).digest())
        return whole.hexdigest()[:32]

    @cached_property
    def meshes(self) -> tuple[VisualMesh, ...]:
        """Return all readable meshes, up to `MAX_FACES` triangles."""
        found: list[VisualMesh] = []
        soups: dict[str, Soup] = {}
        left = MAX_FACES
        for item in self.placed:
            for mesh in _visual_meshes(item, self.files, self.base, soups):
                left -= len(mesh.faces)
                if left >= 0:
                    found.append(mesh)
        return tuple(found)


NO_VISUALS: Final = Visuals()


def thin_mesh(mesh: VisualMesh, times: float) -> VisualMesh:
    vertices, faces = merge_and_thin(mesh.vertices, mesh.faces, lambda _: 1 - 1 / times)
    return replace(mesh, vertices=vertices, faces=faces) if len(faces) else mesh


def merge_and_thin(vertices: Floats, faces: Ints, share: Callable[[int], float]) -> tuple[Floats, Ints]:
    """Merge equal vertices, then drop the share of faces that `share` returns for their number."""
    # Both are slow to load and not needed for cached results.
    import fast_simplification
    import trimesh

    merged = trimesh.Trimesh(vertices, faces, process=True)
    points, triangles = np.asarray(merged.vertices, float), np.asarray(merged.faces, np.int32)
    if (dropped := share(len(triangles))) > 0:
        points, triangles = fast_simplification.simplify(points.astype(np.float32), triangles, target_reduction=dropped)
    return np.asarray(points, float), np.asarray(triangles, np.int32)


def _visual_meshes(
    item: PlacedShape, files: Mapping[str, bytes], base: str, soups: dict[str, Soup]
) -> list[VisualMesh]:
    shape = item.shape
    if shape.kind != "mesh":
        vertices, faces = tessellate(shape.kind, shape.size)
        return [VisualMesh(item.body, apply(item.pose, vertices), faces, shape.colour)]
    if shape.mesh is not None:
        return [VisualMesh(item.body, apply(item.pose, shape.mesh[0]), shape.mesh[1], shape.colour)]
    name = _file_of(item, files, base)
    if not name:
        return []
    try:
        if name not in soups:
            soups[name] = read_mesh(name, files[name], _file_lookup(name, files))
    except InputError:
        return []
    soup, scale = soups[name], np.asarray(shape.size)
    vertices = apply(item.pose, soup.vertices * scale)
    winding = 1 if np.prod(scale) > 0 else -1
    found = []
    for colour, chosen in soup.by_colour():
        points, triangles = drop_unused_vertices(vertices, soup.faces[chosen, ::winding])
        found.append(VisualMesh(item.body, points, triangles.astype(np.int32), shape.colour or colour))
    return found


def _file_lookup(mesh: str, files: Mapping[str, bytes]) -> Nearby:
    """Return a lookup of the hand's files that a mesh and its material libraries name, up to `MAX_NAMES`."""
    naming, lookups = [mesh], count()

    def find(reference: str) -> bytes | None:
        if next(lookups) >= MAX_NAMES:
            return None
        found = (resolve_appearance_file(one, reference, files.__contains__) for one in reversed(naming))
        if (name := next(filter(None, found), None)) is None:
            return None
        if name.lower().endswith(".mtl"):
            naming.append(name)
        return files[name]

    return find


def _file_of(item: PlacedShape, files: Mapping[str, bytes], base: str) -> str:
    try:
        return find_mesh(item.shape.filename, files, base, item.link)
    except InputError:
        return ""
