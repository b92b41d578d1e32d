"""An object from its files: read, repaired, simplified, with normals, hull and mass properties.

What one command has prepared on this machine, every later one reads in milliseconds.
"""

from __future__ import annotations

import hashlib
import platform
import zipfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from service import user_cache
from service.model.digests import digest_files, digest_json, digest_variant
from service.model.errors import MeshError, NotFoundError, did_you_mean
from service.model.libraries import version_of
from service.model.states import AssetKind
from service.model.transforms import Floats
from service.store.assets import builtin_files, builtin_names, unpack_file
from worker.objects.formats import READERS, read_mesh
from worker.objects.mass import mass_properties
from worker.objects.model import Ints, ObjectModel
from worker.objects.normals import corner_normals
from worker.objects.options import OF_MATTER, ObjectOptions, parse_options
from worker.objects.packed import from_bytes, to_bytes
from worker.objects.repair import Repaired, repair
from worker.objects.simplify import simplify

#: Names of files that say nothing of what is in them: the objects of such a set differ by their folders.
PLAIN_STEMS: Final = ("clean", "mesh", "model", "textured", "nontextured", "simplified")
#: Libraries whose results go into a prepared object.
_LIBRARIES: Final = ("numpy", "scipy", "manifold3d", "fast-simplification")


def load_object(
    files: Mapping[str, bytes], *, name: str, digest: str, face_error_m: float, options: Mapping[str, Any] | None = None
) -> ObjectModel:
    """The object that `files` describe.

    Args:
        files: the mesh (STL, OBJ, PLY, OFF or GLB) and, if there is more to say, `asset.json` (see `ObjectOptions`).
        name: name of the object.
        digest: digest of its files.
        face_error_m: the prepared surface lies within this distance of the uploaded one [m]; 0: no simplification.
        options: keys that go over those of `asset.json`.

    Raises:
        MeshError: the mesh cannot be used; the message names what is wrong and the mend.
    """
    settings = parse_options(files, options)
    main = main_file(files, settings)
    shape = settings.model_dump_json(exclude=set(OF_MATTER))
    model = replace(_prepared(main, files[main], shape, float(face_error_m)), name=name, digest=digest)
    return weighed(model, settings)


def weighed(model: ObjectModel, options: ObjectOptions) -> ObjectModel:
    """The model with the mass and friction that its options say."""
    return model.weighing(mass=options.mass, density=options.density, friction=options.friction)


def main_file(files: Mapping[str, bytes], options: ObjectOptions) -> str:
    """Name of the mesh: as `asset.json` says, else the only one."""
    if options.file:
        if options.file not in files:
            raise MeshError(f"asset.json names the file {options.file!r}, which is not there")
        return options.file
    found = sorted(name for name in files if Path(name).suffix.lower() in READERS)
    if len(found) == 1:
        return found[0]
    others = sorted(name for name in files if name != "asset.json")
    if not found and len(others) == 1:
        return others[0]
    raise MeshError(f'{len(found)} meshes among the object\'s files; name one in asset.json under "file"')


@lru_cache(maxsize=8)
def _prepared(main: str, data: bytes, options_json: str, face_error_m: float) -> ObjectModel:
    """Cached by content: every batch of a job asks for the same object, and every command for the same few."""
    return kept_or_made(
        (Path(main).suffix.lower(), options_json, repr(face_error_m)),
        data,
        lambda: build(repaired_mesh(main, data, ObjectOptions.model_validate_json(options_json)), face_error_m),
    )


def repaired_mesh(main: str, data: bytes, options: ObjectOptions) -> Repaired:
    """The mesh of a file as a solid in metres; errors name the file."""
    return _repaired(main, data, options.model_dump_json())


@lru_cache(maxsize=2)
def _repaired(main: str, data: bytes, options_json: str) -> Repaired:
    """Kept for a while: it is the same for every bound of the simplification."""
    soup = read_mesh(main, data)
    try:
        return repair(soup, ObjectOptions.model_validate_json(options_json))
    except MeshError as error:
        raise MeshError(f"{main}: {error}", facts=error.facts) from None


def build(mesh: Repaired, face_error_m: float) -> ObjectModel:
    """The model of a repaired mesh."""
    vertices, faces, error = simplify(mesh.vertices, mesh.faces, face_error_m, closed=mesh.watertight)
    hull_vertices, hull_faces = convex_hull(vertices)
    solid = (vertices, faces.astype(np.int32)) if mesh.watertight else (hull_vertices, hull_faces)
    mass = mass_properties(*solid)
    middle = ObjectModel(
        name="",
        digest="",
        vertices=vertices,
        faces=faces.astype(np.int32),
        corner_normals=corner_normals(vertices, faces.astype(np.int32)),
        volume=mass.volume,
        centre_of_mass=mass.centre_of_mass,
        inertia=mass.inertia,
        radius=float(np.linalg.norm(vertices - mass.centre_of_mass, axis=1).max()),
        hull_vertices=hull_vertices,
        hull_faces=hull_faces,
        watertight=mesh.watertight,
        deviation_m=error,
        repairs=mesh.repairs,
    )
    return middle.at(mesh.centre)


def convex_hull(points: Floats) -> tuple[Floats, Ints]:
    """Corners (H, 3) and outward triangles (G, 3)."""
    from scipy.spatial import ConvexHull, QhullError

    try:
        qhull = ConvexHull(points)
    except QhullError:
        raise MeshError("the mesh is flat; give it a thickness") from None
    keep, inverse = np.unique(qhull.simplices, return_inverse=True)
    faces: Ints = inverse.reshape(-1, 3).astype(np.int32)
    vertices = points[keep]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    inward = np.einsum("ij,ij->i", np.cross(b - a, c - a), qhull.equations[:, :3]) < 0
    faces[inward] = faces[inward][:, ::-1]
    return vertices, faces


def object_from_path(
    path: str | Path, face_error_m: float = 3e-4, options: Mapping[str, Any] | None = None
) -> ObjectModel:
    """An object for the command line: name of a built-in, a mesh file, or a ZIP.

    Raises:
        NotFoundError: neither a file nor a built-in object.
        MeshError: see `load_object`.
    """
    name, files, stated = files_from_path(path)
    return load_object(
        files,
        name=name,
        digest=digest_variant(digest_files(AssetKind.OBJECT, files), options),
        face_error_m=face_error_m,
        options={**stated, **(options or {})},
    )


def files_from_path(path: str | Path) -> tuple[str, dict[str, bytes], dict[str, Any]]:
    """Name, files and further options of the object at `path`."""
    path = Path(path)
    if not path.is_file():
        if str(path) in builtin_names(AssetKind.OBJECT):
            return str(path), builtin_files(AssetKind.OBJECT, str(path)), {}
        known = builtin_names(AssetKind.OBJECT)
        meant = did_you_mean(str(path), known)
        raise NotFoundError(f"{path} is neither a file nor a built-in object ({', '.join(known)}){meant}")
    if path.suffix.lower() == ".zip":
        return path.stem, unpack_file(path), {}
    files = {path.name: path.read_bytes()}
    beside = path.parent / "asset.json"
    if beside.is_file():
        files["asset.json"] = beside.read_bytes()
        return name_of(path), files, {"file": path.name}
    return name_of(path), files, {}


def name_of(path: Path) -> str:
    """Name of the object in a mesh file: the file's, or its folder's where files of all objects are called the same."""
    return path.resolve().parent.name if path.stem.lower() in PLAIN_STEMS else path.stem


def kept_or_made(terms: tuple[str, ...], data: bytes, make: Callable[[], ObjectModel]) -> ObjectModel:
    """A prepared object from the user's cache, else made and kept there.

    Args:
        terms: all that the object follows from, besides the bytes of its mesh and the code that prepares it.
        data: the mesh as it was given.
        make: prepares it; what it raises is not kept.
    """
    address = digest_json([*terms, hashlib.sha256(data).hexdigest(), revision()])
    file = user_cache.folder("objects") / f"{address}.npz"
    if (held := user_cache.load(file)) is not None:
        try:
            return from_bytes(held, name="", digest="")
        except (ValueError, KeyError, TypeError, OSError, EOFError, zipfile.BadZipFile):
            pass
    obj = make()
    user_cache.keep(file, to_bytes(obj))
    return obj


@lru_cache(maxsize=1)
def revision() -> str:
    """Digest of what prepares: this package's source, its libraries, and the kind of processor, whose last bits may
    differ. So a change to how objects are prepared leaves no old one in use, and nobody has to remember a number."""
    whole = hashlib.sha256()
    for file in sorted(Path(__file__).parent.rglob("*.py")):
        whole.update(file.read_bytes())
    return digest_json([whole.hexdigest(), *map(version_of, _LIBRARIES), platform.machine()])
