"""Geometry of closed meshes: exact mass properties, corner normals, float64 booleans by manifold3d.

An object has two frames with the same axes. Poses are stored in the file's frame. The engine works in the centred frame
at the middle of the mesh's bounding box. Results therefore have the same bits for every origin of the file."""

from dataclasses import dataclass
from typing import Any, Final

import manifold3d
import numpy as np
from numpy.typing import ArrayLike

from graspd.service.model.transforms import Floats, quat_rotate
from graspd.worker.grasps import move_poses
from graspd.worker.objects.model import Ints
from graspd.worker.objects.topology import FaceIndices, Indices, connected_parts, face_vectors


@dataclass(frozen=True)
class MassProperties:
    """Volume [m^3], centre of mass (3,) [m], inertia (3, 3) about it per unit of mass [m^2]."""

    volume: float
    centre_of_mass: Floats
    inertia: Floats


def mass_properties(vertices: Floats, faces: FaceIndices) -> MassProperties:
    """Compute mass properties as sums over tetrahedra between the faces and one point (Tonon 2004).
    The point is the mean vertex, so that a mesh far from its origin loses no digits."""
    origin = vertices.mean(axis=0)
    a, b, c = np.moveaxis(vertices[faces] - origin, 1, 0)
    six_volumes = np.einsum("ij,ij->i", a, np.cross(b, c))
    volume = float(six_volumes.sum() / 6)
    first = (six_volumes[:, None] * (a + b + c)).sum(axis=0) / 24
    centre = first / volume
    # Second moment of a tetrahedron with one corner at 0: V/20 (sum of outer products + outer product of the sum).
    total = a + b + c
    weight = six_volumes / 120
    second = sum(np.einsum("i,ij,ik->jk", weight, p, p) for p in (a, b, c, total))
    covariance = np.asarray(second) / volume - np.outer(centre, centre)
    inertia = np.trace(covariance) * np.eye(3) - covariance
    return MassProperties(volume, origin + centre, (inertia + inertia.T) / 2)


def signed_volume(vertices: Floats, faces: FaceIndices) -> float:
    """Compute the volume [m^3]; negative for a closed mesh that is wound inwards."""
    a, b, c = np.moveaxis(vertices[faces] - vertices[faces[0, 0]], 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6)


#: Faces that meet at a larger angle [deg] keep their own normals: averaged ones round a cylinder's rim by millimetres.
CREASE_DEG = 40.0


def corner_normals(vertices: Floats, faces: Ints) -> Floats:
    """Compute a unit normal for each corner of each face (F, 3, 3).
    The normal of a corner is the mean normal of the faces at its vertex, weighted by their angle there. Only faces
    inclined to the corner's own face by less than the crease angle count."""
    from scipy.sparse import csr_matrix

    face_normals = face_vectors(vertices, faces)
    face_normals /= np.maximum(np.linalg.norm(face_normals, axis=1, keepdims=True), 1e-300)
    angles = _corner_angles(vertices[faces]).reshape(-1)
    count = 3 * len(faces)
    face_of = np.arange(count) // 3
    incidence = csr_matrix((np.ones(count), (np.arange(count), faces.reshape(-1))), shape=(count, len(vertices)))
    pairs = (incidence @ incidence.T).tocoo()
    near = np.einsum("ij,ij->i", face_normals[face_of[pairs.row]], face_normals[face_of[pairs.col]])
    keep = near > np.cos(np.deg2rad(CREASE_DEG))
    row, column = pairs.row[keep], pairs.col[keep]
    weights = csr_matrix((angles[column], (row, face_of[column])), shape=(count, len(faces)))
    normals = weights @ face_normals
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-12, normals / np.maximum(length, 1e-300), face_normals[face_of])
    return normals.reshape(-1, 3, 3)


def points_on_triangles(corners: Floats, u: Floats, v: Floats) -> Floats:
    """Return points (n, 3) of triangles (n, 3, 3), uniform for uniform numbers u, v (n, 1) in [0, 1)."""
    u, v = np.where(u + v > 1, 1 - u, u), np.where(u + v > 1, 1 - v, v)
    return corners[:, 0] + u * (corners[:, 1] - corners[:, 0]) + v * (corners[:, 2] - corners[:, 0])


def _corner_angles(corners: Floats) -> Floats:
    """Compute the angle (F, 3) of each triangle (F, 3, 3) at each corner [rad]."""
    out = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    lengths = np.maximum(np.linalg.norm(out, axis=2) * np.linalg.norm(back, axis=2), 1e-300)
    return np.arccos(np.clip(np.einsum("ijk,ijk->ij", out, back) / lengths, -1, 1))


#: Tolerance of a gap's bound, as a share of the bound, since coordinates of files are rounded.
_ROUNDING: Final = 1e-3


def to_manifold(vertices: Floats, faces: Indices) -> Any | None:
    """Convert the mesh to a manifold3d solid; None if it is no oriented 2-manifold."""
    corners, triangles = np.array(vertices, np.float64, order="C"), np.array(faces, np.uint64, order="C")
    solid = manifold3d.Manifold(manifold3d.Mesh64(corners, triangles))
    return None if solid.status() != manifold3d.Error.NoError or solid.is_empty() else solid


def unite(parts: list[tuple[Floats, Indices]], holes: list[tuple[Floats, Indices]]) -> Any:
    """Unite closed outward meshes and subtract the holes (outward too).
    A part inside a hole is separate from the solid around the hole, and stays. A part without thickness is ignored."""
    solids, cuts = ([solid for mesh in side if (solid := to_manifold(*mesh)) is not None] for side in (parts, holes))
    loose = [solid for solid in solids if any((solid - cut).is_empty() for cut in cuts)]
    result = union([solid for solid in solids if not any(solid is one for one in loose)])
    for cut in cuts:
        result -= cut
    return union([result, *loose]) if loose else result


def union(solids: list[Any]) -> Any:
    return manifold3d.Manifold.batch_boolean(solids, manifold3d.OpType.Add)


def group_solids(pieces: list[Any], gap: float) -> list[list[Any]]:
    """Group solids connected over gaps of at most `gap`, the group of the largest volume first."""
    low, high = np.moveaxis(np.reshape([piece.bounding_box() for piece in pieces], (-1, 2, 3)), 1, 0)
    pairs = [
        (i, j)
        for i, piece in enumerate(pieces)
        for j in (i + 1 + np.flatnonzero(_box_separation(low, high, i) <= gap * (1 + _ROUNDING))).tolist()
        if piece.min_gap(pieces[j], 2 * gap) <= gap * (1 + _ROUNDING) and not _is_nested(piece, pieces[j])
    ]
    one, other = np.array(pairs, dtype=np.int64).reshape(-1, 2).T
    label = connected_parts(one, other, len(pieces))
    found = [[pieces[i] for i in np.flatnonzero(label == k)] for k in range(label.max() + 1)]
    return sorted(found, key=lambda group: -sum(piece.volume() for piece in group))


def _is_nested(a: Any, b: Any) -> bool:
    """Check whether one of two outer shells contains the other shell, loose in a cavity."""
    small, large = sorted((a, b), key=lambda one: float(one.volume()))
    return bool((small - large).is_empty())


def _box_separation(low: Floats, high: Floats, i: int) -> Floats:
    return np.asarray(np.linalg.norm(np.maximum(0, np.maximum(low[i] - high[i + 1 :], low[i + 1 :] - high[i])), axis=1))


#: Digits of the longest extent to which coordinates are rounded; least number of digits of decimal coordinates.
DIGITS: Final = 9
LEAST_DIGITS: Final = 5


@dataclass(frozen=True)
class CentredMesh:
    """Points of a mesh relative to the middle of their bounding box, in the units of its file."""

    points: Floats  # (V, 3)
    centre: Floats  # (3,) the middle in the file's frame
    resolution: float  # spacing of the file's numbers at the mesh's position


def centre_points(points: Floats) -> CentredMesh:
    """Centre points (V, 3), rounded so that they do not depend on the origin.
    Coordinates that are all decimals within the precision of the file's numbers become these decimals. A mesh of
    decimals is then identical at every distance that the numbers resolve."""
    low, extent = points.min(axis=0), float(np.ptp(points, axis=0).max())
    farthest = np.abs(points).max()
    # Numbers that survive the conversion to 32 bits identify files of 32-bit numbers.
    with np.errstate(over="ignore"):
        single = bool((points == points.astype(np.float32)).all())
    resolution = float(np.spacing(np.float32(farthest) if single else farthest))
    size = np.floor(np.log10(extent)) if extent > 0 else 0.0
    finest = 10.0 ** (DIGITS - 1 - size)
    scale = 10.0 ** np.clip(np.floor(-np.log10(2 * resolution)), LEAST_DIGITS - 1 - size, DIGITS - 1 - size)
    steps = (points - low) * scale
    if (np.abs(steps - np.rint(steps)) > 1.01 * resolution * scale).any():
        steps, scale = (points - low) * finest, finest
    steps = np.rint(steps)
    ends = steps.min(axis=0) + steps.max(axis=0)
    # Twice the distance from the middle is a whole number of steps: only the division rounds, equally for every scale.
    return CentredMesh((2 * steps - ends) / (2 * scale), low + ends / (2 * scale), resolution)


def shift_frame(pose: ArrayLike, by: ArrayLike) -> Floats:
    """Return poses (..., 7) of a frame with its origin moved by a vector (3,) in that frame [m]."""
    pose, by = np.array(pose, float), np.asarray(by, float)
    if by.any():
        pose[..., :3] += quat_rotate(pose[..., 3:], by)
    return pose


def to_centred_frame(pose: ArrayLike, centre: ArrayLike) -> Floats:
    """Convert poses (..., 7) of the file's frame to the centred frame, whose origin is `centre` (3,).
    The result is on a grid, so that the round trip gives the same bits."""
    return move_poses(shift_frame(pose, centre), np.zeros(3))


def to_file_frame(pose: ArrayLike, centre: ArrayLike) -> Floats:
    """Convert poses (..., 7) of the centred frame to the file's frame."""
    return shift_frame(pose, -np.asarray(centre, float))
