"""Reader of URDF and XML from untrusted sources; later code relies on its check of every value.

The common URDF libraries accept reversed limits, NaN, unknown mimics and several roots; this reader refuses them with a
message. Those libraries also resolve mimic chains wrongly."""

import math
from dataclasses import replace
from typing import Final
from xml.etree.ElementTree import Element

import numpy as np

from graspd.service.model.errors import HandError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, quat_from_rpy
from graspd.worker.hands.robot import MAX_LENGTH_M, MOVING, UNLIMITED_M, Joint, Link, Mimic, Robot, Shape, build_robot
from graspd.worker.objects.xml_document import parse_xml

MAX_BYTES: Final = 4 * 2**20
#: Largest number of visual elements per link that are drawn.
MAX_VISUALS: Final = 1024
Colour = tuple[float, float, float]


def read_urdf(data: bytes, filename: str = "the URDF") -> Robot:
    """Read and check a URDF.
    Raises HandError: not XML, not a robot, or a value that no hand can have. LimitError: larger than `MAX_BYTES`."""
    robot = parse_xml(data, filename, "a URDF", "robot", limit_bytes=MAX_BYTES)
    notes: list[str] = []
    materials = {element.get("name", ""): _colour(element) for element in robot.findall("material")}
    links = [_read_link(element, materials) for element in robot.findall("link")]
    joints = [_read_joint(element, notes) for element in robot.findall("joint")]
    return build_robot(robot.get("name", ""), links, joints, notes, filename)


def _read_link(element: Element, materials: dict[str, Colour | None]) -> Link:
    name = _name(element, "link")
    shapes = tuple(_read_shape(collision, f"collision of link {name!r}") for collision in element.findall("collision"))
    mass_element = element.find("inertial/mass")
    mass = None if mass_element is None else _parse_number(mass_element, "value", f"mass of link {name!r}")
    if mass is not None and mass < 0:
        raise HandError(f"mass of link {name!r} is negative; give it in kilograms")
    # Unusable visual elements are left out, since only pictures need them.
    found = []
    for visual in element.findall("visual")[:MAX_VISUALS]:
        try:
            shape = _read_shape(visual, f"visual of link {name!r}")
        except HandError:
            continue
        material = visual.find("material")
        colour = None if material is None else _colour(material) or materials.get(material.get("name", ""))
        found.append(replace(shape, colour=colour))
    return Link(name, shapes, mass if mass else None, tuple(found))


def _colour(material: Element) -> Colour | None:
    node = material.find("color")
    try:
        values = [float(part) for part in (node.get("rgba") or "")[:200].split()] if node is not None else []
    except ValueError:
        return None
    if len(values) not in (3, 4) or not all(0 <= value <= 1 for value in values):
        return None
    return values[0], values[1], values[2]


def _read_shape(element: Element, what: str) -> Shape:
    pose = _origin(element, what)
    if (shape := element.find("geometry/*")) is None:
        raise HandError(f"{what} has no geometry; give a box, cylinder, sphere, capsule or mesh")
    match shape.tag:
        case "box":
            size = _parse_vector(shape, "size", what)
        case "sphere":
            size = (_parse_number(shape, "radius", what),)
        case "cylinder" | "capsule":
            size = (_parse_number(shape, "radius", what), _parse_number(shape, "length", what))
        case "mesh":
            filename = shape.get("filename", "")
            if not filename or len(filename) > 1000:
                raise HandError(f"{what}: the mesh has no file name")
            scale = _parse_vector(shape, "scale", what, default=(1.0, 1.0, 1.0))
            if not all(1e-6 <= abs(s) <= 1e6 for s in scale):
                raise HandError(f"{what}: mesh scale {scale} is not usable; 0.001 turns millimetres into metres")
            return Shape("mesh", scale, pose, filename)
        case _:
            raise HandError(f"{what}: geometry <{shape.tag[:40]}> is not known; use a box, cylinder, sphere or mesh")
    if not all(1e-5 <= s <= MAX_LENGTH_M for s in size):
        raise HandError(f"{what}: {shape.tag} of size {size} m; sizes must lie between 0.01 mm and {MAX_LENGTH_M:g} m")
    return Shape(shape.tag, size, pose)


def _read_joint(element: Element, notes: list[str]) -> Joint:
    name = _name(element, "joint")
    what = f"joint {name!r}"
    kind = element.get("type", "")
    ends = [element.find(tag) for tag in ("parent", "child")]
    parent, child = ("" if end is None else end.get("link", "") for end in ends)
    still = Joint(name, kind, parent, child, _origin(element, what))
    if kind == "fixed":
        return still
    try:
        if still.type not in MOVING:
            raise HandError(
                f"{what}: type {still.type[:40]!r} cannot be used; use revolute, prismatic and fixed joints"
            )
        mimic = _mimic(element, what)
        try:
            lower, upper, effort = _limits(element, still.type, what)
        except HandError:
            # A follower's limits do not bind it, so wrong ones do not matter.
            if mimic is None:
                raise
            most = UNLIMITED_M if still.type == "prismatic" else math.pi
            lower, upper, effort = -most, most, 0.0
        axis, velocity = _axis(element, what, notes), _velocity_limit(element)
        return replace(still, axis=axis, lower=lower, upper=upper, effort=effort, mimic=mimic, velocity=velocity)
    except HandError as error:
        # The fault only matters if the hand moves by this joint.
        return replace(still, fault=str(error))


def _velocity_limit(element: Element) -> float:
    """Return the speed limit [rad/s or m/s]; 0 without a plausible one, since grasps do not need it."""
    limit = element.find("limit")
    try:
        value = abs(float(limit.get("velocity", "0"))) if limit is not None else 0.0
    except ValueError:
        return 0.0
    return value if math.isfinite(value) else 0.0


def _axis(element: Element, what: str, notes: list[str]) -> Floats:
    node = element.find("axis")
    axis = np.array([1.0, 0, 0]) if node is None else np.array(_parse_vector(node, "xyz", f"axis of {what}"))
    length = float(np.linalg.norm(axis))
    if length < 1e-9:
        raise HandError(f"{what}: the axis is zero; give a direction such as 0 0 1")
    if abs(length - 1) > 1e-3:
        notes.append(f"the axis of {what} has length {length:.3g} and was normalised")
    return axis / length


def _limits(element: Element, kind: str, what: str) -> tuple[float, float, float]:
    """Return lower and upper limit [rad or m] and effort [N m or N]; a continuous joint gets one turn."""
    limit = element.find("limit")
    if kind == "continuous":
        effort = 0.0 if limit is None else _parse_number(limit, "effort", f"limit of {what}", default=0.0)
        return -math.pi, math.pi, abs(effort)
    if limit is None or (limit.get("lower") is None and limit.get("upper") is None):
        raise HandError(f'{what}: no <limit>; a {kind} joint needs <limit lower=".." upper=".." effort=".."/>')
    lower = _parse_number(limit, "lower", f"limit of {what}", default=0.0)
    upper = _parse_number(limit, "upper", f"limit of {what}", default=0.0)
    effort = abs(_parse_number(limit, "effort", f"limit of {what}", default=0.0))
    if lower > upper:
        raise HandError(f"{what}: lower limit {lower:g} lies above the upper limit {upper:g}; exchange them")
    if max(abs(lower), abs(upper)) > (4 * math.pi if kind == "revolute" else MAX_LENGTH_M):
        raise HandError(f"{what}: limits {lower:g} .. {upper:g} are too large; give radians and metres")
    return lower, upper, effort


def _mimic(element: Element, what: str) -> Mimic | None:
    node = element.find("mimic")
    if node is None:
        return None
    multiplier = _parse_number(node, "multiplier", f"mimic of {what}", default=1.0)
    offset = _parse_number(node, "offset", f"mimic of {what}", default=0.0)
    return Mimic(node.get("joint", ""), multiplier, offset)


def _name(element: Element, what: str) -> str:
    name = element.get("name", "")
    if not name or len(name) > 128 or not name.isprintable():
        raise HandError(f"a {what} has no usable name ({name[:20]!r}); give 1 to 128 printable characters")
    return name


def _parse_number(element: Element, key: str, what: str, default: float | None = None) -> float:
    text = element.get(key)
    if text is None and default is not None:
        return default
    try:
        value = float(text or "")
    except ValueError:
        raise HandError(f"{what}: {key}={(text or '')[:40]!r} is not a number") from None
    if not math.isfinite(value):
        raise HandError(f"{what}: {key} is {text}; it must be finite")
    return value


def _parse_vector(element: Element, key: str, what: str, default: tuple[float, ...] | None = None) -> tuple[float, ...]:
    text = element.get(key)
    if text is None and default is not None:
        return default
    try:
        values = tuple(float(part) for part in (text or "")[:400].split())
    except ValueError:
        values = ()
    if len(values) != 3 or not all(map(math.isfinite, values)):
        raise HandError(f"{what}: {key}={(text or '')[:40]!r} must be three finite numbers")
    return values


def _origin(element: Element, what: str) -> Floats:
    node = element.find("origin")
    if node is None:
        return IDENTITY_POSE.copy()
    xyz = _parse_vector(node, "xyz", f"origin of {what}", default=(0.0, 0.0, 0.0))
    rpy = _parse_vector(node, "rpy", f"origin of {what}", default=(0.0, 0.0, 0.0))
    if max(map(abs, xyz)) > MAX_LENGTH_M:
        raise HandError(f"origin of {what} lies {max(map(abs, xyz)):g} m away; URDF lengths are metres")
    return np.concatenate([xyz, quat_from_rpy(np.array(rpy))])
