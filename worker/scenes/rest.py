"""Static rest of a convex hull on a plane: its stable faces, and the next face onto which it tips.

A rigid body touches a plane only with its convex hull. A resting face is therefore a face of the hull. Its polygon
contains the projection of the centre of mass (Goldberg et al., "Part pose statistics", 1999)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from graspd.service.model.errors import MeshError
from graspd.service.model.transforms import Floats, quat_from_axis_angle, quat_multiply, quat_rotate
from graspd.worker.objects.model import Ints, ObjectModel

if TYPE_CHECKING:
    import trimesh

#: Hull triangles within this angle of each other are one flat face [rad].
COPLANAR_ANGLE = np.radians(0.05)
#: A face is unstable if the centre of mass projects outside its polygon by more than this share of the hull's size.
STABILITY_MARGIN = 1e-4
#: Resting faces whose normals differ by less than this [rad] count as one, since scanned flat bottoms have many facets.
SAME_FACE_ANGLE = np.radians(2.0)
#: Uncertainty of the surface of convex pieces and of real objects [m].
CHANGE_M = 1e-3
#: The object rolls if a change of its surface by `CHANGE_M` may turn it by more than this [rad].
ROLLS = np.radians(20.0)


@dataclass(frozen=True)
class RestingFaces:
    """C flat faces of the convex hull, in the object frame."""

    normal: Floats  # (C, 3) unit normals, outward
    offset: Floats  # (C,) normal . x of the face's plane [m].
    successor: Ints  # (C,) face onto which the object tips when placed on this face; the face itself where it is stable
    height: Floats  # (C,) height of the centre of mass above each face [m]
    sides: Ints  # (E, 2) pairs of adjacent faces; a row is one edge of its first face
    margin: Floats  # (E,) distance from each edge to the projected centre of mass, positive inside the face [m]
    width: Floats  # (E,) width of the face across each edge [m]

    @property
    def stable_faces(self) -> Ints:
        return np.flatnonzero(self.successor == np.arange(len(self.successor))).astype(np.int32)

    def possible_motion(self, face: int) -> tuple[float, float]:
        """Return the possible rotation [rad] and descent [m] of an object at rest on `face`.
        A change of the surface by `CHANGE_M` tilts the face. The object then tips over all edges that its centre of
        mass crosses."""
        from scipy.sparse import csr_array  # slow to import
        from scipy.sparse.csgraph import breadth_first_order

        here, there = self.sides.T
        crossed = self.margin <= self.height[here] * CHANGE_M / self.width
        count = len(self.normal)
        graph = csr_array((np.ones(int(crossed.sum())), (here[crossed], there[crossed])), shape=(count, count))
        reached = breadth_first_order(graph, face, return_predecessors=False)
        cosine = float((self.normal[reached] @ self.normal[face]).min())
        return float(np.arccos(np.clip(cosine, -1.0, 1.0))), float(self.height[face] - self.height[reached].min())

    def can_topple(self, face: int) -> bool:
        """Check whether a change of the surface by `CHANGE_M` lets the object fall to a lower face."""
        return self.possible_motion(face)[1] > CHANGE_M

    def can_roll(self, face: int) -> bool:
        """Check whether a change of the surface by `CHANGE_M` may turn the object by more than `ROLLS`."""
        return self.possible_motion(face)[0] > ROLLS


def count_rolling_poses(obj: ObjectModel, poses: Floats) -> int:
    """Count the rest poses (S, 7) on a table in which the object may roll, see `RestingFaces.can_roll`."""
    faces = resting_faces(obj.centred)
    return sum(faces.can_roll(stable_face_below(faces, pose[3:])[0]) for pose in np.asarray(poses, float))


def rolling_note(rolling: int, scenes: int) -> str | None:
    """Return a note on scenes in which the object may roll; None without such scenes."""
    if not rolling:
        return None
    return (
        f"in {rolling} of {scenes} scenes the object lies on a round side: a change of its surface by "
        f"{1e3 * CHANGE_M:.0f} mm may roll it by more than {np.degrees(ROLLS):.0f} degrees"
    )


def resting_faces(obj: ObjectModel) -> RestingFaces:
    """Compute the faces of the convex hull and how the object tips; raise MeshError for a flat hull."""
    import trimesh  # slow to import

    mesh = trimesh.Trimesh(obj.hull_vertices, obj.hull_faces, process=False)
    # The flat face that each hull triangle belongs to.
    pairs = mesh.face_adjacency[mesh.face_adjacency_angles < COPLANAR_ANGLE]
    label = np.asarray(trimesh.graph.connected_component_labels(pairs, node_count=len(mesh.faces)), np.int32)
    count = int(label.max()) + 1
    weighted = np.zeros((count, 3))
    np.add.at(weighted, label, mesh.face_normals * mesh.area_faces[:, None])
    length = np.linalg.norm(weighted, axis=1, keepdims=True)
    if not np.all(length > 0):
        raise MeshError(f"the convex hull of {obj.name!r} is flat; an object needs some thickness to be put on a table")
    normal = weighted / length
    offset = np.full(count, -np.inf)
    of_corner = np.repeat(label, 3)
    np.maximum.at(offset, of_corner, np.einsum("ij,ij->i", normal[of_corner], mesh.vertices[mesh.faces.ravel()]))
    sides, margin, width = _edges(mesh, label, normal, obj.centre_of_mass)
    successor = np.arange(count, dtype=np.int32)
    farthest = np.full(count, STABILITY_MARGIN * float(np.linalg.norm(mesh.extents)))
    for (here, there), overhang in zip(sides.tolist(), (-margin).tolist(), strict=True):
        if overhang > farthest[here]:
            farthest[here], successor[here] = overhang, there
    return RestingFaces(normal, offset, successor, offset - normal @ obj.centre_of_mass, sides, margin, width)


def _edges(mesh: trimesh.Trimesh, label: Ints, normal: Floats, centre: Floats) -> tuple[Ints, Floats, Floats]:
    """Return each edge of each flat face: faces on both sides (E, 2), distances and extents (E,) [m].
    The distance is from the edge to the projected centre of mass; the extent is the face's width across the edge."""
    edges, pairs = mesh.face_adjacency_edges, mesh.face_adjacency
    corners = [np.unique(mesh.faces[label == face]) for face in range(int(label.max()) + 1)]
    parts = []
    for side in (0, 1):
        here, there = label[pairs[:, side]], label[pairs[:, 1 - side]]
        start, end = mesh.vertices[edges[:, 0]], mesh.vertices[edges[:, 1]]
        outward = np.cross(end - start, normal[here])
        outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-30)
        opposite = mesh.triangles_center[pairs[:, side]]
        outward *= -np.sign(np.einsum("ij,ij->i", outward, opposite - start))[:, None]
        between = np.flatnonzero(here != there)
        inside = [((start[k] - mesh.vertices[corners[here[k]]]) @ outward[k]).max() for k in between]
        margin = np.einsum("ij,ij->i", outward, start - centre)[between]
        parts.append((np.stack([here, there], axis=1)[between], margin, np.maximum(inside, 1e-9)))
    sides, margins, widths = (np.concatenate(columns) for columns in zip(*parts, strict=True))
    return sides.astype(np.int32), margins, widths


def stable_face_below(faces: RestingFaces, quaternion: Floats) -> tuple[int, float]:
    """Return the stable face below the object, and the angle by which it turns to lie flat [rad].
    Start at the most downward face and tip over edges until a face is stable."""
    down = quat_rotate(np.asarray(quaternion) * np.array([1.0, -1, -1, -1]), np.array([0.0, 0.0, -1.0]))
    face = int(np.argmax(faces.normal @ down))
    # Each tip lowers the centre of mass, so the loop ends; the bound guards against rounding errors on spheres.
    for _ in range(len(faces.normal)):
        following = int(faces.successor[face])
        if following == face:
            break
        face = following
    return face, float(np.arccos(np.clip(faces.normal[face] @ down, -1.0, 1.0)))


def lay_flat(faces: RestingFaces, face: int, pose: Floats) -> Floats:
    """Turn the pose (7,) by the smallest rotation that puts the face onto z = 0; x and y stay."""
    normal = quat_rotate(pose[3:], faces.normal[face])
    axis = np.cross(normal, [0.0, 0.0, -1.0])
    sine = float(np.linalg.norm(axis))
    if sine > 1e-12:
        turn = quat_from_axis_angle(axis / sine, np.asarray(np.arctan2(sine, -normal[2])))
    else:
        turn = np.array([1.0, 0, 0, 0]) if normal[2] < 0 else np.array([0.0, 1, 0, 0])
    quaternion = quat_multiply(turn, pose[3:])
    quaternion /= np.linalg.norm(quaternion)
    return np.concatenate([pose[:2], [faces.offset[face]], quaternion])


def same_face_mask(faces: RestingFaces, face: int, others: Ints) -> Ints:
    """Return a mask of the `others` that are the same resting face, within `SAME_FACE_ANGLE`."""
    return faces.normal[np.asarray(others, int)] @ faces.normal[face] > np.cos(SAME_FACE_ANGLE)
