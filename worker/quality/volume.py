"""Volume shared by hand and object, the pieces that may share it, and the depth of penetration.

The volume is that of an exact boolean operation on solids. If the object is not closed, voxels are counted."""

from functools import cached_property
from typing import Any, Final

import manifold3d as m3d
import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, apply, pose_to_matrix
from graspd.worker.hands.model import ConvexPiece, HandModel
from graspd.worker.hands.surface import piece_distance
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.topology import face_vectors
from graspd.worker.quality.probe import Distances, Probe
from graspd.worker.simulation.device import to_xyzw
from graspd.worker.simulation.kernels import crossing as kernels
from graspd.worker.simulation.launches import launch

VOXEL_M: Final = 5e-4  # edge of a voxel [m]: the error is at most half an edge times the surface of the shared volume
#: Solids are built in millimetres: the tolerance of manifold3d's single precision suits numbers around 100.
_UNIT: Final = 1e3


class SharedVolume:
    """Intersection volumes of one (hand, object) pair. Thread-safe."""

    def __init__(self, hand: HandModel, obj: ObjectModel) -> None:
        self.hand, self.obj = hand, obj
        self._pieces = [
            _build_manifold(p.vertices, p.faces)
            or m3d.Manifold.hull_points(np.ascontiguousarray(p.vertices * _UNIT, np.float32))
            for p in hand.pieces
        ]
        self._body = np.array([p.body for p in hand.pieces], np.intp)
        self._object = _build_manifold(obj.vertices - obj.centre_of_mass, obj.faces)

    @property
    def is_exact(self) -> bool:
        return self._object is not None

    def volumes(self, bodies: Floats, near: NDArray[np.bool_]) -> Floats:
        """Compute the volume (B,) inside both the object and the union of the hand's pieces [cm^3].
        The bodies are at (B, L, 7) in the object frame; only pieces `near` (B, P) count."""
        return np.array([self._volume_of_hand(bodies[b], np.flatnonzero(near[b])) for b in range(len(bodies))])

    def _volume_of_hand(self, bodies: Floats, pieces: NDArray[np.intp]) -> float:
        if not len(pieces):
            return 0.0
        if self._object is None:
            return self.voxel_volume(bodies, pieces)
        matrices = pose_to_matrix(bodies[self._body[pieces]])[:, :3]
        matrices[..., 3] = (matrices[..., 3] - self.obj.centre_of_mass) * _UNIT
        posed = [self._pieces[p].transform(matrix) for p, matrix in zip(pieces, matrices, strict=True)]
        parts = [part for part in (self._object ^ solid for solid in posed) if not part.is_empty()]
        if not parts:
            return 0.0
        # Intersections rarely overlap, so their union is cheap. A union of whole pieces is expensive.
        whole = parts[0] if len(parts) == 1 else m3d.Manifold.batch_boolean(parts, m3d.OpType.Add)
        return float(whole.volume()) / _UNIT**3 * 1e6

    @cached_property
    def _probe(self) -> Probe:
        return Probe(self.hand, self.obj, hand_points=self.hand.bodies * 16, object_points=64)

    def voxel_volume(self, bodies: Floats, pieces: NDArray[np.intp]) -> float:
        """Return the volume of the voxels with centres inside both the object and the pieces [cm^3]."""
        matrices = pose_to_matrix(bodies[self._body[pieces]])
        solids = [self.hand.pieces[p] for p in pieces]
        posed = [piece.vertices @ m[:3, :3].T + m[:3, 3] for piece, m in zip(solids, matrices, strict=True)]
        corners, vertices = np.concatenate(posed), self.obj.vertices
        low, high = np.maximum(corners.min(0), vertices.min(0)), np.minimum(corners.max(0), vertices.max(0))
        if (high <= low).any():
            return 0.0
        axes = [np.arange(a + VOXEL_M / 2, b, VOXEL_M) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        inside = np.zeros(len(grid), dtype=bool)
        for piece, m in zip(solids, matrices, strict=True):
            inside |= piece_distance(piece, (grid - m[:3, 3]) @ m[:3, :3]) < 0
        if not inside.any():
            return 0.0
        depth = self._probe.signed_distance(grid[inside])[0]
        return float((depth < 0).sum()) * VOXEL_M**3 * 1e6


def _build_manifold(vertices: Floats, faces: NDArray[np.int32]) -> m3d.Manifold | None:
    mesh = m3d.Mesh(
        vert_properties=np.ascontiguousarray(vertices * _UNIT, dtype=np.float32),
        tri_verts=np.ascontiguousarray(faces, dtype=np.uint32),
    )
    solid = m3d.Manifold(mesh)
    feasible = solid.status() == m3d.Error.NoError and not solid.is_empty() and solid.volume() > 0
    return solid if feasible else None


_DIGITS: Final = 7  # planes that are equal in this many decimals (offsets [m] and unit normals) count as one


class Overlap:
    """Conservative overlap test of a hand's pieces with a closed object.
    A piece is excluded only if no face of the object may reach into it and neither body contains a part of the
    other."""

    def __init__(self, hand: HandModel, probe: Probe) -> None:
        self._probe = probe
        self._body = np.array([p.body for p in hand.pieces], np.intp)
        self._corner = np.array([p.vertices[0] for p in hand.pieces])
        with wp.ScopedDevice("cpu"):
            wp.load_module(module=kernels, device="cpu")
        self._solids = _solids(hand.pieces)

    def overlapping_pieces(self, found: Distances, near: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return a mask (B, P) of those `near` (B, P) pieces that may share volume with the object."""
        row, piece = np.nonzero(near)
        if not len(row):
            return near
        poses = found.bodies[row, self._body[piece]]
        meets = self._crossing_mask(piece, poses) | (found.piece_distance[row, piece] < 0)
        rest = np.flatnonzero(~meets)
        meets[rest] = self._probe.signed_distance(apply(poses[rest], self._corner[piece[rest]]))[0] < 0
        out = np.zeros_like(near)
        out[row, piece] = meets
        return out

    def _crossing_mask(self, piece: NDArray[np.intp], poses: Floats) -> NDArray[np.bool_]:
        centre = self._probe.obj.centre_of_mass
        given = np.concatenate([poses[:, :3] - centre, to_xyzw(poses[:, 3:])], axis=1)
        with wp.ScopedDevice("cpu"):
            crossed = wp.zeros(len(piece), dtype=wp.int32)
            inputs = [wp.array(piece, dtype=wp.int32), wp.array(given, dtype=wp.transform)]
            inputs = [self._probe.mesh.id, self._solids, *inputs]
            launch(kernels.faces_in_solids, len(piece), inputs=inputs, outputs=[crossed], device="cpu")
        return np.asarray(crossed.numpy() != 0)


def _solids(pieces: tuple[ConvexPiece, ...]) -> Any:
    planes, corners = [_planes(p) for p in pieces], [p.vertices for p in pieces]
    low, high = (np.array([f(c, axis=0) for c in corners]) for f in (np.min, np.max))
    solids = kernels.Solids()
    with wp.ScopedDevice("cpu"):
        solids.plane = wp.array(np.concatenate(planes), dtype=wp.vec4)
        solids.first_plane = wp.array(np.cumsum([0, *map(len, planes)]), dtype=wp.int32)
        solids.corner = wp.array(np.concatenate(corners), dtype=wp.vec3)
        solids.first_corner = wp.array(np.cumsum([0, *map(len, corners)]), dtype=wp.int32)
        solids.middle = wp.array((low + high) / 2, dtype=wp.vec3)
        solids.half = wp.array((high - low) / 2, dtype=wp.vec3)
    return solids


def _planes(piece: ConvexPiece) -> Floats:
    """Return the distinct planes (F, 4) n x <= d of a piece's faces; every corner is below all of them."""
    normal = face_vectors(piece.vertices, piece.faces)
    length = np.linalg.norm(normal, axis=1)
    normal = normal[length > 0] / length[length > 0, None]
    offset = (normal @ piece.vertices.T).max(axis=1)
    # Select one unrounded plane among planes that are equal up to rounding.
    _, first = np.unique(np.round(np.column_stack([normal, offset]), _DIGITS), axis=0, return_index=True)
    return np.column_stack([normal, offset])[first]


def penetration_depth(found: Distances) -> Floats:
    """Return the deepest penetration (B,) of hand points in the object or object points in the hand [m]."""
    hand_in_object = np.maximum(0.0, -found.distance).max(axis=1)
    return np.asarray(np.maximum(hand_in_object, np.maximum(0.0, -found.piece_distance).max(axis=1)))
