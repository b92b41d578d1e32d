"""Sanitiser of MJCF for MuJoCo's reader: one text that names no file on disk, and its meshes.

MuJoCo reads any file on disk that a model names. This module therefore inserts includes, renames meshes of the hand's
files, and removes all parts that a hand does not need. Only the elements listed here reach MuJoCo."""

import math
import posixpath
import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from pathlib import PurePosixPath
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import HandError, LimitError
from graspd.service.model.transforms import Floats
from graspd.service.store.mesh_files import match_name
from graspd.worker.objects.format_check import check_format
from graspd.worker.objects.xml_document import parse_xml

MAX_BYTES: Final = 8 * 2**20
#: First group that MuJoCo's viewer does not draw.
HIDDEN_GROUP: Final = 3
_MAX_INCLUDES: Final = 64
_MAX_ELEMENTS: Final = 50_000
Element = ElementTree.Element
#: Sections of a model that describe a hand.
_SECTIONS: Final = ("compiler", "default", "asset", "worldbody", "contact", "tendon", "equality", "actuator")
#: Elements that would load files or plugins, or multiply elements; a hand needs none of them.
_REFUSED: Final = ("attach", "composite", "flexcomp", "model", "replicate")
_LEFT_OUT: Final = frozenset(
    {"texture", "layer", "hfield", "skin", "plugin", "camera", "light", "spatial", "weld", "flex", "flexvert", "pair"}
)
_ACTUATORS: Final = ("general", "motor", "position", "velocity", "intvelocity")
#: Attributes that name files or removed parts.
_DROPPED: Final = frozenset(
    {"file", "content_type", "texture", "hfield", "meshdir", "texturedir", "assetdir", "strippath", "plugin"}
)
_MESHES: Final = (".stl", ".obj", ".msh")


def compile_model(files: Mapping[str, bytes], main: str) -> tuple[Any, str, list[str]]:
    """Return MuJoCo's model, its text, and notes for the user (`inline_model`); HandError if rejected."""
    import mujoco  # slow to load

    text, assets, notes = inline_model(files, main)
    try:
        return mujoco.MjModel.from_xml_string(text, assets), text, notes
    except (ValueError, RuntimeError, OSError, mujoco.FatalError) as error:
        line = " ".join(str(error).replace("XML Error:", "").split())[:200]
        raise HandError(f"{main}: MuJoCo rejects it ({line}); correct the model") from None


def mesh_of_geom(model: Any, geom: int) -> tuple[Floats, NDArray[np.int32]]:
    """Return vertices (V, 3) and triangles (F, 3) of a mesh geom in its own frame."""
    mesh = model.mesh(int(model.geom_dataid[geom]))
    vertex, face = int(mesh.vertadr[0]), int(mesh.faceadr[0])
    vertices = model.mesh_vert[vertex : vertex + int(mesh.vertnum[0])]
    return np.array(vertices, float), np.array(model.mesh_face[face : face + int(mesh.facenum[0])], np.int32)


def inline_model(files: Mapping[str, bytes], main: str) -> tuple[str, dict[str, bytes], list[str]]:
    """Return the model as one text, the mesh files it names, and notes for the user.
    Raises HandError: not XML, not MJCF, an include or mesh that is missing or outside the upload, or an element that
    loads another model. LimitError: larger than the limits of this module."""
    root = parse_xml(files[main], main, "an MJCF model", "mujoco", limit_bytes=MAX_BYTES)
    _expand_includes(root, files, main, main, [0, 0])
    folder = _mesh_folder(root)
    assets: dict[str, bytes] = {}
    for section in list(root):
        if section.tag not in _SECTIONS:
            root.remove(section)
    for element in list(root.iter()):
        if element.tag in _REFUSED:
            raise HandError(f"{main}: <{element.tag}> is not read; write its parts out, or give the hand's own file")
        if element.tag == "mesh" and element.get("file"):
            _add_mesh(element, files, main, folder, assets)
            continue
        for name in _DROPPED & element.attrib.keys():
            del element.attrib[name]
        if element.tag == "default":
            # MuJoCo refuses other attributes here, which other readers ignore.
            element.attrib = {name: value for name, value in element.attrib.items() if name == "class"}
    notes = _ignored_elements(root)
    _remove_unread_elements(root)
    _prune_actuators(root)
    compiler = root.find("compiler")
    if compiler is None:
        compiler = ElementTree.SubElement(root, "compiler")
    # Frames without mass are common in hands and make MuJoCo's reader fail.
    compiler.set("boundmass", compiler.get("boundmass", "1e-9"))
    compiler.set("boundinertia", compiler.get("boundinertia", "1e-12"))
    if _uses_radians(root):
        compiler.set("angle", "radian")
        notes.append('angles read as radians: too small for degrees (if not: <compiler angle="degree"/>)')
    return ElementTree.tostring(root, encoding="unicode"), assets, notes


def _ignored_elements(root: Element) -> list[str]:
    """Return notes on drives and constraints that are left out; call it before their removal."""
    spatial = {tendon.get("name") for tendon in root.iter("spatial")}
    drives = list(root.iterfind("actuator/*"))
    pulled = [one for one in drives if one.get("tendon") in spatial]
    others = [one for one in drives if one not in pulled and not _is_supported(one)]
    held = [
        one
        for one in root.iterfind("equality/*")
        if (one.tag == "weld" and len(one.attrib.keys() & {"body1", "body2", "site1", "site2"}) == 2)
        or {one.get("tendon1"), one.get("tendon2")} & spatial - {None}
    ]
    notes = (
        (pulled, "on spatial tendons, which are ignored: joints are planned as if each had its own drive"),
        (others, "ignored: only motors and servos of joints and fixed tendons are read"),
        (held, "ignored: the bodies or tendons that it connects are planned as free"),
    )
    return [f"{_element_names(elements)} {note}" for elements, note in notes if elements]


def _element_names(elements: list[Element]) -> str:
    names = [one.get("name") or one.get("tendon") or one.tag for one in elements]
    return ", ".join(names[:4]) + (", ..." if len(names) > 4 else "")


def _is_supported(actuator: Element) -> bool:
    return actuator.tag in _ACTUATORS and bool(actuator.attrib.keys() & {"joint", "jointinparent", "tendon"})


def _uses_radians(root: Element) -> bool:
    """Check whether angles are radians in a model that states no unit; MuJoCo would read degrees.
    This is assumed if no joint limit and no other angle exceeds 2 pi."""
    if any("angle" in compiler.attrib for compiler in root.findall("compiler")):
        return False
    hinges = [joint for joint in root.iter("joint") if joint.get("type", "hinge") != "slide"]
    ranges = [value for hinge in hinges for value in _parse_floats(hinge.get("range", ""))]
    turns = [value for element in root.iter() for value in _parse_floats(element.get("euler", ""))]
    turns += [value for element in root.iter() for value in _parse_floats(element.get("axisangle", ""))[3:]]
    return bool(ranges) and max(map(abs, ranges + turns)) <= 2 * math.pi


def _parse_floats(text: str) -> list[float]:
    try:
        return [float(word) for word in text.split()]
    except ValueError:
        return []


def _expand_includes(root: Element, files: Mapping[str, bytes], main: str, here: str, counts: list[int]) -> None:
    """Replace each include by the contents of its file; `counts` are the includes and elements so far."""
    counts[1] += sum(1 for _ in root.iter())
    if counts[1] > _MAX_ELEMENTS:
        raise LimitError(f"{main}: more than {_MAX_ELEMENTS} elements")
    for parent in list(root.iter()):
        for at, child in reversed(list(enumerate(parent))):
            if child.tag != "include":
                continue
            counts[0] += 1
            if counts[0] > _MAX_INCLUDES:
                raise HandError(f"{main}: more than {_MAX_INCLUDES} includes, or a file that includes itself")
            wanted = child.get("file", "")
            name = _find_file(wanted, files, [posixpath.dirname(main), posixpath.dirname(here)], main, "includes")
            check_format(name, files[name], HandError)
            part = parse_xml(files[name], name, limit_bytes=MAX_BYTES)
            _expand_includes(part, files, main, name, counts)
            parent[at : at + 1] = list(part)


def _find_file(wanted: str, files: Mapping[str, bytes], folders: list[str], main: str, does: str) -> str:
    """Return the name in `files` of a file that a model names; search relative to each folder."""
    path = wanted.replace("\\", "/")
    inside, like = False, []
    for folder in dict.fromkeys(folders):
        name = posixpath.normpath(posixpath.join(folder, path))
        if path.startswith("/") or name.startswith(("..", "/")) or ":" in path:
            continue
        inside = True
        if name in files:
            return name
        like.append(match_name(name, files))
    if not inside:
        raise HandError(f"{main}: {does} {wanted[:80]!r}, which lies outside its folder; put it inside")
    below = [name for name in files if name.endswith("/" + posixpath.normpath(path).removeprefix("../"))]
    if len(below) == 1:
        return below[0]
    if found := next(filter(None, like), ""):
        return found
    raise HandError(f"{main}: {does} {wanted[:80]!r}, which is missing; add the file")


def _mesh_folder(root: Element) -> tuple[str, bool]:
    """Return the folder of mesh files, and whether the folders in their names are ignored."""
    folder, strip = "", False
    for compiler in root.findall("compiler"):
        folder = compiler.get("meshdir", compiler.get("assetdir", folder))
        strip = compiler.get("strippath", str(strip)).lower() == "true"
    return folder, strip


def _add_mesh(
    element: Element, files: Mapping[str, bytes], main: str, where: tuple[str, bool], assets: dict[str, bytes]
) -> None:
    """Rename a mesh's file to a number, and add the file to `assets`; `where`: see `_mesh_folder`."""
    (folder, strip), file = where, PurePosixPath(element.attrib["file"].replace("\\", "/"))
    wanted = file.name if strip else element.attrib["file"]
    name = _find_file(posixpath.join(folder, wanted), files, [posixpath.dirname(main), ""], main, "names the mesh")
    suffix = PurePosixPath(name).suffix.lower()
    if suffix not in _MESHES:
        raise HandError(f"{main}: the mesh {name!r} is no file of type {', '.join(_MESHES)}; convert it")
    # MuJoCo names a mesh after its file if the model does not name it.
    element.set("name", element.get("name", file.stem))
    check_format(name, files[name], HandError)
    given = f"{len(assets)}{suffix}"
    assets[given] = files[name]
    element.set("file", given)
    element.attrib.pop("content_type", None)


def _remove_unread_elements(element: Element) -> None:
    for child in list(element):
        if child.tag in _LEFT_OUT or (child.tag == "geom" and child.get("type") in ("hfield", "sdf")):
            element.remove(child)
        else:
            _remove_unread_elements(child)


def _prune_actuators(root: Element) -> None:
    tendons = {tendon.get("name") for section in root.findall("tendon") for tendon in section.findall("fixed")}
    for section in root.findall("actuator"):
        for actuator in list(section):
            if not _is_supported(actuator) or actuator.get("tendon") not in {None, *tendons}:
                section.remove(actuator)
    for section in root.findall("equality"):
        for constraint in list(section):
            ends = {constraint.get("tendon1"), constraint.get("tendon2")} - {None}
            if constraint.tag not in ("joint", "tendon", "connect") or ends - tendons:
                section.remove(constraint)
