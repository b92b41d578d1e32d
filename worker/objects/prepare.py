"""Preparation of objects, cached by content: reading, repair, simplification, normals, hull and mass."""

import hashlib
import io
import json
import math
import zipfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.service import user_cache
from graspd.service.model.digests import digest_files, digest_json, digest_variant
from graspd.service.model.errors import MeshError, NotFoundError, did_you_mean
from graspd.service.model.object_options import ObjectOptions
from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import Floats
from graspd.service.store import body_files, usd_layers
from graspd.service.store.assets import builtin_files, builtin_names, unpack_file
from graspd.service.store.hand_files import find_hand_files
from graspd.worker.objects import bodies, disk_cache, mesh_geometry, topology
from graspd.worker.objects.distance import MeshDistance, deviation, surface_points
from graspd.worker.objects.formats import READERS, read_mesh
from graspd.worker.objects.formats.usd import stage_package
from graspd.worker.objects.mesh_geometry import MassProperties, corner_normals, mass_properties, signed_volume
from graspd.worker.objects.model import Ints, ObjectModel
from graspd.worker.objects.options import OF_MATTER, parse_options
from graspd.worker.objects.parts import SurfaceParts
from graspd.worker.objects.repair import RepairedMesh, repair
from graspd.worker.objects.topology import Indices

#: Generic file names.
PLAIN_STEMS: Final = ("clean", "mesh", "model", "textured", "nontextured", "simplified")
#: Libraries that affect a prepared object.
_LIBRARIES: Final = ("numpy", "scipy", "manifold3d", "fast-simplification")


def load_object(
    files: Mapping[str, bytes], *, name: str, digest: str, face_error_m: float, options: Mapping[str, Any] | None = None
) -> ObjectModel:
    """Load the object in `files`: a mesh (`READERS`) or a body (`bodies`), and optionally `asset.json`.
    `digest` is that of the files; `options` override keys of `asset.json` (`ObjectOptions`). The prepared surface lies
    within `face_error_m` of the uploaded one [m]; 0 keeps all faces. Raises MeshError: the mesh cannot be used; the
    message names the fault and the fix."""
    settings = parse_options(files, options)
    main, data = main_mesh(files, settings)
    shape = settings.model_dump_json(exclude=set(OF_MATTER))
    model = replace(_prepare(main, data, shape, float(face_error_m)), name=name, digest=digest)
    return apply_options(model, settings)


def apply_options(model: ObjectModel, options: ObjectOptions) -> ObjectModel:
    return model.with_mass(mass=options.mass, density=options.density, friction=options.friction)


def main_mesh(files: Mapping[str, bytes], options: ObjectOptions) -> tuple[str, bytes]:
    """Return name and content of the main file; a description with its meshes, or USD layers, as a ZIP."""
    main = main_file(files, options)
    is_body = main.lower().endswith(bodies.SUFFIXES)
    return (main, bodies.pack_body(files)) if is_body else stage_package(files, main)


def main_file(files: Mapping[str, bytes], options: ObjectOptions) -> str:
    """Return the name of the main file: from the options, else the only description, else the only mesh.
    Raises MeshError: there is no such file."""
    if options.file:
        if options.file not in files:
            raise MeshError(f"asset.json names the file {options.file!r}, which is missing")
        return options.file
    if body := body_files.find_body(files):
        return body
    found = sorted(name for name in files if Path(name).suffix.lower() in READERS)
    if len(found) == 1:
        return found[0]
    others = sorted(name for name in files if name != "asset.json")
    if not found and len(others) == 1:
        return others[0]
    raise MeshError(f'{len(found)} meshes among the object\'s files; name one in asset.json under "file"')


@lru_cache(maxsize=8)
def _prepare(main: str, data: bytes, options_json: str, face_error_m: float) -> ObjectModel:
    """Prepare an object; cached in memory and on disk for batches of a job and repeated commands."""
    terms = [Path(main).suffix.lower(), options_json, repr(face_error_m), hashlib.sha256(data).hexdigest(), revision()]
    file = user_cache.cache_folder("objects") / f"{digest_json(terms)}.npz"
    if (held := user_cache.load(file)) is not None:
        with suppress(ValueError, KeyError, TypeError, OSError, EOFError, zipfile.BadZipFile):
            return from_bytes(held, name="", digest="")
    obj = build_model(repaired_mesh(main, data, ObjectOptions.model_validate_json(options_json)), face_error_m)
    user_cache.store(file, to_bytes(obj))
    return obj


def repaired_mesh(main: str, data: bytes, options: ObjectOptions) -> RepairedMesh:
    """Return the mesh of a file as a solid in metres; errors name the file."""
    return _repair_file(main, data, options.model_dump_json())


@lru_cache(maxsize=2)
def _repair_file(main: str, data: bytes, options_json: str) -> RepairedMesh:
    """Repair, cached: the result is reused for every value of `face_error_m`."""
    is_body = main.lower().endswith(bodies.SUFFIXES)
    soup, *others = bodies.read_body(main, data) if is_body else [read_mesh(main, data)]
    options = ObjectOptions.model_validate_json(options_json)
    try:
        return repair(soup, options)
    except MeshError as error:
        for other in others:
            with suppress(MeshError):
                mesh = repair(other, options)
                why = f"took the collision shapes, since the visible ones cannot be used ({error})"
                return replace(mesh, repairs=(why, *mesh.repairs))
        raise MeshError(f"{main}: {error}", facts=error.facts) from None


def build_model(mesh: RepairedMesh, face_error_m: float) -> ObjectModel:
    """Simplify a repaired mesh, and compute its normals, hull and mass properties."""
    vertices, indices, error = simplify(mesh.vertices, mesh.faces, face_error_m, closed=mesh.watertight)
    faces, (hull_vertices, hull_faces) = indices.astype(np.int32), convex_hull(vertices)
    mass = mass_properties(*((vertices, faces) if mesh.watertight else (hull_vertices, hull_faces)))
    if mesh.inertial is not None:
        mass = MassProperties(mass.volume, *mesh.inertial)
    middle = ObjectModel(
        name="",
        digest="",
        vertices=vertices,
        faces=faces,
        corner_normals=corner_normals(vertices, faces),
        volume=mass.volume,
        centre_of_mass=mass.centre_of_mass,
        inertia=mass.inertia,
        radius=float(np.linalg.norm(vertices - mass.centre_of_mass, axis=1).max()),
        hull_vertices=hull_vertices,
        hull_faces=hull_faces,
        watertight=mesh.watertight,
        deviation_m=error,
        repairs=mesh.repairs,
        parts=mesh.parts,
    )
    return middle.with_mass(**mesh.matter).place_at(mesh.centre)


def convex_hull(points: Floats) -> tuple[Floats, Ints]:
    from scipy.spatial import ConvexHull, QhullError

    try:
        qhull = ConvexHull(points)
    except QhullError:
        raise MeshError("the mesh is flat; give it a thickness") from None
    return topology.outward_hull(points, qhull.simplices, qhull.equations[:, :3])


def object_from_path(
    path: str | Path, face_error_m: float = 3e-4, options: Mapping[str, Any] | None = None
) -> ObjectModel:
    """Load an object for the command line: name of a built-in, a mesh file, or a ZIP.
    Raises NotFoundError: neither a file nor a built-in object. MeshError: see `load_object`."""
    name, files, stated = files_from_path(path)
    digest = digest_variant(digest_files(AssetKind.OBJECT, files), options)
    return load_object(
        files, name=name, digest=digest, face_error_m=face_error_m, options={**stated, **(options or {})}
    )


def files_from_path(path: str | Path) -> tuple[str, dict[str, bytes], dict[str, Any]]:
    """Return name, files and options of an object: a mesh file, a ZIP, or a built-in's name."""
    path = Path(path)
    if not path.is_file():
        if str(path) in builtin_names(AssetKind.OBJECT):
            return str(path), builtin_files(AssetKind.OBJECT, str(path)), {}
        known = builtin_names(AssetKind.OBJECT)
        meant = did_you_mean(str(path), known)
        raise NotFoundError(f"{path} is neither a file nor a built-in object ({', '.join(known)}){meant}")
    if path.suffix.lower() == ".zip":
        return path.stem, unpack_file(path), {}
    if path.suffix.lower() in bodies.SUFFIXES:
        found, main = find_hand_files(path)
        return object_name(path), {name: file.read_bytes() for name, file in found.items()}, {"file": main}
    found = usd_layers.layer_files(path) if path.suffix.lower() in usd_layers.SUFFIXES else {path.name: path}
    if (beside := path.with_name("asset.json")).is_file():
        found[beside.name] = beside
    files = {name: file.read_bytes() for name, file in found.items()}
    return object_name(path), files, {"file": path.name} if len(files) > 1 else {}


def object_name(path: Path) -> str:
    """Return an object's name: that of its mesh file, or of the folder if the file name is generic."""
    return path.resolve().parent.name if path.stem.lower() in PLAIN_STEMS else path.stem


@lru_cache(maxsize=1)
def revision() -> str:
    """Compute a digest of this package and its libraries, so that a change invalidates cached objects."""
    return disk_cache.code_revision(tuple(map(str, sorted(Path(__file__).parent.rglob("*.py")))), _LIBRARIES)


Mesh = tuple[Floats, Indices]

#: Number of faces up to which meshes are not simplified: queries of smaller meshes are not faster.
FEW_FACES: Final = 64
#: Meshes with more faces are first reduced to about this number.
MANY_FACES: Final = 40_000
#: The search ends when its bounds on the number of faces differ by less than this factor.
STEP: Final = 1.12
#: Comparison of a trial: number of surface samples besides the vertices, and largest deviation as a share of the bound.
SAMPLES: Final = 4000
MARGIN: Final = 0.9
#: Number of samples at which the deviation of the returned mesh is measured.
DENSE_SAMPLES: Final = 30_000
#: Aggressiveness of the edge collapse. The lowest value that reaches the target has the least error.
PATIENCE: Final = 3


def simplify(vertices: Floats, faces: Indices, error_m: float, *, closed: bool = True) -> tuple[Floats, Indices, float]:
    """Find the coarsest mesh whose surface lies within `error_m` of the given one, both ways.
    Quadric edge collapse (Garland & Heckbert 1997) reduces the mesh; bisection finds the number of faces. A trial of a
    closed mesh must be an oriented 2-manifold with as many shells as the original. If no trial of a closed mesh passes,
    manifold3d's edge collapse is used. Return vertices, faces and the measured deviation [m]."""
    if error_m <= 0 or len(faces) <= FEW_FACES:
        return vertices, faces, 0.0
    limit = MARGIN * error_m
    original = ReferenceMesh(vertices, faces, closed)
    if len(faces) > MANY_FACES:
        # A mesh within a fifth of the error is quick to compare with: four fifths remain for the trials.
        start = _simplify_to(original, MANY_FACES, limit / 5)
        if start is not None:
            original, limit = ReferenceMesh(*start, closed), limit * 4 / 5
    accepted: list[Mesh] = []
    low, high = float(FEW_FACES), float(len(original.faces))
    while high / low > STEP:
        target = round(math.sqrt(low * high))
        if (trial := _simplify_to(original, target, limit)) is None:
            low = target
        else:
            high = target
            accepted.append(trial)
    if not accepted and closed:
        accepted = _simplify_by_manifold(original, limit)
    for mesh in reversed(accepted):
        error = deviation(mesh, (vertices, faces), DENSE_SAMPLES)
        if error <= error_m:
            return (*mesh, error)
    return vertices, faces, 0.0


class ReferenceMesh:
    """Original mesh with which trials are compared, and its search structure."""

    def __init__(self, vertices: Floats, faces: Indices, closed: bool) -> None:
        self.vertices, self.faces, self.closed = vertices, faces, closed
        self.shells = int(topology.components(faces).max())
        self._distance = MeshDistance(vertices, faces)
        self._points = surface_points(vertices, faces, SAMPLES)

    def is_matched_by(self, mesh: Mesh) -> bool:
        """Check whether a mesh is closed, outward, and of as many shells as a closed original."""
        return not self.closed or (
            topology.is_closed(mesh[1])
            and signed_volume(*mesh) > 0
            and int(topology.components(mesh[1]).max()) == self.shells
            and mesh_geometry.to_manifold(*mesh) is not None
        )

    def is_within(self, mesh: Mesh, limit: float) -> bool:
        """Check whether a mesh and the original lie within `limit` [m] at vertices and even samples."""
        back, own = MeshDistance(*mesh), surface_points(*mesh, SAMPLES)
        # A few points reject most meshes that are too coarse. All points are checked only if these pass.
        return all(
            float(distance(points[::step], limit).max()) <= limit
            for step in (16, 1)
            for distance, points in ((back, self._points), (self._distance, own))
        )


def _simplify_to(original: ReferenceMesh, target: int, error_m: float) -> Mesh | None:
    """Return a mesh of about `target` faces if it is valid and within the bound.
    A collapse that breaks the surface at one number of faces often succeeds at the next, so a few numbers are used."""
    for count in (target, int(target * 1.02) + 2, int(target * 1.05) + 4):
        mesh = _collapse(original.vertices, original.faces, count)
        if mesh is not None and original.is_matched_by(mesh):
            return mesh if original.is_within(mesh, error_m) else None
    return None


def _collapse(vertices: Floats, faces: Indices, target: int) -> Mesh | None:
    if target >= len(faces):
        return None
    # The library uses single precision: centring and scaling minimise the loss.
    middle, scale = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max())
    import fast_simplification  # slow to load, not needed for cached results

    points, triangles = fast_simplification.simplify(
        ((vertices - middle) / scale).astype(np.float32), faces.astype(np.int32), target_count=target, agg=PATIENCE
    )[:2]
    triangles = np.asarray(triangles, dtype=np.int64).reshape(-1, 3)
    triangles = triangles[(triangles != np.roll(triangles, 1, axis=1)).all(axis=1)]
    triangles = triangles[~topology.repeated_faces(triangles)] if len(triangles) else triangles
    if len(triangles) < 4:
        return None
    mesh = topology.drop_unused_vertices(np.asarray(points, dtype=float) * scale + middle, triangles)
    if (topology.edge_faces(mesh[1])[1] > 2).any():
        # A tunnel that collapsed to an edge is closed by splitting the edge.
        mesh = topology.separate_double_edges(*topology.split_edges(*mesh))
    return mesh


def _simplify_by_manifold(original: ReferenceMesh, error_m: float) -> list[Mesh]:
    whole = mesh_geometry.to_manifold(original.vertices, original.faces)
    if whole is None:
        return []
    for share in (0.9, 0.5, 0.2):
        mesh = topology.from_manifold(whole.simplify(share * error_m))
        if len(mesh[1]) < len(original.faces) and original.is_matched_by(mesh) and original.is_within(mesh, error_m):
            return [mesh]
    return []


_ARRAYS: Final = ("vertices", "faces", "corner_normals", "centre_of_mass", "inertia", "hull_vertices", "hull_faces")
_NAMES: Final = ("name", "digest", "about_centre", "parts")
#: Arrays of `SurfaceParts`, which only objects of several parts or colours have, and their names as JSON.
_PARTS: Final = ("points", "index", "colours")


def to_bytes(obj: ObjectModel) -> bytes:
    """Serialise an object without its name and digest, bit for bit."""
    plain = {f.name: getattr(obj, f.name) for f in fields(obj) if f.name not in (*_ARRAYS, *_NAMES)}
    arrays: dict[str, Any] = {name: getattr(obj.centred, name) for name in _ARRAYS}
    if obj.parts is not None:
        arrays |= {f"part_{name}": getattr(obj.parts, name) for name in _PARTS}
        arrays["part_names"] = np.frombuffer(json.dumps(obj.parts.names).encode(), np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays, plain=np.frombuffer(json.dumps(plain).encode(), np.uint8))
    return buffer.getvalue()


def from_bytes(data: bytes, *, name: str, digest: str) -> ObjectModel:
    """Load an object from `to_bytes`; bad data raise ValueError, KeyError, OSError, EOFError, BadZipFile."""
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        plain = json.loads(stored["plain"].tobytes())
        arrays = {field: stored[field] for field in _ARRAYS}
        if "part_names" in stored:
            names = tuple(map(tuple, json.loads(stored["part_names"].tobytes())))
            plain["parts"] = SurfaceParts(names=names, **{name: stored[f"part_{name}"] for name in _PARTS})
    x, y, z = plain.pop("centre")
    middle = ObjectModel(name=name, digest=digest, **arrays, **plain | {"repairs": tuple(plain["repairs"])})
    return middle.place_at((x, y, z))
