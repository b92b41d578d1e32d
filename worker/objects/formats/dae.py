"""COLLADA: triangles of all meshes of the scene in metres, and their colours.

A colour is the diffuse colour of the material or the mean of its picture. The file's unit is applied. Its up axis is
ignored, as in the viewers of ROS, for which such meshes are made."""

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from defusedxml import ElementTree as SafeTree
from defusedxml.common import DefusedXmlException

from graspd.service.model.errors import MeshError
from graspd.worker.objects.formats.obj import Nearby, colour_of, no_files
from graspd.worker.objects.formats.soup import Soup, join_parts, triangulate, walk_scene

Element = ElementTree.Element
#: Vertices (V, 3), triangles (F, 3) and material symbol of a primitive.
_Primitive = tuple[np.ndarray, np.ndarray, str]


def read(data: bytes, nearby: Nearby = no_files) -> Soup:
    """Read vertices and triangles; every instance of a mesh in the node tree is its own copy."""
    try:
        root: Element = SafeTree.fromstring(data)
    except DefusedXmlException:
        raise MeshError("XML entities are refused; export the mesh again") from None
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise MeshError(f"not well-formed XML ({str(error)[:80]}); export the mesh again") from None
    for element in root.iter():
        # Versions 1.4 and 1.5 differ only in the namespace.
        if isinstance(element.tag, str):
            element.tag = element.tag.rpartition("}")[2]
    if root.tag != "COLLADA":
        raise MeshError(f"the XML root is <{root.tag[:40]}>, but a DAE file begins with <COLLADA>")
    library = _Library(root, nearby)
    soup = join_parts(
        (points, triangles, matrix, library.colour(bound.get(symbol, symbol)), ())
        for geometry, matrix, bound in _instances(root, library)
        for points, triangles, symbol in library.primitives(geometry)
    )
    unit = root.find("asset/unit")
    metres = float(unit.get("meter", "1")) if unit is not None else 1.0
    if not 1e-9 < metres < 1e9:
        raise MeshError(f"its unit is {metres:g} m; export in metres")
    return replace(soup, vertices=soup.vertices * metres)


class _Library:
    """Elements of a file by their id, and its meshes and materials, each read once."""

    def __init__(self, root: Element, nearby: Nearby) -> None:
        self._nearby = nearby
        self._known = {identity: element for element in root.iter() if (identity := element.get("id"))}
        self._primitives: dict[str, list[_Primitive]] = {}
        self._colours: dict[str, np.ndarray] = {}

    def find_element(self, reference: str | None) -> Element:
        found = self._known.get((reference or "").removeprefix("#"))
        if found is None:
            raise MeshError(f"it names {(reference or 'nothing')[:40]!r}, which is missing; export it as one file")
        return found

    def primitives(self, geometry: str) -> list[_Primitive]:
        if geometry not in self._primitives:
            mesh = self.find_element(geometry).find("mesh")
            self._primitives[geometry] = [] if mesh is None else list(self._read(mesh))
        return self._primitives[geometry]

    def _read(self, mesh: Element) -> Iterator[_Primitive]:
        for path, what in (("tristrips", "strips"), ("trifans", "fans"), ("polygons/ph", "polygons with holes")):
            if mesh.find(path) is not None:
                raise MeshError(f"{what} are not read; triangulate the mesh and export it again")
        for kind in ("triangles", "polylist", "polygons"):
            for primitive in mesh.findall(kind):
                inputs = primitive.findall("input")
                stride = 1 + max((int(i.get("offset", "0")) for i in inputs), default=0)
                source = primitive.find("input[@semantic='VERTEX']")
                if source is None or not 0 < stride <= 64:
                    raise MeshError("a primitive has no vertices; export the mesh again")
                positions = self.find_element(source.get("source")).find("input[@semantic='POSITION']")
                points = self._read_points(positions.get("source") if positions is not None else None)
                counts, order = _polygons(primitive, kind, stride)
                corners = order[int(source.get("offset", "0")) :: stride]
                if int(counts.sum()) != len(corners) or (counts < 0).any():
                    raise MeshError("the stated number of a primitive's corners is wrong; export the mesh again")
                yield points, triangulate(points, counts, corners), primitive.get("material", "")

    def _read_points(self, reference: str | None) -> np.ndarray:
        source = self.find_element(reference)
        values, accessor = _parse_numbers(source.find("float_array")), source.find("technique_common/accessor")
        facts = {} if accessor is None else accessor.attrib
        stride, start = int(facts.get("stride", "3")), int(facts.get("offset", "0"))
        if not 3 <= stride <= 64 or start < 0:
            raise MeshError(f"points of {stride} numbers are not read; export the mesh again")
        count = max(len(values) - start, 0) // stride
        return values[start : start + count * stride].reshape(count, stride)[:, :3]

    def colour(self, material: str) -> np.ndarray:
        """Return the sRGB diffuse colour (3,) of a material; NaN if it has none."""
        if material not in self._colours:
            self._colours[material] = self._diffuse(material)
        return self._colours[material]

    def _texture_file(self, effect: Element, sampler: str) -> str:
        """Return the picture's file of a sampler: the sampler names a surface, and this names an image."""
        name = sampler
        for _ in range(2):
            param = next((p for p in effect.iter("newparam") if p.get("sid") == name), None)
            if param is None:
                break
            source = next(param.iter("source"), None)
            source = next(param.iter("init_from"), None) if source is None else source
            name = (source.text or "").strip() if source is not None else name
        found = next(self.find_element(name).iter("init_from"), None)
        inner = found.find("ref") if found is not None else None
        file = found if inner is None else inner
        return (file.text or "").strip() if file is not None else ""

    def _diffuse(self, material: str) -> np.ndarray:
        unknown = np.full(3, np.nan)
        try:
            instance = self.find_element(material).find("instance_effect")
            effect = self.find_element(instance.get("url") if instance is not None else None)
            found = next(effect.iter("diffuse"), None)
            if found is not None and (texture := found.find("texture")) is not None:
                picture = colour_of(self._texture_file(effect, texture.get("texture", "")), self._nearby)
                return unknown if picture is None else picture
            values = _parse_numbers(found.find("color") if found is not None else None)
        except (MeshError, ValueError):
            return unknown
        return np.clip(values[:3], 0, 1) if len(values) >= 3 and np.isfinite(values[:3]).all() else unknown


def _polygons(primitive: Element, kind: str, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the number of corners of each polygon, and the concatenated indices of all corners."""
    if kind == "polygons":
        parts = [_parse_numbers(part).astype(np.int64) for part in primitive.findall("p")]
        counts = np.array([len(part) // stride for part in parts], dtype=np.int64)
        return counts, np.concatenate(parts) if parts else np.zeros(0, np.int64)
    order = _parse_numbers(primitive.find("p")).astype(np.int64)
    if kind == "polylist":
        return _parse_numbers(primitive.find("vcount")).astype(np.int64), order
    return np.full(len(order) // (3 * stride), 3, dtype=np.int64), order


def _parse_numbers(element: Element | None) -> np.ndarray:
    return np.array((element.text or "").split() if element is not None else [], dtype="S40").astype(float)


def _instances(root: Element, library: _Library) -> Iterator[tuple[str, np.ndarray, dict[str, str]]]:
    """Yield every mesh in the scene: geometry, 4x4 matrix, and material of each symbol."""
    shown = root.find("scene/instance_visual_scene")
    scene = (
        library.find_element(shown.get("url")) if shown is not None else root.find("library_visual_scenes/visual_scene")
    )

    def child_nodes(node: Element) -> list[Element]:
        return node.findall("node") + [library.find_element(i.get("url")) for i in node.findall("instance_node")]

    for node, matrix in walk_scene(scene.findall("node") if scene is not None else [], _node_transform, child_nodes):
        if node.find("instance_controller") is not None:
            raise MeshError("a skinned mesh is posed by its bones; apply the armature and export it without bones")
        for instance in node.findall("instance_geometry"):
            bound = {
                link.get("symbol", ""): link.get("target", "")
                for link in instance.findall("bind_material/technique_common/instance_material")
            }
            yield instance.get("url", ""), matrix, bound


def _node_transform(node: Element) -> np.ndarray:
    """Return the product of a node's transforms, in their order."""
    matrix = np.eye(4)
    for element in node:
        step = np.eye(4)
        match element.tag:
            case "matrix":
                step = _parse_numbers(element).reshape(4, 4)
            case "translate":
                step[:3, 3] = _parse_numbers(element).reshape(3)
            case "scale":
                step[:3, :3] = np.diag(_parse_numbers(element).reshape(3))
            case "rotate":
                step[:3, :3] = _rotation(*_parse_numbers(element).reshape(4))
            case _:
                continue
        matrix = matrix @ step
    return matrix


def _rotation(x: float, y: float, z: float, degrees: float) -> np.ndarray:
    """Return the rotation by Rodrigues' formula; a zero axis gives no rotation."""
    length = math.sqrt(x * x + y * y + z * z)
    if length < 1e-12:
        return np.eye(3)
    x, y, z = x / length, y / length, z / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = math.radians(degrees)
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
