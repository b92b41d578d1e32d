"""Distances between a posed hand and an object, for many grasps at once, on a GPU or on the CPU."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Any, Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.transforms import Floats, compose, quat_to_matrix
from graspd.worker.engines.backend import binary_identity
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel, SurfacePoints
from graspd.worker.hands.surface import sample_surface
from graspd.worker.objects.disk_cache import cached_arrays
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.region import ContactRegion
from graspd.worker.objects.topology import face_areas
from graspd.worker.quality.contact import LINK_CONTACT_M
from graspd.worker.simulation.device import DeviceHand, bounding_ball, posed_bodies, to_xyzw
from graspd.worker.simulation.kernels import distance as kernels
from graspd.worker.simulation.launches import launch
from graspd.worker.simulation.sampling import object_samples

#: Number of hand points that measure contact area and penetration; the optimiser uses other points.
HAND_POINTS: Final = 2000
OBJECT_POINTS: Final = 3000
SEED: Final = 7919  # seed of a held-out sample, since metrics must not be measured at the points of the optimisation
REACH_M: Final = 0.012  # distances are capped at this [m]
COARSE_CELLS: Final = 32  # number of cells along the longest side of a coarse grid; the grid finds points beyond reach
FACING_COS: Final = -0.5  # hand and object normals of a contact are opposite to within 60 degrees


@dataclass(frozen=True)
class NearestPoints:
    """Hand points of B grasps and the object's surface near them; object frame, metres."""

    bodies: Floats
    hand_points: Floats
    hand_normals: Floats  # (B, N, 3) outward unit normals of the hand at its points
    distance: Floats  # (B, N) signed distance of hand points to the object, at most the requested reach
    closest: Floats  # (B, N, 3) closest points on the object
    normal: Floats  # (B, N, 3) gradient of the distance: the object's outward unit normal at the point; 0 beyond reach


@dataclass(frozen=True)
class Distances(NearestPoints):
    """Nearest points, the distances of P pieces from the object, and the depth of the hand in itself."""

    piece_distance: Floats  # (B, P) least distance of an object point to each piece, at most `REACH_M`; negative inside
    self_depth: Floats  # (B,) depth of the deepest hand point inside another, non-neighbouring body


class Probe:
    """A hand and an object prepared for distance queries. Thread-safe."""

    def __init__(
        self,
        hand: HandModel,
        obj: ObjectModel,
        *,
        hand_points: int = HAND_POINTS,
        object_points: int = OBJECT_POINTS,
        device: str = "cpu",
    ) -> None:
        self.hand, self.obj, self.device = hand, obj, device
        self.points: SurfacePoints = sample_surface(hand, hand_points, seed=SEED)
        self.samples: Floats = object_samples(obj, object_points, seed=SEED)
        self.pieces = DeviceHand.create(hand, device).pieces
        self._piece_body = np.array([p.body for p in hand.pieces], np.intp)
        self._piece_frame = np.array([_kernel_frame(p.kind, p.pose, p.vertices) for p in hand.pieces])
        with wp.ScopedDevice(device):
            # Load here, so that threads do not compile the same module at once.
            wp.load_module(module=kernels, device=device)
            self._body = wp.array(self.points.body, dtype=wp.int32)
            self.body_points = _upload_points(self.points, hand.bodies)
            self._origin = wp.vec3d(*obj.centre_of_mass)
            self.frames = [
                wp.array(self._piece_frame[:, :3], dtype=wp.vec3d),
                wp.array(to_xyzw(self._piece_frame[:, 3:]), dtype=wp.quatd),
            ]
            self._samples = wp.array(self.samples - obj.centre_of_mass, dtype=wp.vec3)
            self.mesh = wp.Mesh(
                points=wp.array(obj.vertices - obj.centre_of_mass, dtype=wp.vec3),
                indices=wp.array(obj.faces.ravel(), dtype=wp.int32),
                support_winding_number=not obj.watertight,
            )
        self.skin = self._device_surface()

    def _device_surface(self) -> Any:
        obj, margin = self.obj, 1e-4
        low = obj.vertices.min(axis=0) - obj.centre_of_mass - REACH_M - margin
        high = obj.vertices.max(axis=0) - obj.centre_of_mass + REACH_M + margin
        skin = self.skin = kernels.Skin()
        skin.mesh, skin.winding = self.mesh.id, int(not obj.watertight)
        skin.low, skin.high = wp.vec3(*low), wp.vec3(*high)
        skin.spacing, skin.coarse_reach = float((high - low).max()) / COARSE_CELLS, REACH_M
        with wp.ScopedDevice(self.device):
            skin.corner_normal = wp.array(obj.corner_normals.reshape(-1, 3), dtype=wp.vec3)
            skin.coarse = wp.zeros((0, 0, 0), dtype=wp.float32)
            low, size = np.asarray(skin.low), np.subtract(skin.high, skin.low)
            counts = [int(length / skin.spacing) + 2 for length in size]
            nodes = np.stack(np.meshgrid(*map(np.arange, counts), indexing="ij"), axis=-1)
            points = low + skin.spacing * nodes + obj.centre_of_mass

            def make() -> dict[str, NDArray[np.float32]]:
                return {"coarse": self._query(points.reshape(-1, 3))[0].reshape(counts).astype(np.float32)}

            if wp.get_device().is_cpu:
                # Cached on disk: every process needs the grid at its start, and it depends on the object alone.
                terms = (obj.content, binary_identity(kernels))
                fits = partial(_is_grid, counts=counts)
                kept = cached_arrays("coarse_grids", terms, (sys.modules[__name__],), make, fits=fits)
            else:
                kept = make()
            skin.coarse = wp.array(kept["coarse"], dtype=wp.float32)
        return skin

    @cached_property
    def sample_spacing(self) -> float:
        """Spacing of the object points on an equivalent square grid [m]."""
        return float(np.sqrt(face_areas(self.obj.vertices, self.obj.faces).sum() / len(self.samples)))

    def signed_distance(self, points: Floats, *, reach: float = REACH_M) -> tuple[Floats, Floats, Floats]:
        """Return signed distance (P,), closest point (P, 3) and outward normal (P, 3) of points (P, 3).
        Object frame; distances at most `reach`. Closest point and normal of points beyond reach are undefined."""
        distance, closest, normal = self._query(points, reach)
        return np.minimum(distance, reach), closest, normal

    def _query(self, points: Floats, reach: float = REACH_M) -> tuple[Floats, Floats, Floats]:
        count = len(points)
        with wp.ScopedDevice(self.device):
            given = wp.array(points - self.obj.centre_of_mass, dtype=wp.vec3)
            distance = wp.empty(count, dtype=wp.float32)
            closest, normal = (wp.empty(count, dtype=wp.vec3) for _ in range(2))
            launch(kernels.mesh_distance, count, inputs=[self.skin, reach, given], outputs=[distance, closest, normal])
        place = closest.numpy().astype(float) + self.obj.centre_of_mass
        return distance.numpy().astype(float), place, normal.numpy().astype(float)

    def body_gaps(self, hand_pose: Floats, joint_positions: Floats, *, reach: float = REACH_M) -> Floats:
        """Return the least signed distance (P, L) of each body's points from the object in P postures.
        Distances are at most `reach`; inf where a body has no points. The result equals `signed_distance` of
        `posed_points`, but is faster for many postures."""
        posed = posed_bodies(self.hand, hand_pose, joint_positions, self.device)
        shape = (len(hand_pose), self.hand.bodies)
        with wp.ScopedDevice(self.device):
            gap = wp.full(shape, np.inf, dtype=wp.float32)
            inputs = [self.skin, self.body_points, self._origin, reach, posed.position, posed.rotation]
            launch(kernels.body_gaps, shape, inputs=inputs, outputs=[gap])
        return gap.numpy().astype(float)

    def posed_points(self, bodies: Floats) -> Floats:
        """Return the hand points (B, N, 3) for body poses (B, L, 7), object frame [m]."""
        return _rotate_with_bodies(bodies, self.points.body, self.points.position) + bodies[:, self.points.body, :3]

    def nearest_points(self, posture: Posture, *, reach: float = REACH_M) -> NearestPoints:
        """Return the object's surface near the hand points of B postures, within `reach` [m]."""
        bodies = body_poses(self.hand, posture.hand_pose, posture.joint_positions)
        points = self.posed_points(bodies)
        shape = points.shape[:2]
        distance, closest, normal = self.signed_distance(points.reshape(-1, 3), reach=reach)
        return NearestPoints(
            bodies=bodies,
            hand_points=points,
            hand_normals=_rotate_with_bodies(bodies, self.points.body, self.points.normal),
            distance=distance.reshape(shape),
            closest=closest.reshape(*shape, 3),
            normal=normal.reshape(*shape, 3),
        )

    def measure(self, posture: Posture) -> Distances:
        """Measure all distances of B postures from the object, within `REACH_M`."""
        found = self.nearest_points(posture)
        with wp.ScopedDevice(self.device):
            least = wp.full((len(found.bodies), len(self._piece_body)), REACH_M, dtype=wp.float32)
            inputs = [*self._posed_pieces(found.bodies), REACH_M, self._samples]
            dim = (len(found.bodies), len(self.samples))
            launch(kernels.pieces_distance, dim, inputs=inputs, outputs=[least])
        return Distances(
            **vars(found),
            piece_distance=least.numpy().astype(float),
            self_depth=self.self_depth(found.bodies, found.hand_points).max(axis=1),
        )

    def facing_mask(self, found: NearestPoints) -> NDArray[np.bool_]:
        """Return a mask (B, N) of points whose hand surface faces the object; other points cannot press."""
        return np.asarray(np.einsum("bni,bni->bn", found.hand_normals, found.normal) < FACING_COS)

    def region_share(self, found: NearestPoints, region: ContactRegion) -> Floats:
        """Return the share (B,) of the hand's surface in contact that touches the object in a region."""
        area = np.where(np.abs(found.distance) < LINK_CONTACT_M, self.points.area, 0.0)
        inside = np.where(region.contains(found.closest), area, 0.0).sum(axis=1)
        return np.asarray(inside / np.maximum(area.sum(axis=1), 1e-12))

    def body_distance(self, found: Distances) -> Floats:
        """Return the least distance (B, L) [m] between each body and the object, from points of both."""
        least = np.empty((len(found.bodies), self.hand.bodies))
        for body in range(self.hand.bodies):
            near = [found.distance[:, self.points.body == body], found.piece_distance[:, self._piece_body == body]]
            least[:, body] = np.concatenate(near, axis=1).min(axis=1, initial=REACH_M)
        return least

    def self_depth(self, bodies: Floats, points: Floats) -> Floats:
        """Return the depth (B, L) of each body in non-neighbouring bodies, or of these bodies in it [m]."""
        with wp.ScopedDevice(self.device):
            own = wp.array(points - self.obj.centre_of_mass, dtype=wp.vec3)
            depth = wp.zeros((len(bodies), self.hand.bodies), dtype=wp.float32)
            inputs = [*self._posed_pieces(bodies), self._body, own]
            launch(kernels.self_distance, points.shape[:2], inputs=inputs, outputs=[depth])
        return depth.numpy().astype(float)

    def _posed_pieces(self, bodies: Floats) -> list[Any]:
        frames = compose(bodies[:, self._piece_body], self._piece_frame[None])
        with wp.ScopedDevice(self.device):
            position: Any = wp.array(frames[..., :3] - self.obj.centre_of_mass, dtype=wp.vec3)
            rotation: Any = wp.array(to_xyzw(frames[..., 3:]), dtype=wp.quat)
        return [self.pieces, position, rotation]


def _rotate_with_bodies(bodies: Floats, body: NDArray[np.integer[Any]], vectors: Floats) -> Floats:
    """Rotate vectors (N, 3) with their bodies (N,); return (B, N, 3)."""
    return np.asarray(np.einsum("bnij,nj->bni", quat_to_matrix(bodies[..., 3:])[:, body], vectors))


def _upload_points(points: SurfacePoints, bodies: int) -> Any:
    """Return points of a hand as `kernels.distance.BodyPoints`, on the current device."""
    order = np.argsort(points.body, kind="stable")
    first = np.searchsorted(points.body[order], np.arange(bodies + 1))
    position = points.position[order]
    middle, radius = zip(*(bounding_ball(position[start:end]) for start, end in pairwise(first)), strict=True)
    out = kernels.BodyPoints()
    out.first, out.position = wp.array(first, dtype=wp.int32), wp.array(position, dtype=wp.vec3d)
    out.middle = wp.array(np.array(middle), dtype=wp.vec3d)
    out.extent = wp.array(np.array(radius) + 1e-6, dtype=wp.float32)  # slightly larger, since kernels round
    return out


def _kernel_frame(kind: str, pose: Floats, vertices: Floats) -> Floats:
    """Return the pose of a piece's frame in the kernels: a hull's is at the centre of its box."""
    if kind != "hull":
        return pose
    middle = (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return np.concatenate([middle, [1.0, 0, 0, 0]])


def _is_grid(kept: Mapping[str, NDArray[Any]], counts: Sequence[int]) -> bool:
    return set(kept) == {"coarse"} and kept["coarse"].shape == tuple(counts) and kept["coarse"].dtype == np.float32


@cached_by_content(8)
def probe_of(hand: HandModel, obj: ObjectModel, *, hand_points: int, object_points: int, device: str = "cpu") -> Probe:
    return Probe(hand, obj, hand_points=hand_points, object_points=object_points, device=device)
