"""Visual meshes of the built-in hands: ``python -m docs.hand_meshes`` writes them beside the URDF files.

A link looks like its collision shapes with rounded edges, plus a pin at a hinge, so pictures show what touches."""

import re
import xml.etree.ElementTree as ET
from itertools import product
from pathlib import Path
from typing import Final

import numpy as np
import trimesh

from graspd.service.model.transforms import Floats

HANDS: Final = Path(__file__).parents[1] / "service" / "builtin" / "hands"
#: Radius of edges: largest [m], and as share of the smallest half extent.
ROUND: Final = 0.005
SOFTNESS: Final = 0.55
#: Size of a pin of a hinge over the extents of its link.
PIN: Final = 0.78
#: Length and radius of the neck of a ball that ends a finger, over the ball's radius.
NECK: Final = (1.35, 0.8)
#: sRGB of links, palms, tips and pins.
COLOURS: Final = {
    "link": (0.20, 0.21, 0.24), "palm": (0.15, 0.16, 0.18), "tip": (0.80, 0.81, 0.82), "pin": (0.50, 0.52, 0.55)
}  # fmt: skip
_BALL: Final = trimesh.creation.icosphere(subdivisions=2).vertices
_EDGE: Final = trimesh.creation.icosphere(subdivisions=1).vertices
_CIRCLE: Final = np.stack([np.cos(a := np.arange(20) * np.pi / 10), np.sin(a), np.zeros(20)], axis=1)


def _numbers(element: ET.Element | None, key: str, default: str) -> Floats:
    return np.array([float(part) for part in (default if element is None else element.get(key, default)).split()])


def _sum(*sets: Floats) -> trimesh.Trimesh:
    """Return the hull of the Minkowski sum of point sets."""
    points = np.zeros((1, 3))
    for one in sets:
        points = (points[:, None] + one).reshape(-1, 3)
    return trimesh.convex.convex_hull(points)


def _rounded(shape: ET.Element) -> trimesh.Trimesh:
    """Return a shape with rounded edges in its own frame [m]; round ones touch where the collision shape does."""
    radius, half = (float(shape.get(key, 0)) * share for key, share in (("radius", 1), ("length", 0.5)))
    ends = np.array([[0, 0, -half], [0, 0, half]])
    if shape.tag in ("sphere", "capsule"):
        return _sum(_BALL * radius, ends)
    extents = _numbers(shape, "size", f"{2 * radius} {2 * radius} {2 * half}") / 2
    edge = min(ROUND, SOFTNESS * extents.min())
    if shape.tag == "box":
        return _sum(_EDGE * edge, (extents - edge) * [*product((-1, 1), repeat=3)])
    return _sum(_EDGE * edge, _CIRCLE * (radius - edge), ends * (1 - edge / half))


def _link_meshes(link: ET.Element, joint: ET.Element | None) -> dict[str, trimesh.Trimesh]:
    """Return the meshes of a link by colour, in its frame [m]."""
    parts = []
    for element in link.findall("collision"):
        shape, origin = element.find("geometry/*"), element.find("origin")
        assert shape is not None
        pose = trimesh.transformations.euler_matrix(*_numbers(origin, "rpy", "0 0 0"), axes="sxyz")
        pose[:3, 3] = _numbers(origin, "xyz", "0 0 0")
        parts.append(_rounded(shape).apply_transform(pose))
    name = link.get("name", "")
    found = {"palm" if name == "palm" else "tip" if re.search("tip|distal", name) else "link": parts}
    if joint is not None and joint.get("type") == "fixed" and len(parts) == 1:
        ball = parts[0]
        radius, towards = ball.extents[0] / 2, -_numbers(joint.find("origin"), "xyz", "0 0 0")
        neck = ball.centroid + NECK[0] * radius * towards / np.linalg.norm(towards)
        parts[:] = [trimesh.convex.convex_hull(np.concatenate([ball.vertices, neck + _BALL * NECK[1] * radius]))]
    elif joint is not None:
        near = min(parts, key=lambda part: float(part.extents.min()))
        axis = _numbers(joint.find("axis"), "xyz", "1 0 0")
        across = np.abs(near.extents @ np.eye(3)[np.abs(axis) < 0.5].T)
        width = float(near.extents @ np.abs(axis)) * 1.04
        if width < 0.8 * across.max():
            pin = trimesh.creation.cylinder(PIN * across.min() / 2, width, sections=20)
            found["pin"] = [pin.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], axis))]
    return {colour: trimesh.util.concatenate(meshes) for colour, meshes in found.items()}


def write(hand: Path) -> None:
    """Write the meshes of a hand and name them in its URDF; equal meshes share a file."""
    text = re.sub(r" *<visual>.*</visual>\n", "", hand.read_text())
    folder = hand.parent / "meshes"
    folder.mkdir(exist_ok=True)
    robot = ET.fromstring(text)
    joints = {joint.find("child").get("link"): joint for joint in robot.findall("joint")}  # type: ignore[union-attr]
    files: dict[bytes, str] = {}
    for link in robot.findall("link"):
        visuals = ""
        for kind, mesh in _link_meshes(link, joints.get(name := link.get("name", ""))).items():
            data = mesh.export(file_type="stl")
            file = files.setdefault(data, f"meshes/{name}{'_pin' * (kind == 'pin')}.stl")
            (hand.parent / file).write_bytes(data)
            colour = " ".join(map(str, COLOURS[kind]))
            visuals += f'    <visual><geometry><mesh filename="{file}"/></geometry>'
            visuals += f'<material name="{kind}"><color rgba="{colour} 1"/></material></visual>\n'
        text = text.replace(f'<link name="{name}">\n', f'<link name="{name}">\n{visuals}')
    for path in folder.iterdir():
        if f"meshes/{path.name}" not in files.values():
            path.unlink()
    hand.write_text(text)


if __name__ == "__main__":
    for path in sorted(HANDS.glob("*/*.urdf")):
        write(path)
