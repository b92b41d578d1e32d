"""Volume shared by hand and object: exact boolean of solids, or voxels where the object is no solid."""

from __future__ import annotations

from functools import cached_property
from typing import Final

import manifold3d as m3d
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, pose_to_matrix
from graspd.worker.hands.model import ConvexPiece, HandModel
from graspd.worker.hands.surface import piece_distance
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.probe import Probe

#: Edge of a voxel in the fallback [m]: the error is at most half an edge times the shared volume's surface.
VOXEL_M: Final = 5e-4
#: Solids are built in millimetres: manifold3d uses single precision, whose tolerance suits numbers around 100.
_UNIT: Final = 1e3


class SharedVolume:
    """Intersection volumes of one (hand, object) pair. Thread-safe."""

    def __init__(self, hand: HandModel, obj: ObjectModel) -> None:
        self.hand, self.obj = hand, obj
        self._pieces = [_solid(p.vertices, p.faces) or _hull(p) for p in hand.pieces]
        self._body = np.array([p.body for p in hand.pieces], np.intp)
        self._object = _solid(obj.vertices - obj.centre_of_mass, obj.faces)

    @property
    def exact(self) -> bool:
        return self._object is not None

    def of(self, bodies: Floats, near: NDArray[np.bool_]) -> Floats:
        """Compute the volume inside both the object and the union of the hand's pieces [cm^3].

        Args:
            bodies: (B, L, 7) body poses in the object frame.
            near: (B, P) pieces that may intersect the object; the others are ignored.

        Returns:
            (B,)
        """
        return np.array([self._one(bodies[b], np.flatnonzero(near[b])) for b in range(len(bodies))])

    def _one(self, bodies: Floats, pieces: NDArray[np.intp]) -> float:
        if not len(pieces):
            return 0.0
        if self._object is None:
            return self._voxels.volume_cm3(bodies, pieces)
        matrices = self._matrices(bodies[self._body[pieces]])
        posed = [self._pieces[p].transform(matrix) for p, matrix in zip(pieces, matrices, strict=True)]
        parts = [part for part in (self._object ^ solid for solid in posed) if not part.is_empty()]
        if not parts:
            return 0.0
        # Intersections rarely overlap, so their union is cheap; the union of whole pieces is not.
        whole = parts[0] if len(parts) == 1 else m3d.Manifold.batch_boolean(parts, m3d.OpType.Add)
        return float(whole.volume()) / _UNIT**3 * 1e6

    def _matrices(self, poses: Floats) -> Floats:
        matrices = pose_to_matrix(poses)[:, :3]
        matrices[..., 3] = (matrices[..., 3] - self.obj.centre_of_mass) * _UNIT
        return matrices

    @cached_property
    def _voxels(self) -> VoxelVolume:
        return VoxelVolume(self.hand, self.obj)


class VoxelVolume:
    """Intersection volume by counting voxel centres of the object that lie inside the pieces."""

    def __init__(self, hand: HandModel, obj: ObjectModel, edge: float = VOXEL_M) -> None:
        self.hand = hand
        self.edge = edge
        self._probe = Probe(hand, obj, hand_points=hand.bodies * 16, object_points=64)

    def volume_cm3(self, bodies: Floats, pieces: NDArray[np.intp]) -> float:
        low, high = self._box(bodies, pieces)
        if (high <= low).any():
            return 0.0
        axes = [np.arange(a + self.edge / 2, b, self.edge) for a, b in zip(low, high, strict=True)]
        grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        inside = np.zeros(len(grid), dtype=bool)
        for p in pieces:
            piece = self.hand.pieces[p]
            matrix = pose_to_matrix(bodies[piece.body])
            local = (grid - matrix[:3, 3]) @ matrix[:3, :3]
            inside |= _inside(piece, local)
        if not inside.any():
            return 0.0
        depth = self._probe.signed_distance(grid[inside])[0]
        return float((depth < 0).sum()) * self.edge**3 * 1e6

    def _box(self, bodies: Floats, pieces: NDArray[np.intp]) -> tuple[Floats, Floats]:
        corners = np.concatenate(
            [
                self.hand.pieces[p].vertices @ pose_to_matrix(bodies[self.hand.pieces[p].body])[:3, :3].T
                + bodies[self.hand.pieces[p].body, :3]
                for p in pieces
            ]
        )
        vertices = self._probe.obj.vertices
        return np.maximum(corners.min(0), vertices.min(0)), np.minimum(corners.max(0), vertices.max(0))


def _inside(piece: ConvexPiece, points: Floats) -> NDArray[np.bool_]:
    inside: NDArray[np.bool_] = piece_distance(piece, points) < 0
    return inside


def _solid(vertices: Floats, faces: NDArray[np.int32]) -> m3d.Manifold | None:
    mesh = m3d.Mesh(
        vert_properties=np.ascontiguousarray(vertices * _UNIT, dtype=np.float32),
        tri_verts=np.ascontiguousarray(faces, dtype=np.uint32),
    )
    solid = m3d.Manifold(mesh)
    feasible = solid.status() == m3d.Error.NoError and not solid.is_empty() and solid.volume() > 0
    return solid if feasible else None


def _hull(piece: ConvexPiece) -> m3d.Manifold:
    return m3d.Manifold.hull_points(np.ascontiguousarray(piece.vertices * _UNIT, dtype=np.float32))
