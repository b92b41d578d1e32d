"""One rigid body from a URDF, SDF or MJCF: shapes in the frame of its root, mass and friction.

A description and its meshes are one ZIP of files of an upload. MuJoCo reads a sanitised MJCF: see
`worker.objects.mjcf_source`."""

import math
import posixpath
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import chain
from typing import Any, Final
from xml.etree.ElementTree import Element

import numpy as np

from graspd.service.model.errors import HandError, MeshError
from graspd.service.model.matter import MOST_FRICTION, MOST_KG
from graspd.service.model.transforms import Floats, pose_to_matrix, quat_from_rpy
from graspd.service.store.assets import pack, unpack
from graspd.service.store.body_files import SUFFIXES as SUFFIXES
from graspd.service.store.library import UNPACKED_LIMIT_BYTES
from graspd.service.store.mesh_files import find_mesh
from graspd.worker.objects.formats import READERS, Soup, read_mesh
from graspd.worker.objects.formats.soup import Part, check_soup, join_parts, primitive
from graspd.worker.objects.mjcf_source import HIDDEN_GROUP, MAX_BYTES, compile_model, mesh_of_geom
from graspd.worker.objects.xml_document import parse_xml

_UNKNOWN: Final = np.full(3, np.nan)
#: Mass [kg], centre of mass (3,) [m], and inertia (3, 3) about it [kg m^2], nan if not stated.
_Inertial = tuple[float, Floats, Floats]


@dataclass
class _Body:
    visuals: list[Part] = field(default_factory=list)
    collisions: list[Part] = field(default_factory=list)
    inertials: list[_Inertial] = field(default_factory=list)
    frictions: list[float] = field(default_factory=list)


def pack_body(files: Mapping[str, bytes]) -> bytes:
    """Return the descriptions and meshes among an object's files as one ZIP."""
    taken = (*SUFFIXES, *READERS, ".msh")
    return pack({name: data for name, data in files.items() if name.lower().endswith(taken)})


def read_body(main: str, packed: bytes) -> list[Soup]:
    """Read the visible shapes of a body as one mesh, its collision shapes as another; one may be missing.
    Raises MeshError: no single rigid body, a value that no body can have, or a mesh that is missing or unreadable.
    LimitError: too large."""
    files = unpack(packed, limit_bytes=UNPACKED_LIMIT_BYTES)
    try:
        root = parse_xml(files[main], main, limit_bytes=MAX_BYTES)
        body = _read_mjcf(files, main) if root.tag == "mujoco" else _read_links(root, files, main)
        stated: dict[str, Any] = _matter(body)
        soups = [join_parts(parts) for parts in (body.visuals, body.collisions) if parts]
        if not soups:
            raise MeshError(f"{main}: the body has no shape; give it a mesh, or the file of the mesh alone")
        return [check_soup(replace(soup, **stated, is_rigid=True)) for soup in soups]
    except HandError as error:
        raise MeshError(str(error)) from None
    except (ValueError, LookupError, TypeError, AttributeError, ArithmeticError) as error:
        raise MeshError(f"{main}: not a readable description ({str(error)[:80]}); correct it") from None


def _matter(body: _Body) -> dict[str, Any]:
    """Return the fields `matter` and `inertial` of a soup; the lowest friction counts."""
    matter = {"friction": min(*body.frictions, MOST_FRICTION)} if body.frictions else {}
    mass = sum(one[0] for one in body.inertials)
    if not 0 < mass <= MOST_KG:
        return {"matter": matter}
    centre = sum(m * at for m, at, _ in body.inertials) / mass
    whole = np.zeros((3, 3))
    for own, at, inertia in body.inertials:
        arm = at - centre
        whole += inertia + own * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    return {"matter": matter | {"mass": mass}, "inertial": (centre, whole / mass)}


def _read_links(root: Element, files: Mapping[str, bytes], main: str) -> _Body:
    """Read the links of a URDF or SDF; fixed joints may connect several."""
    models = [root] if root.tag == "robot" else list(root.iter("model"))
    if len(models) != 1 or root.find(".//include") is not None:
        raise MeshError(f"{main}: {len(models)} models, or one that includes others; give a file of one body")
    links, joints = models[0].findall("link"), models[0].findall("joint")
    if len(joints) != len(links) - 1 or any(joint.get("type") != "fixed" for joint in joints):
        what = f"{len(links)} links and {len(joints)} joints"
        raise MeshError(f"{main}: {what} are not one rigid body; only fixed joints may connect links")
    body = _Body()
    for link in links:
        place = _pose(link) if root.tag == "sdf" else _link_place(link.get("name", ""), joints)
        for tag, parts in (("visual", body.visuals), ("collision", body.collisions)):
            parts += [_part(one, place @ _pose(one), files, main, link.get("name", "")) for one in link.findall(tag)]
        if (inertial := link.find("inertial")) is not None and (mass := _number(inertial.find("mass"), "value")):
            body.inertials.append(_inertial(mass, place @ _pose(inertial), _moments(inertial.find("inertia"))))
        paths = ("contact/lateral_friction", "collision/surface/friction/ode/mu")
        body.frictions += [_number(one, "value") for one in chain(*map(link.findall, paths))]
    body.frictions += [_number(one, "value") for one in models[0].findall("gazebo/mu1")]
    body.frictions = [value for value in body.frictions if value > 0]
    return body


def _link_place(name: str, joints: list[Element]) -> Floats:
    """Return the 4x4 matrix of a link in the frame of the root link, over the joints above it."""
    above = {joint.find("child").get("link"): joint for joint in joints}  # type: ignore[union-attr]
    place = np.eye(4)
    for _ in joints:
        if (joint := above.get(name)) is None:
            break
        place, name = _pose(joint) @ place, joint.find("parent").get("link", "")  # type: ignore[union-attr]
    return place


def _moments(inertia: Element | None) -> Floats:
    """Return the stated inertia (3, 3); nan if none is stated."""
    keys = ("ixx", "ixy", "ixz", "ixy", "iyy", "iyz", "ixz", "iyz", "izz")
    values = [math.nan] * 9 if inertia is None else [_floats(_value(inertia, key, "0"), 1)[0] for key in keys]
    return np.reshape(values, (3, 3))


def _inertial(mass: float, place: Floats, inertia: Floats) -> _Inertial:
    """Return mass, centre and inertia in the frame of the body, of a frame at the matrix `place`."""
    turn = place[:3, :3]
    return mass, place[:3, 3], turn @ inertia @ turn.T


def _part(element: Element, matrix: Floats, files: Mapping[str, bytes], main: str, link: str) -> Part:
    if (shape := element.find("geometry/*")) is None or shape.find("submesh") is not None:
        raise MeshError(f"{main}: a {element.tag} of link {link!r} has no geometry, or a submesh; give a mesh")
    if shape.tag == "mesh":
        written = shape.get("filename") or (shape.findtext("uri") or "").strip()
        name = find_mesh(written, files, posixpath.dirname(main), link)
        soup = read_mesh(name, files[name])
        scaled = matrix @ np.diag([*_floats(_value(shape, "scale", "1 1 1"), 3), 1.0])
        return soup.vertices, soup.faces, scaled, _UNKNOWN, (element.get("name", ""),)
    keys = {"box": ("size",), "sphere": ("radius",), "cylinder": ("radius", "length"), "capsule": ("radius", "length")}
    if shape.tag not in keys:
        raise MeshError(f"{main}: geometry <{shape.tag[:40]}> is not read; use mesh, box, sphere, cylinder or capsule")
    sizes = [size for key in keys[shape.tag] for size in _floats(_value(shape, key, ""), 3 if key == "size" else 1)]
    return (*primitive(shape.tag, sizes), matrix, _UNKNOWN, (element.get("name", ""),))


def _pose(element: Element) -> Floats:
    """Return the 4x4 matrix of an `<origin>` (URDF) or `<pose>` (SDF); the identity without them."""
    origin, pose = element.find("origin"), element.find("pose")
    if pose is not None and (pose.get("relative_to") or pose.get("rotation_format", "euler_rpy") != "euler_rpy"):
        raise MeshError("a pose that is relative to another frame, or a quaternion, is not read; flatten the model")
    if origin is not None:
        numbers = _floats(origin.get("xyz", "0 0 0"), 3) + _floats(origin.get("rpy", "0 0 0"), 3)
    else:
        numbers = _floats((pose.text if pose is not None else "") or "0 0 0 0 0 0", 6)
    angles = np.array(numbers[3:]) * (np.pi / 180 if pose is not None and pose.get("degrees") in ("1", "true") else 1)
    return pose_to_matrix(np.concatenate([numbers[:3], quat_from_rpy(angles)]))


def _value(element: Element, key: str, default: str) -> str:
    """Return an attribute (URDF) or the text of a child (SDF)."""
    return element.get(key) or element.findtext(key) or default


def _number(element: Element | None, key: str) -> float:
    return 0.0 if element is None else _floats(element.get(key) or element.text or "", 1)[0]


def _floats(text: str, count: int) -> list[float]:
    values = [float(word) for word in text[:400].split()]
    if len(values) != count or not all(map(math.isfinite, values)):
        raise MeshError(f"{text[:40]!r} in the description must be {count} finite numbers; correct it")
    return values


def _read_mjcf(files: Mapping[str, bytes], main: str) -> _Body:
    """Read the geoms of the bodies of an MJCF that move as one, in the frame of their root body."""
    import mujoco  # slow to load

    model, text, _ = compile_model(files, main)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    with_geoms = {int(body) for body in model.geom_bodyid} - {0} or {0}
    roots = {int(model.body_rootid[body]) for body in with_geoms}
    if len(roots) != 1 or any(int(kind) != int(mujoco.mjtJoint.mjJNT_FREE) for kind in model.jnt_type):
        raise MeshError(f"{main}: {len(roots)} bodies, or one with joints, are not one rigid body; give it alone")
    frame = np.linalg.inv(_matrix(data.xpos[(root := roots.pop())], data.xmat[root]))
    found, is_friction_stated = _Body(), re.search(r"<geom\s[^>]*\bfriction=", text)
    for geom in range(model.ngeom):
        if model.geom_bodyid[geom] in with_geoms and model.geom_type[geom] != mujoco.mjtGeom.mjGEOM_PLANE:
            part = _geom_part(model, geom, frame @ _matrix(data.geom_xpos[geom], data.geom_xmat[geom]))
            if model.geom_contype[geom] or model.geom_conaffinity[geom]:
                found.collisions.append(part)
                # MuJoCo fills in the friction of geoms that state none.
                found.frictions += [float(model.geom_friction[geom][0])] if is_friction_stated else []
            elif model.geom_group[geom] < HIDDEN_GROUP:
                found.visuals.append(part)
    for body in sorted(with_geoms):
        if (mass := float(model.body_mass[body])) > 1e-8:
            place = frame @ _matrix(data.xipos[body], data.ximat[body])
            found.inertials.append(_inertial(mass, place, np.diag(model.body_inertia[body])))
    return found


def _geom_part(model: Any, geom: int, matrix: Floats) -> Part:
    import mujoco

    size, name = [float(value) for value in model.geom_size[geom]], (str(model.geom(geom).name),)
    if (kind := mujoco.mjtGeom(int(model.geom_type[geom])).name.removeprefix("mjGEOM_").lower()) == "mesh":
        vertices, faces = mesh_of_geom(model, geom)
        return vertices, faces.astype(np.int64), matrix, _UNKNOWN, name
    if kind == "ellipsoid":
        kind, size, matrix = "sphere", [1.0], matrix @ np.diag([*size, 1.0])
    # MuJoCo states half lengths.
    sizes = [2 * value for value in size] if kind == "box" else [size[0], *(2 * value for value in size[1:2])]
    return (*primitive(kind, sizes[:1] if kind == "sphere" else sizes), matrix, _UNKNOWN, name)


def _matrix(position: Any, rotation: Any) -> Floats:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = np.reshape(rotation, (3, 3)), position
    return matrix
