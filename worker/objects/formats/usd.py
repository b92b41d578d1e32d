"""OpenUSD stages (extra `usd`): geometry and physics below the default prim, read in a child process.

The frame of an object is that of its stage: axes as authored (`upAxis` is not applied), numbers in metres by
`metersPerUnit`. Subdivision surfaces are read as their control cage."""

import io
import json
import tempfile
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from threading import Lock
from typing import Any, Final

import numpy as np
from cachetools import LRUCache, cached
from numpy.typing import NDArray

from graspd.service.model.digests import digest_bytes
from graspd.service.model.errors import InputError, MeshError
from graspd.service.model.matter import MOST_FRICTION
from graspd.service.model.transforms import Floats
from graspd.service.store.assets import pack, unpack
from graspd.service.store.usd_layers import LAYERS, PACKAGE, import_usd
from graspd.service.store.usd_layers import SUFFIXES as SUFFIXES
from graspd.worker.objects.formats.glb import from_linear
from graspd.worker.objects.formats.soup import FaceNames, Soup, check_face_count, primitive
from graspd.worker.objects.isolation import run_isolated

#: First bytes of text, crate and package files.
MAGIC: Final = (b"#usda", b"PXR-USDC", b"PK\x03\x04")
#: Largest size of all layers together [bytes].
_MAX_BYTES: Final = 2**28
#: Size of the arrays of all stages that are kept for repeated loading [bytes]; larger stages are read again.
_KEPT_BYTES: Final = 2**25
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Stage:
    """Contents of a stage as the child process reports them, in the file's units."""

    facts: dict[str, Any]
    arrays: dict[str, NDArray[Any]]
    unit: float  # [m]
    mass_unit: float  # [kg]

    def mesh(self, shape: Mapping[str, Any]) -> tuple[Floats, Ints]:
        """Return vertices (V, 3) and triangles (F, 3) of a shape in the stage's frame [m]."""
        number, matrix = shape.get("mesh"), np.array(shape["matrix"])
        local = _primitive(shape) if number is None else (self.arrays[f"points{number}"], self.arrays[f"faces{number}"])
        vertices, faces = local
        # A mirrored mesh is turned outward.
        faces = faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces
        return (vertices @ matrix[:3, :3].T + matrix[:3, 3]) * self.unit, faces

    def colours(self, shape: Mapping[str, Any], count: int) -> Floats:
        """Return sRGB colours (F, 3) of `count` triangles; nan if the file states none."""
        linear = self.arrays.get(f"colours{shape.get('mesh')}", np.full((count, 3), np.nan))
        return np.clip(from_linear(linear), 0, 1)

    def mass(self, bodies: Mapping[str, Any]) -> float:
        """Return the stated mass of bodies [kg]; 0 if none is stated."""
        return self.mass_unit * sum(one["mass"] for one in self.facts["masses"] if one["body"] in bodies)


def read(data: bytes) -> Soup:
    """Read the visible geometry as one object, else its colliders; with mass and friction.
    `data` is a layer, or a ZIP of layers whose first one is the root layer, such as a USDZ."""
    try:
        stage = read_stage({"stage.usd": data}, "stage.usd", MeshError)
    except MeshError as error:
        raise MeshError(str(error).removeprefix("stage.usd: ")) from None
    shapes, soup = stage.facts["shapes"], list[tuple[Floats, Ints, Floats]]()
    names, first = list[tuple[int, Any]](), 0
    for shape in [s for s in shapes if s["shown"]] or [s for s in shapes if s["collider"]] or shapes:
        vertices, faces = stage.mesh(shape)
        soup.append((vertices, faces + first, stage.colours(shape, len(faces))))
        first += len(vertices)
        label = stage.arrays.get(f"label{shape.get('mesh')}", np.zeros(len(faces), int))
        starts = np.flatnonzero(np.diff(label, prepend=-1))
        for start, size in zip(starts, np.diff(starts, append=len(label)), strict=True):
            parts = stage.facts["parts"].get(str(shape.get("mesh")), [""])
            names.append((int(size), [*shape["names"], parts[label[start]]]))
        check_face_count(sum(len(part[1]) for part in soup))
    if not soup:
        raise MeshError("the mesh has no faces; export a stage with meshes below its default prim")
    points, triangles, known = map(np.concatenate, zip(*soup, strict=True))
    shown = None if np.isnan(known).all() else known
    return Soup(points, triangles, shown, names=FaceNames.of(names), matter=_matter(stage))


def _matter(stage: Stage) -> dict[str, float]:
    """Return stated mass [kg], else density [kg/m^3], and the lowest dynamic friction of colliders."""
    shapes, found = stage.facts["shapes"], dict[str, float]()
    densities = [one["density"] for one in (*stage.facts["masses"], *shapes) if one.get("density", 0) > 0]
    if mass := stage.mass({"": 0} | stage.facts["bodies"]):
        found["mass"] = mass
    elif densities:
        found["density"] = densities[0] * stage.mass_unit / stage.unit**3
    if frictions := [shape["friction"] for shape in shapes if shape.get("friction", 0) > 0]:
        found["friction"] = min(*frictions, MOST_FRICTION)
    return found


def read_stage(files: Mapping[str, bytes], main: str, error: type[InputError]) -> Stage:
    """Read a stage from its layers or a package (USDZ), in a child process of limited time and memory.
    Raises `error`: the stage is unreadable, too large, cyclic, or refers to files outside; or usd-core is missing."""
    import_usd(error)
    try:
        if (data := files[main]).startswith(MAGIC[2]):
            files = unpack(data, limit_bytes=_MAX_BYTES)
            main = next((name for name in files if name.lower().endswith(SUFFIXES)), main)
        layers = {name: files[name] for name in sorted(files) if name == main or name.lower().endswith(LAYERS)}
        if main not in layers or sum(map(len, layers.values())) > _MAX_BYTES:
            raise error(f"{main}: no layer, or layers of more than {_MAX_BYTES >> 20} MiB; decimate the meshes first")
        return _read_packed(pack(layers), main)
    except InputError as refused:
        raise error(str(refused)) from None


@cached(
    LRUCache[tuple[str, str], Stage](_KEPT_BYTES, lambda stage: 1 + sum(one.nbytes for one in stage.arrays.values())),
    key=lambda packed, main: (digest_bytes(packed), main),
    lock=Lock(),
)
def _read_packed(packed: bytes, main: str) -> Stage:
    """Read a stage from a ZIP of its layers; the last small ones are kept for repeated loading."""
    with tempfile.TemporaryDirectory(prefix="graspd-usd-") as folder:
        for name, data in unpack(packed, limit_bytes=2 * _MAX_BYTES).items():
            file = Path(folder) / name
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(data)
        done = run_isolated("graspd.worker.objects.formats.usd_child", folder, main, what=main)
    try:
        with np.load(io.BytesIO(done), allow_pickle=False) as stored:
            arrays = dict(stored)
        facts = json.loads(arrays.pop("facts").tobytes())
    except (ValueError, KeyError, OSError, EOFError):
        raise InputError(f"{main}: reading it takes more than 20 s or 3 GiB, or crashes USD; simplify it") from None
    if "error" in facts:
        raise InputError(facts["error"])
    units = float(facts["unit"]), float(facts["mass_unit"])
    if not all(1e-6 <= unit <= 1e6 for unit in units):
        raise InputError(f"{main}: metersPerUnit is {units[0]:g} and kilogramsPerUnit {units[1]:g}; correct them")
    return Stage(facts, arrays, *units)


def _primitive(shape: Mapping[str, Any]) -> tuple[Floats, Ints]:
    """Return vertices and triangles of a primitive in its own frame."""
    kind, sizes = ("box", shape["size"] * 3) if shape["kind"] == "Cube" else (shape["kind"].lower(), shape["size"])
    try:
        vertices, faces = primitive(kind, sizes)
    except MeshError as error:
        raise MeshError(f"{shape['path']}: {error}") from None
    return vertices @ axis_rotation(shape).T, faces


def axis_rotation(shape: Mapping[str, Any]) -> Floats:
    """Return the rotation (3, 3) from the z axis to a primitive's axis."""
    turn = {"X": [[0, 0, 1], [1, 0, 0], [0, 1, 0]], "Y": [[0, 1, 0], [0, 0, 1], [1, 0, 0]]}
    return np.array(turn.get(shape["axis"], np.eye(3)), float)


def stage_package(files: Mapping[str, bytes], main: str) -> tuple[str, bytes]:
    """Return name and content of a stage as one file: a layer alone, or all layers as a package."""
    layers = sorted(name for name in files if name != main and name.lower().endswith(LAYERS))
    if not main.lower().endswith(LAYERS) or not layers:
        return main, files[main]
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as package:
        for name in (main, *layers):
            package.writestr(zipfile.ZipInfo(name), files[name])
    return f"{PurePosixPath(main).with_suffix(PACKAGE)}", buffer.getvalue()
