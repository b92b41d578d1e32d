"""Arrays of a hand and of an object on a Warp device, and body poses of many hands."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats
from graspd.worker.hands.jaws import prismatic_dofs
from graspd.worker.hands.model import ConvexPiece, HandModel, JointType
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.topology import face_vectors
from graspd.worker.simulation.grids import add_grid, upload_faces
from graspd.worker.simulation.kernels import chain as kernels
from graspd.worker.simulation.kernels import kinematics, nearest, pieces, surface

#: Kernels' numbers for `ConvexPiece.kind`.
_KINDS: Final = {"box": 0, "sphere": 1, "cylinder": 2, "capsule": 3, "hull": 4}
SAMPLE_CELL_M: Final = 0.008  # edge of the grid cells by which object samples are sorted [m]
SLIDE_M: Final = 0.05  # travel of a sliding joint that moves a fingertip as much as one radian of a revolute joint [m]


def to_xyzw(quaternion: Floats) -> Floats:
    """Convert quaternions (..., 4) from graspd's order w x y z to Warp's x y z w."""
    return np.roll(quaternion, -1, axis=-1)


def to_wxyz(quaternion: Floats) -> Floats:
    """Convert quaternions (..., 4) from Warp's order x y z w to graspd's w x y z."""
    return np.roll(quaternion, 1, axis=-1)


def joint_units(hand: HandModel) -> Floats:
    """Return the step of each dof (D,) relative to a revolute joint: 1, or `SLIDE_M` for a sliding one."""
    return np.where(prismatic_dofs(hand), SLIDE_M, 1.0)


@dataclass(frozen=True)
class DeviceHand:
    """A hand on the device: joint tree, convex pieces, limits."""

    model: HandModel
    device: str
    tree: Any
    pieces: Any
    lower: Any
    upper: Any

    @classmethod
    def create(cls, hand: HandModel, device: str) -> DeviceHand:
        tree = kinematics.Tree()
        with wp.ScopedDevice(device):
            _add_joints(tree, hand, wp.vec3, wp.quat, wp.float32)
            tree.joint_type = wp.array(hand.joint_type, dtype=wp.int32)
            tree.pivot = wp.vec3(*hand.palm.centre)
            lower, upper = (wp.array(limit, dtype=wp.float32) for limit in (hand.lower, hand.upper))
            out = pieces.Pieces()
            size, position, rotation, half, planes = zip(*map(_piece_row, hand.pieces), strict=True)
            apart = np.ones((hand.bodies, hand.bodies), dtype=np.int32) - np.eye(hand.bodies, dtype=np.int32)
            for a, b in hand.neighbours:
                apart[a, b] = apart[b, a] = 0
            out.body = wp.array([p.body for p in hand.pieces], dtype=wp.int32)
            out.kind = wp.array([_KINDS[p.kind] for p in hand.pieces], dtype=wp.int32)
            out.size = wp.array(np.array(size), dtype=wp.vec3)
            out.pose_p = wp.array(np.array(position), dtype=wp.vec3)
            out.pose_q = wp.array(to_xyzw(np.array(rotation)), dtype=wp.quat)
            out.half = wp.array(np.array(half), dtype=wp.vec3)
            out.first_plane = wp.array(np.cumsum([0, *map(len, planes)]), dtype=wp.int32)
            out.planes = wp.array(np.concatenate([*planes, np.zeros((1, 4))]), dtype=wp.vec4)
            out.apart = wp.array(apart, dtype=wp.int32)
            return cls(hand, device, tree, out, lower, upper)


def _add_joints(out: Any, hand: HandModel, vector: Any, quaternion: Any, number: Any) -> None:
    out.parent, out.dof = (wp.array(index, dtype=wp.int32) for index in (hand.parent, hand.dof))
    out.origin_p, out.axis = (wp.array(rows, dtype=vector) for rows in (hand.origin[:, :3], hand.axis))
    out.origin_q = wp.array(to_xyzw(hand.origin[:, 3:]), dtype=quaternion)
    out.multiplier, out.offset = (wp.array(values, dtype=number) for values in (hand.multiplier, hand.offset))


def _piece_row(piece: ConvexPiece) -> tuple[Floats, Floats, Floats, Floats, Floats]:
    """Return size, position, quaternion (w x y z), half extents and planes of a piece for the kernels."""
    none = np.zeros((0, 4))
    position, rotation = piece.pose[:3], piece.pose[3:]
    if piece.kind == "box":
        half = np.array(piece.size) / 2
        return half, position, rotation, half, none
    if piece.kind == "sphere":
        r = piece.size[0]
        return np.array([r, 0, 0]), position, rotation, np.full(3, r), none
    if piece.kind in ("cylinder", "capsule"):
        r, length = piece.size
        caps = r if piece.kind == "capsule" else 0.0
        return np.array([r, length / 2, 0]), position, rotation, np.array([r, r, length / 2 + caps]), none
    low, high = piece.vertices.min(axis=0), piece.vertices.max(axis=0)
    centre = (low + high) / 2
    planes = face_planes(piece.vertices - centre, piece.faces)
    return np.zeros(3), centre, np.array([1.0, 0, 0, 0]), (high - low) / 2, planes


def face_planes(vertices: Floats, faces: NDArray[np.integer[Any]]) -> Floats:
    """Return the planes (K, 4) of a convex solid's sides: outward unit normal and offset [m]."""
    normal = face_vectors(vertices, faces)
    length = np.linalg.norm(normal, axis=1)
    keep = length > 1e-14
    normal = normal[keep] / length[keep, None]
    planes = np.column_stack([normal, np.einsum("ij,ij->i", normal, vertices[faces[keep, 0]])])
    # Planes closer than 1e-4 rad and 1 um are one plane: hulls of boxes have two triangles a side.
    _, first = np.unique(np.round(planes / np.array([1e-4, 1e-4, 1e-4, 1e-6])), axis=0, return_index=True)
    return planes[np.sort(first)]


@dataclass(frozen=True)
class DeviceObject:
    """An object on the device, origin at its centre of mass: surface, distance grid, surface samples."""

    model: ObjectModel
    device: str
    surface: Any
    mesh: Any
    samples: Any
    bvh: Any
    sorted_samples: Any  # the samples sorted by the cells of a grid

    @classmethod
    def create(cls, obj: ObjectModel, device: str, *, samples: Floats, phong_alpha: float, cell: float) -> DeviceObject:
        """Upload an object with `samples` (S, 3) of its surface, object frame [m].
        `phong_alpha` is 0 for flat faces, 1 for full Phong projection. `cell` is the cell size of the distance grid
        [m]; with 0 there is no grid."""
        with wp.ScopedDevice(device):
            points = wp.array(obj.vertices - obj.centre_of_mass, dtype=wp.vec3)
            mesh = wp.Mesh(points=points, indices=wp.array(obj.faces.ravel(), dtype=wp.int32))
            skin = surface.Surface()
            skin.mesh = mesh.id
            skin.corner_normals = wp.array(obj.corner_normals.reshape(-1, 3), dtype=wp.vec3)
            skin.alpha = phong_alpha
            skin.field = wp.zeros((0, 0, 0), dtype=wp.float32)
            skin.cells = nearest.Cells()
            skin.cells.faces = upload_faces(obj)
            if cell > 0:
                add_grid(skin, obj, mesh, cell)
            centred = wp.array(samples - obj.centre_of_mass, dtype=wp.vec3)
            cells = sorted_samples(samples - obj.centre_of_mass)
        return cls(obj, device, skin, mesh, centred, wp.Bvh(centred, centred), cells)

    def with_fewer_samples(self, count: int) -> DeviceObject:
        """Return the object with its first `count` samples, which are evenly spread."""
        if count >= len(self.samples):
            return self
        with wp.ScopedDevice(self.device):
            samples = wp.clone(self.samples[:count])
            cells = sorted_samples(samples.numpy())
            return replace(self, samples=samples, bvh=wp.Bvh(samples, samples), sorted_samples=cells)


def sorted_samples(samples: Floats) -> Any:
    """Sort points (S, 3) [m] by the cells of a grid, and upload them to the current Warp device."""
    low = samples.min(axis=0)
    # At most 65 cells a side, so a large object has larger cells.
    size = max(SAMPLE_CELL_M, float((samples.max(axis=0) - low).max()) / 64)
    cell = np.floor((samples - low) / size).astype(int)
    shape = cell.max(axis=0) + 1
    index = np.ravel_multi_index(tuple(cell.T), tuple(shape))
    order = np.argsort(index, kind="stable")
    out = pieces.Samples()
    out.position = wp.array(samples[order], dtype=wp.vec3)
    out.first = wp.array(np.searchsorted(index[order], np.arange(int(np.prod(shape)) + 1)), dtype=wp.int32)
    out.low, out.size, out.shape = wp.vec3(*low.tolist()), size, wp.vec3i(*shape.tolist())
    return out


def posed_bodies(hand: HandModel, hand_pose: Floats, joint_positions: Floats, device: str = "cpu") -> Any:
    """Return `kernels.chain.Bodies` (P, L) for roots (P, 7) and joints (P, J), equal to `body_poses`."""
    chain, count = chain_of(hand, device), len(hand_pose)
    with wp.ScopedDevice(device):
        root, joints = (
            wp.array(np.ascontiguousarray(given, float), dtype=wp.float64, ndim=2)
            for given in (hand_pose, joint_positions)
        )
        bodies = allocate_bodies(hand, count)
        wp.launch(kernels.pose, count, inputs=[chain, root, joints], outputs=[bodies])
    return bodies


def allocate_bodies(hand: HandModel, count: int) -> Any:
    """Allocate uninitialised body poses of `count` hands on the current device."""
    out = kernels.Bodies()
    out.position = wp.empty((count, hand.bodies), dtype=wp.vec3d)
    out.rotation = wp.empty((count, hand.bodies), dtype=wp.quatd)
    return out


@cached_by_content(8)
def chain_of(hand: HandModel, device: str) -> Any:
    """Return the hand on a device as `kernels.chain.Chain`, cached in memory."""
    # Loading here prevents threads from compiling the same module at once.
    wp.load_module(module=kernels, device=device)
    out, features = kernels.Chain(), hand.features
    joint = np.zeros(hand.bodies, np.int32)
    joint[hand.joint_body] = np.arange(len(hand.joint_body))
    order = np.argsort(features.body, kind="stable")
    with wp.ScopedDevice(device):
        _add_joints(out, hand, wp.vec3d, wp.quatd, wp.float64)
        out.joint = wp.array(joint, dtype=wp.int32)
        out.turns = wp.array(hand.joint_type == JointType.REVOLUTE, dtype=wp.int32)
        out.tip = wp.array(np.isin(np.arange(hand.bodies), hand.fingertips), dtype=wp.int32)
        out.first = wp.array(np.searchsorted(features.body[order], np.arange(hand.bodies + 1)), dtype=wp.int32)
        out.centre = wp.array(features.centre[order], dtype=wp.vec3d)
        out.about = wp.array(features.axis[order], dtype=wp.vec3d)
        out.radius = wp.array(features.radius[order], dtype=wp.float64)
    return out


def bounding_ball(points: Floats) -> tuple[Floats, float]:
    """Return centre and radius [m] of a ball around points (N, 3) and their box; zeros without points."""
    if not len(points):
        return np.zeros(3), 0.0
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    return centre, float(np.linalg.norm(points - centre, axis=1).max())
