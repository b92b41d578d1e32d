"""GLB (binary glTF 2.0): triangles of all meshes, in the scene's frame and in metres, with colours.

A colour is the base colour of the material, times the mean of its texture if the file contains the texture."""

import json
import struct
from collections.abc import Iterable, Iterator
from contextlib import suppress
from typing import Any, Final

import numpy as np

from graspd.service.model.errors import MeshError
from graspd.service.model.transforms import Floats, quat_to_matrix
from graspd.worker.objects.formats.obj import UNREADABLE, mean_colour
from graspd.worker.objects.formats.soup import Part, Soup, join_parts, walk_scene

_INDEX_TYPES = {5121: "<u1", 5123: "<u2", 5125: "<u4"}
#: Positions are floats or, with KHR_mesh_quantization, integers that nodes or `normalized` scale.
_POSITION_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5126: "<f4"}
_TRIANGLES = 4
#: Extensions that contain or place vertices: refused by name wherever they occur.
_GEOMETRY = ("KHR_draco_", "EXT_meshopt_", "KHR_meshopt_", "EXT_mesh_gpu_instancing")
#: Extensions that move no vertex; any other extension that a file requires is refused by name.
_HARMLESS = ("KHR_mesh_quantization", "KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_xmp_")
_UNKNOWN: Final = np.full(3, np.nan)


def read(data: bytes) -> Soup:
    """Read vertices and triangles; every instance of a mesh in the node tree is its own copy."""
    document, binary = _read_chunks(data)
    for name in map(str, _document_list(document, "extensionsRequired")):
        if not name.startswith(_HARMLESS):
            raise _extension_error(name)
    return join_parts(_read_parts(document, binary))


def _read_parts(document: dict[str, Any], binary: bytes) -> Iterator[Part]:
    looks: dict[tuple[int, int], np.ndarray] = {}
    for node, matrix in _instances(document):
        mesh = int(node["mesh"])
        shown = _document_item(document, "meshes", mesh)
        _refuse_morphs(shown)
        for part, primitive in enumerate(shown["primitives"]):
            # Points and lines have no surface; CAD exporters add the edges of faces as lines.
            if 0 <= primitive.get("mode", _TRIANGLES) < _TRIANGLES:
                continue
            points, triangles = _read_primitive(document, binary, primitive)
            if (mesh, part) not in looks:
                looks[mesh, part] = material_colour(document, binary, primitive)
            yield points, triangles, matrix, looks[mesh, part], _names(document, node, shown, primitive)


def _names(document: dict[str, Any], node: dict[str, Any], mesh: dict[str, Any], primitive: dict[str, Any]) -> Any:
    """Return the names of a primitive: those of its node, mesh and material."""
    material = {}
    with suppress(LookupError, TypeError, ValueError):
        material = document["materials"][int(primitive["material"])]
    owners = (one for one in (node, mesh, material) if isinstance(one, dict))
    return tuple(name for one in owners if isinstance(name := one.get("name"), str))


def _read_chunks(data: bytes) -> tuple[dict[str, Any], bytes]:
    if len(data) < 20 or data[:4] != b"glTF" or struct.unpack_from("<I", data, 4)[0] != 2:
        raise MeshError("not binary glTF of version 2")
    length, kind = struct.unpack_from("<II", data, 12)
    if kind != 0x4E4F534A or 20 + length > len(data):
        raise MeshError("truncated: the JSON chunk is not whole")
    document = json.loads(data[20 : 20 + length])
    if not isinstance(document, dict):
        raise MeshError("the JSON chunk holds no object")
    at = 20 + length
    if at + 8 > len(data):
        return document, b""
    size, kind = struct.unpack_from("<II", data, at)
    if kind != 0x004E4942 or at + 8 + size > len(data):
        raise MeshError("truncated: the binary chunk is not whole")
    return document, data[at + 8 : at + 8 + size]


def _instances(document: dict[str, Any]) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
    nodes = _document_list(document, "nodes")
    scenes = _document_list(document, "scenes")
    if scenes:
        roots = _document_item(document, "scenes", document.get("scene", 0)).get("nodes", [])
    else:
        below = {int(child) for node in nodes for child in node.get("children", [])}
        roots = [root for root in range(len(nodes)) if root not in below]

    def nodes_of(indices: Iterable[Any]) -> Iterator[dict[str, Any]]:
        return (_document_item(document, "nodes", index) for index in indices)

    for node, matrix in walk_scene(nodes_of(roots), _node_transform, lambda node: nodes_of(node.get("children", []))):
        _refuse_extensions(node)
        _refuse_morphs(node)
        if "skin" in node:
            raise MeshError("a skinned mesh is posed by its bones; apply the armature and export it without bones")
        if "mesh" in node:
            yield node, matrix


def _node_transform(node: dict[str, Any]) -> np.ndarray:
    if "matrix" in node:
        return np.array(node["matrix"], dtype=float).reshape(4, 4).T
    matrix = np.eye(4)
    x, y, z, w = (float(v) for v in node.get("rotation", (0, 0, 0, 1)))
    scale = np.array(node.get("scale", (1, 1, 1)), dtype=float).reshape(3)
    matrix[:3, :3] = quat_to_matrix(np.array([w, x, y, z])) * scale
    matrix[:3, 3] = np.array(node.get("translation", (0, 0, 0)), dtype=float).reshape(3)
    return matrix


def _read_primitive(
    document: dict[str, Any], binary: bytes, primitive: dict[str, Any]
) -> tuple[np.ndarray, np.ndarray]:
    _refuse_extensions(primitive)
    points = _read_accessor(document, binary, primitive["attributes"]["POSITION"], "VEC3")
    if "indices" in primitive:
        order = _read_accessor(document, binary, primitive["indices"], "SCALAR").astype(np.int64).reshape(-1)
    else:
        order = np.arange(len(points), dtype=np.int64)
    match primitive.get("mode", _TRIANGLES):
        case 5:
            turned = np.arange(len(order) - 2) % 2
            at = np.arange(len(turned))
            order = np.stack([order[at], order[at + 1 + turned], order[at + 2 - turned]], axis=1).reshape(-1)
        case 6:
            rim = order[1:]
            order = np.stack([np.repeat(order[:1], max(len(rim) - 1, 0)), rim[:-1], rim[1:]], axis=1).reshape(-1)
        case 4:
            pass
        case mode:
            raise MeshError(f"a primitive has the mode {mode}, which glTF does not know; export the mesh again")
    if len(order) % 3 or (len(order) and order.max() >= len(points)):
        raise MeshError("a face has an index outside the vertices, or the last face is not whole")
    return points.astype(float), order.reshape(-1, 3)


def _read_accessor(document: dict[str, Any], binary: bytes, index: Any, shape: str) -> np.ndarray:
    accessor = _document_item(document, "accessors", index)
    if "sparse" in accessor or accessor.get("type") != shape or "bufferView" not in accessor:
        raise MeshError(f"an accessor is sparse, without data or not {shape}; export plain buffers")
    dtype = np.dtype((_POSITION_TYPES if shape == "VEC3" else _INDEX_TYPES)[accessor["componentType"]])
    width = 3 if shape == "VEC3" else 1
    view = _document_item(document, "bufferViews", accessor["bufferView"])
    _refuse_extensions(view)
    if view.get("buffer", 0) != 0 or "uri" in (_document_list(document, "buffers") or [{}])[0]:
        raise MeshError("the data lie in another file; export one GLB that holds everything")
    count, item = int(accessor["count"]), dtype.itemsize * width
    stride = int(view.get("byteStride", item))
    start = int(view.get("byteOffset", 0)) + int(accessor.get("byteOffset", 0))
    if min(count, start) < 0 or stride < item or start + stride * (count - 1) + item > len(binary):
        raise MeshError("truncated: an accessor reaches beyond the binary chunk")
    if not count:
        return np.zeros((0, width))
    data = np.frombuffer(binary, np.uint8, offset=start)
    rows = np.lib.stride_tricks.as_strided(data, (count, item), (stride, 1), writeable=False)
    found = np.ascontiguousarray(rows).view(dtype).reshape(count, width)
    if accessor.get("normalized") and dtype.kind in "iu":
        return np.maximum(found / np.iinfo(dtype).max, -1.0)
    return found


def _refuse_extensions(part: dict[str, Any]) -> None:
    """Refuse extensions that replace the vertices; others that a file does not require are ignored."""
    for name in part.get("extensions", {}):
        if name.startswith(_GEOMETRY):
            raise _extension_error(name)


def _refuse_morphs(part: dict[str, Any]) -> None:
    if any(part.get("weights", [])):
        raise MeshError("a mesh has morph targets with weights; apply its shape keys and export it without them")


def _extension_error(name: str) -> MeshError:
    how = "without compression" if "draco" in name or "meshopt" in name else "without it"
    return MeshError(f"the glTF extension {name[:60]} is not read; export {how}")


def _document_item(document: dict[str, Any], key: str, index: Any) -> Any:
    items = _document_list(document, key)
    if not 0 <= int(index) < len(items):
        raise MeshError(f"{key} has no item {int(index)}; export the mesh again")
    return items[int(index)]


def _document_list(document: dict[str, Any], key: str) -> list[Any]:
    value = document.get(key, [])
    if not isinstance(value, list):
        raise MeshError(f"{key} is no list")
    return value


def material_colour(document: dict[str, Any], binary: bytes, primitive: dict[str, Any]) -> Floats:
    """Return the sRGB colour (3,), 0 .. 1, of a primitive; NaN if it is not stated or unreadable."""
    try:
        material = document["materials"][int(primitive["material"])]["pbrMetallicRoughness"]
        factor = np.array(material.get("baseColorFactor", (1.0, 1.0, 1.0, 1.0)), float)[:3].reshape(3)
        if "baseColorTexture" in material:
            image = document["images"][int(document["textures"][int(material["baseColorTexture"]["index"])]["source"])]
            view = document["bufferViews"][int(image["bufferView"])]
            start = int(view.get("byteOffset", 0))
            if start < 0 or view.get("buffer", 0) != 0:
                raise ValueError("the image is not in the file")
            colour = from_linear(_to_linear(mean_colour(binary[start : start + int(view["byteLength"])])) * factor)
        elif "baseColorFactor" in material:
            colour = from_linear(factor)
        else:
            return _UNKNOWN
    except (LookupError, TypeError, AttributeError, *UNREADABLE):
        # A picture does not affect the shape: an unreadable one is left out.
        return _UNKNOWN
    return np.clip(colour, 0, 1) if np.isfinite(colour).all() else _UNKNOWN


def _to_linear(colour: Floats) -> Floats:
    return np.where(colour <= 0.04045, colour / 12.92, ((colour + 0.055) / 1.055) ** 2.4)


def from_linear(colour: Floats) -> Floats:
    return np.where(colour <= 0.0031308, 12.92 * colour, 1.055 * np.maximum(colour, 0.0031308) ** (1 / 2.4) - 0.055)
