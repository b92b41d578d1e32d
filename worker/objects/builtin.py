"""The built-in objects: parametric solids, written as binary STL in metres, z up, standing on z = 0.

``python -m graspd.worker.objects.builtin`` writes them into `service/builtin/objects/`.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import manifold3d
import numpy as np
from manifold3d import CrossSection, Manifold

from graspd.worker.objects.mesh_geometry import from_manifold
from graspd.worker.objects.topology import merge_vertices

#: Corners of a full circle: the chord of the mug's outer wall stays within 0.05 mm.
SEGMENTS: Final = 64


def mug() -> Manifold:
    """Return a mug of 80 mm diameter and 95 mm height with 4.5 mm walls and a handle toward +x."""
    radius, height, wall, floor = 0.040, 0.095, 0.0045, 0.006
    profile = rounded([(0.0, 0.0), (radius - 0.002, 0.0), (radius, 0.003), (radius, height), (0.0, height)])
    body = Manifold.revolve(profile, SEGMENTS)
    inside = radius - wall
    top = height + 0.01
    inner = [(0.0, floor), (inside - 0.004, floor), (inside, floor + 0.004), (inside, top), (0.0, top)]
    cavity = Manifold.revolve(rounded(inner), SEGMENTS)
    # The handle is a flattened ring with its centre on the wall; the part inside the cup is cut away.
    ring = Manifold.revolve(CrossSection.circle(0.0055, 24).translate((0.024, 0.0)), 64)
    ring = ring.scale((1.0, 1.25, 1.15)).rotate((90.0, 0.0, 0.0)).translate((radius, 0.0, height * 0.5))
    outside = ring - Manifold.cylinder(2 * height, radius - wall / 2, -1.0, SEGMENTS, True)
    return (body + outside) - cavity


def bottle() -> Manifold:
    """Return a closed bottle of 64 mm diameter and 180 mm height with a neck."""
    profile = [(0.0, 0.0), (0.029, 0.0), (0.032, 0.004)]
    profile += [(0.032, 0.02 + 0.09 * t) for t in np.linspace(0, 1, 4)]
    for t in np.linspace(0, 1, 17)[1:]:
        blend = (1 - math.cos(math.pi * t)) / 2
        profile.append((0.032 + (0.0135 - 0.032) * blend, 0.11 + 0.038 * t))
    profile += [(0.0135, 0.165), (0.0155, 0.166), (0.0155, 0.178), (0.0135, 0.180), (0.0, 0.180)]
    return Manifold.revolve(rounded(profile), SEGMENTS)


def block() -> Manifold:
    """Return a box of 60 x 45 x 90 mm with its twelve edges chamfered by 3 mm."""
    x, y, z, chamfer = 0.060, 0.045, 0.090, 0.003
    boxes = [(x, y - 2 * chamfer, z - 2 * chamfer), (x - 2 * chamfer, y, z - 2 * chamfer)]
    boxes += [(x - 2 * chamfer, y - 2 * chamfer, z)]
    return Manifold.batch_hull([Manifold.cube(size, True) for size in boxes]).translate((0.0, 0.0, z / 2))


def rounded(points: list[tuple[float, float]]) -> CrossSection:
    """Return the polygon of a half profile (radius, height) [m], counter-clockwise."""
    return CrossSection([np.array(points, dtype=np.float64)], manifold3d.FillRule.NonZero)


OBJECTS: Final[dict[str, tuple[Callable[[], Manifold], str, float]]] = {
    "mug": (mug, "A stoneware mug with a handle: hollow, thin-walled.", 2300.0),
    "bottle": (bottle, "A closed, filled bottle with a neck.", 1000.0),
    "block": (block, "A wooden block with chamfered edges.", 650.0),
}


def files_of(name: str) -> dict[str, bytes]:
    """Return the files of a built-in object as in `service/builtin/objects/NAME/`."""
    make, description, density = OBJECTS[name]
    vertices, faces = tidy(*from_manifold(make()))
    asset: dict[str, Any] = {"file": f"{name}.stl", "units": "m", "description": description, "density": density}
    return {f"{name}.stl": stl_bytes(vertices, faces), "asset.json": (json.dumps(asset, indent=2) + "\n").encode()}


def tidy(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Remove the faces along a seam whose vertices coincide in single precision."""
    vertices, faces = merge_vertices(vertices.astype(np.float32).astype(float), faces, 2e-6)
    return vertices, faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]


def stl_bytes(vertices: np.ndarray, faces: np.ndarray) -> bytes:
    """Return a binary STL."""
    corners = vertices[faces].astype("<f4")
    a, b, c = np.moveaxis(corners.astype(float), 1, 0)
    normals = np.cross(b - a, c - a)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    records = np.zeros(len(faces), dtype=[("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    records["normal"], records["corners"] = normals, corners
    return b"graspd built-in".ljust(80) + struct.pack("<I", len(faces)) + records.tobytes()


def write(root: Path) -> None:
    """Write every built-in object below `root`."""
    for name in OBJECTS:
        (root / name).mkdir(parents=True, exist_ok=True)
        for filename, data in files_of(name).items():
            (root / name / filename).write_bytes(data)


if __name__ == "__main__":
    write(Path(__file__).parents[2] / "service" / "builtin" / "objects")
