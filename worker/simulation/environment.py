"""Environment of an object: the convex obstacles of a scene that a hand must avoid.

An obstacle is an intersection of half-spaces: one for a table top, six for a board or wall, and one per face for a
neighbour's convex piece. An `Environment` is in the object frame, `Scenes` are in the scene frame."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats, compose, invert, quat_conjugate, quat_rotate, quat_to_matrix
from graspd.worker.objects.mesh_geometry import to_centred_frame
from graspd.worker.objects.model import ObjectModel

UP: Final = np.array([0.0, 0.0, 1.0])  # direction against gravity in the scene frame
#: Length [m] of a hand's straight approach to its pregrasp, and of the lift.
STANDOFF_M: Final = 0.10
RISE_M: Final = 0.10
#: Least clearance of a hand from obstacles [m]; fingertips may be closer to a support that allows it.
CLEAR_M: Final = 0.002


@dataclass(frozen=True)
class Obstacle:
    """A convex body: the points x with n.x <= d for each of its planes (n, d)."""

    planes: Floats  # (K, 4) outward unit normal and offset [m]
    corners: Floats  # (V, 3) corners [m]; none for an unbounded body such as a half-space
    edges: NDArray[np.intp] = field(default_factory=lambda: np.zeros((0, 2), np.intp))  # (E, 2) corners of each edge
    tips_m: float | None = None  # clearance of fingertips [m], below 0 if they may press; None for that of the hand

    @classmethod
    def half_space(cls, normal: Sequence[float] | Floats, offset: float) -> Obstacle:
        """Return the half-space n.x <= offset, for any length of n. Raises InputError: zero or not finite."""
        n = np.asarray(normal, float)
        length = float(np.linalg.norm(n))
        if n.shape != (3,) or not np.isfinite(n).all() or not np.isfinite(offset) or length < 1e-9:
            raise InputError(f"a support's normal must be three finite numbers, not all zero; got {normal}")
        return cls(np.array([[*(n / length), offset / length]]), np.zeros((0, 3)))

    @classmethod
    def box(cls, pose: Sequence[float] | Floats, size: Sequence[float] | Floats) -> Obstacle:
        """Return a box of full extents `size` (3,) [m] about the origin of `pose` (7,).
        Raises InputError: an extent is not positive, or a number is not finite."""
        pose, half = np.asarray(pose, float), np.asarray(size, float) / 2
        if half.shape != (3,) or not np.isfinite(half).all() or (half <= 0).any():
            raise InputError(f"a box needs three extents above 0; got {size}")
        if pose.shape != (7,) or not np.isfinite(pose).all() or np.linalg.norm(pose[3:]) < 1e-9:
            raise InputError(f"a box needs a pose of seven numbers, x y z and a quaternion w x y z; got {pose}")
        R = quat_to_matrix(pose[3:] / np.linalg.norm(pose[3:]))
        normals = np.concatenate([R.T, -R.T])
        planes = np.column_stack([normals, normals @ pose[:3] + np.concatenate([half, half])])
        signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1], indexing="ij"), float).reshape(3, -1).T
        edges = np.array([(i, i ^ bit) for i in range(8) for bit in (1, 2, 4) if not i & bit])
        return cls(planes, pose[:3] + (signs * half) @ R.T, edges)

    def moved(self, pose: Floats) -> Obstacle:
        """Return the obstacle in the outer frame, in which its own frame has `pose` (7,)."""
        normals = quat_rotate(pose[3:], self.planes[:, :3])
        planes = np.column_stack([normals, self.planes[:, 3] + normals @ pose[:3]])
        return replace(self, planes=planes, corners=quat_rotate(pose[3:], self.corners) + pose[:3])

    def in_frame(self, pose: Floats) -> Obstacle:
        """Return the obstacle in a frame that has `pose` (7,) in the present one: the inverse of `moved`."""
        return self.moved(invert(pose))

    def distance(self, points: Floats) -> Floats:
        """Return signed distances (...) of points (..., 3) [m]; beyond edges and corners a lower bound."""
        return np.asarray((points @ self.planes[:, :3].T - self.planes[:, 3]).max(axis=-1))


@dataclass(frozen=True)
class Environment:
    """One scene in the object frame."""

    obstacles: tuple[Obstacle, ...]
    up: Floats  # (3,) unit vector against gravity


@dataclass(frozen=True)
class Neighbour:
    """Another object in a scene, as convex pieces in its own frame."""

    obj: ObjectModel
    pieces: tuple[Floats, ...]  # corners (V, 3) of each piece, for the validator
    solids: tuple[Obstacle, ...]  # slightly enlarged pieces with few faces, for the clearance of hands
    error_m: float  # largest excess of a solid over its piece [m]
    about_centre: Neighbour | None = None  # the same with its frame at the centre; None if the frame is there already


@dataclass(frozen=True)
class Scenes:
    """S scenes of one object with common supports and neighbours."""

    supports: tuple[Obstacle, ...]  # tables, boards and walls in the scene frame, z up
    object_pose: Floats  # (S, 7) of the object in the scene frame
    neighbours: tuple[Neighbour, ...] = ()
    neighbour_pose: Floats = field(default_factory=lambda: np.zeros((0, 0, 7)))  # (S, M, 7) in the scene frame

    def centred(self, obj: ObjectModel) -> Scenes:
        """Return the scenes with the frames of the object `obj` and of all neighbours moved to their centres."""
        poses = np.array(self.neighbour_pose, float)
        for number, one in enumerate(self.neighbours):
            poses[:, number] = to_centred_frame(poses[:, number], one.obj.centre)
        neighbours = tuple(one.about_centre or one for one in self.neighbours)
        return Scenes(self.supports, to_centred_frame(self.object_pose, obj.centre), neighbours, poses)

    def placed(self, index: NDArray[np.intp]) -> PlacedGrasps:
        """Return N grasps in these scenes; `index` (N,) has the scene number of each grasp."""
        index = np.asarray(index, np.intp)
        return PlacedGrasps(self.supports, self.object_pose, index, self.neighbours, self.neighbour_pose)


@dataclass(frozen=True)
class PlacedGrasps:
    """N grasps, each in one of S scenes with common supports and neighbours."""

    supports: tuple[Obstacle, ...]  # tables, boards and walls in the scene frame, z up
    object_pose: Floats  # (S, 7) of the object in the scene frame
    index: NDArray[np.intp]  # (N,) scene of each grasp
    neighbours: tuple[Neighbour, ...] = ()
    neighbour_pose: Floats = field(default_factory=lambda: np.zeros((0, 0, 7)))  # (S, M, 7) in the scene frame

    @cached_property
    def scenes(self) -> tuple[Environment, ...]:
        """The S scenes in the object frame."""
        found = []
        for number, pose in enumerate(np.asarray(self.object_pose, float)):
            beside = zip(self.neighbours, self.relative_neighbour_poses(number), strict=True)
            solids = (solid.moved(place) for neighbour, place in beside for solid in neighbour.solids)
            obstacles = (*(support.in_frame(pose) for support in self.supports), *solids)
            found.append(Environment(obstacles, quat_rotate(quat_conjugate(pose[3:]), UP)))
        return tuple(found)

    @cached_property
    def fixed(self) -> str:
        """Digest of what all grasps have in common: supports and neighbours, without poses of objects."""
        digest = hashlib.sha256()
        solids = [solid for one in self.neighbours for solid in one.solids]
        for body in (*self.supports, *solids):
            digest.update(f"{body.planes.shape} {body.corners.shape} {body.tips_m} ".encode())
            digest.update(body.planes.tobytes() + body.corners.tobytes())
        digest.update(" ".join(one.obj.content for one in self.neighbours).encode())
        return digest.hexdigest()

    @property
    def all_scenes(self) -> Scenes:
        return Scenes(self.supports, self.object_pose, self.neighbours, self.neighbour_pose)

    def centred(self, obj: ObjectModel) -> PlacedGrasps:
        """Return the grasps with the frames of the object `obj` and of all neighbours moved to their centres."""
        return self.all_scenes.centred(obj).placed(self.index)

    def relative_neighbour_poses(self, scene: int) -> Floats:
        """Return poses (M, 7) of the neighbours in the object frame of a scene."""
        if not self.neighbours:
            return np.zeros((0, 7))
        return np.asarray(compose(invert(self.object_pose[scene]), np.asarray(self.neighbour_pose[scene], float)))

    def take(self, rows: NDArray[np.intp] | slice) -> PlacedGrasps:
        taken = replace(self, index=self.index[rows])
        vars(taken)["scenes"] = self.scenes  # unchanged, so not recomputed
        return taken


def join_placed_grasps(parts: Sequence[PlacedGrasps]) -> PlacedGrasps:
    """Join grasps of several sets, each in its own scenes; supports and neighbours are common."""
    first = parts[0]
    if len(parts) == 1:
        return first
    before = np.cumsum([0, *(len(part.object_pose) for part in parts)])
    index = np.concatenate([part.index + start for part, start in zip(parts, before, strict=False)])
    whole = join_scenes([part.all_scenes for part in parts]).placed(index)
    vars(whole)["scenes"] = tuple(scene for part in parts for scene in part.scenes)  # not recomputed
    return whole


def join_scenes(parts: Sequence[Scenes]) -> Scenes:
    """Join the scenes of several sets; supports and neighbours are common."""
    first = parts[0]
    beside = np.concatenate([part.neighbour_pose for part in parts]) if first.neighbours else first.neighbour_pose
    return replace(first, object_pose=np.concatenate([part.object_pose for part in parts]), neighbour_pose=beside)
