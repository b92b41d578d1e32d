"""Class and family of an object's shape, and its side of the split into train and report objects."""

import hashlib
from typing import Any, Final

import numpy as np

from graspd.service.model.transforms import Floats
from graspd.worker.objects.mesh_geometry import signed_volume
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.topology import face_vectors, pair_faces

#: Limits of sides of the tight box [m].
THIN_M, SMALL_M, WIDE_M = 0.015, 0.06, 0.09
#: Solid share of the convex hull below which an object is hollow, as are bowls, rings and branched objects.
HOLLOW: Final = 0.5
#: Ratio of two sides above which an object is flat or long.
SLENDER: Final = 2.5
#: Angle in the material below which an edge of the hull is sharp [rad]; area share of faces at such edges.
SHARP_RAD, SHARP_SHARE = float(np.radians(75.0)), 0.1
#: Classes in order of precedence.
CLASSES: Final = ("thin", "small", "wide", "hollow", "sharp", "flat", "long", "compact")


def shape_facts(obj: ObjectModel) -> dict[str, Any]:
    """Return `class`, `family`, `split` (train or report), and `sides_m` of the tight box [m].
    A family has equal proportions, whatever its size: ratios of sides in steps of 2^(1/4), solid share of the hull in
    steps of 1/20. A hash of the family draws the side of the split, so the sides share no family."""
    thickness, width, length = sides = box_sides(obj)
    solid = obj.volume / signed_volume(obj.hull_vertices, obj.hull_faces)
    applies = (
        thickness < THIN_M,
        length < SMALL_M,
        thickness > WIDE_M,
        solid < HOLLOW,
        sharp_share(obj) > SHARP_SHARE,
        width > SLENDER * thickness,
        length > SLENDER * width,
        True,
    )
    bins = np.rint([4 * np.log2(width / thickness), 4 * np.log2(length / width), 20 * solid])
    family = "-".join(f"{number:.0f}" for number in bins + 0.0)
    return {
        "class": CLASSES[applies.index(True)],
        "family": family,
        "split": ("train", "report")[hashlib.sha256(family.encode()).digest()[0] % 2],
        "sides_m": [round(side, 5) for side in sides],
    }


def box_sides(obj: ObjectModel) -> tuple[float, float, float]:
    """Return thickness, width and length [m] of a tight box around the convex hull.

    Thickness: least extent along a normal of the hull. Across it: rectangle of least area along an edge of the hull."""
    corners, points = obj.hull_vertices[obj.hull_faces], obj.hull_vertices
    normals = _unit(face_vectors(points, obj.hull_faces))
    extents = np.ptp(points @ normals.T, axis=0)
    axis = normals[extents.argmin()]
    edges = (corners - np.roll(corners, 1, axis=1)).reshape(-1, 3)
    edges -= np.outer(edges @ axis, axis)
    # Edges along the axis have no direction across it.
    along = _unit(edges[np.linalg.norm(edges, axis=1) > 1e-3 * extents.min()])
    one, other = (np.ptp(points @ lines.T, axis=0) for lines in (along, np.cross(axis, along)))
    best = (one * other).argmin()
    width, length = sorted((float(one[best]), float(other[best])))
    return float(extents.min()), width, length


def sharp_share(obj: ObjectModel) -> float:
    """Return the area share of the hull's faces that lie at a sharp edge."""
    vectors = face_vectors(obj.hull_vertices, obj.hull_faces)
    normals, areas = _unit(vectors), np.linalg.norm(vectors, axis=1)
    one, two, _ = pair_faces(obj.hull_faces.astype(np.int64))
    sharp = np.einsum("ij,ij->i", normals[one], normals[two]) < -np.cos(SHARP_RAD)
    return float(areas[np.unique([one[sharp], two[sharp]])].sum() / areas.sum())


def _unit(vectors: Floats) -> Floats:
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
