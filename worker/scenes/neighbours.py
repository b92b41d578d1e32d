"""Several objects in a scene, dropped together or placed one by one; clearance from neighbours.

Collision shapes are convex hulls: exact against the table, conservative between objects. A placed object has the rest
pose of its own drop. Its position and its rotation about the vertical are drawn until its hull is clear of walls and of
all other objects."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np

from graspd.service.model.errors import InputError, MeshError, SceneError
from graspd.service.model.transforms import Floats, apply, compose, quat_rotate
from graspd.worker.engines.mujoco_warnings import is_invalid
from graspd.worker.grasps import Posture, move_poses
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import ConvexPiece, HandModel
from graspd.worker.objects.mesh_geometry import to_centred_frame, to_file_frame
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes import simulate
from graspd.worker.scenes.kinds import GAP, SUNK, rotate_about_vertical
from graspd.worker.scenes.rest import lay_flat, resting_faces, stable_face_below
from graspd.worker.simulation.environment import Obstacle
from graspd.worker.validation.model import add_shape

TIMEOUT_S: Final = 6.0
#: Distance of dropped neighbours from the object, as a multiple of the sum of both bounding radii.
RING: Final = (1.0, 1.25)
#: Largest distance of resting neighbours from the middle of the table [m].
NEIGHBOUR_REACH: Final = 0.4
#: Largest rise [m] of an object that is laid flat, from the penetration of soft contacts; more means a stacked object.
MAX_LIFT: Final = 0.003
#: Clearances are capped at this [m].
FARTHEST_M: Final = 0.1
MOST_NEIGHBOURS: Final = 8


@dataclass(frozen=True)
class Neighbours:
    objects: Sequence[ObjectModel]
    poses: Floats  # (S, M, 7) in the table frame

    @property
    def centred(self) -> Neighbours:
        poses = np.array(self.poses, float)
        for number, obj in enumerate(self.objects):
            poses[:, number] = to_centred_frame(poses[:, number], obj.centre)
        return Neighbours([obj.centred for obj in self.objects], poses)


def drop_together(obj: ObjectModel, neighbours: Sequence[ObjectModel], *, count: int, seed: int) -> dict[str, Floats]:
    """Drop an object and its neighbours around it onto a table until all rest, `count` times.
    A drop is repeated if an object does not come to rest, rolls away, or leans or lies on another object. Scene i
    depends on the objects, the seed and i alone. Return the columns of `worker.scenes.simulate.drop`, and
    `scene/neighbour_pose` (S, M, 7). Raises InputError: count or seed is negative, or there are too many neighbours.
    MeshError: a hull is flat, or the objects never come to rest."""
    if count < 0 or seed < 0 or not 1 <= len(neighbours) <= MOST_NEIGHBOURS:
        raise InputError(
            f"scenes need 1 to {MOST_NEIGHBOURS} neighbours, and a number and a seed of at least 0; "
            f"got {count} scenes, {len(neighbours)} neighbours, seed {seed}"
        )
    heap = _DroppedObjects([one.centred for one in (obj, *neighbours)])
    found = [heap.drop_until_rest((seed, scene)) for scene in range(count)]
    poses = move_poses(np.array([poses for poses, _, _ in found]).reshape(count, 1 + len(neighbours), 7), np.zeros(3))
    for number, one in enumerate((obj, *neighbours)):
        poses[:, number] = to_file_frame(poses[:, number], one.centre)
    return {
        "scene/object_pose": poses[:, 0],
        "scene/neighbour_pose": poses[:, 1:],
        "scene/rest_probability": simulate.rest_probability(obj, [face for _, face, _ in found]),
        "scene/drop_seconds": np.array([seconds for _, _, seconds in found]),
    }


class _DroppedObjects:
    """Objects that fall together onto a table."""

    def __init__(self, objects: Sequence[ObjectModel]) -> None:
        self.objects = objects
        self.faces = [resting_faces(obj) for obj in objects]
        self.model = simulate.model_above_table(objects)
        self.data = mujoco.MjData(self.model)

    def drop_until_rest(self, key: tuple[int, int]) -> tuple[Floats, int, float]:
        """Drop until all objects rest; return poses (1 + M, 7), the object's resting face, and seconds."""
        for attempt in range(simulate.MAX_ATTEMPTS):
            if (found := self._drop_once(np.random.default_rng([*key, attempt]))) is not None:
                return found
        names = ", ".join(repr(obj.name) for obj in self.objects)
        raise MeshError(f"{names} did not come to rest apart in {simulate.MAX_ATTEMPTS} drops; try fewer neighbours")

    def _drop_once(self, rng: np.random.Generator) -> tuple[Floats, int, float] | None:
        mujoco.mj_resetData(self.model, self.data)
        start = self._sample(rng)
        if start is None:
            return None
        self.data.qpos[:] = start.ravel()
        seconds = self._run()
        return None if seconds is None or is_invalid(self.data) else self._at_rest(seconds, rng)

    def _sample(self, rng: np.random.Generator) -> Floats | None:
        """Draw release poses (1 + M, 7) with disjoint bounding balls; None if a neighbour does not fit."""
        quaternions = rng.normal(size=(len(self.objects), 4))
        quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
        middles = [np.zeros(2)]
        for obj in self.objects[1:]:
            angle, share = rng.uniform(0, 2 * np.pi), rng.uniform(*RING)
            reach = share * (self.objects[0].radius + obj.radius)
            middle = reach * np.array([np.cos(angle), np.sin(angle)])
            others = zip(self.objects[1:], middles[1:], strict=False)
            if any(np.linalg.norm(middle - m) < obj.radius + o.radius for o, m in others):
                return None
            middles.append(middle)
        poses = np.concatenate([np.zeros((len(self.objects), 3)), quaternions], axis=1)
        for pose, obj, middle in zip(poses, self.objects, middles, strict=True):
            lowest = float(quat_rotate(pose[3:], obj.hull_vertices)[:, 2].min())
            pose[:2] = middle - quat_rotate(pose[3:], obj.centre_of_mass)[:2]
            pose[2] = rng.uniform(*simulate.DROP_HEIGHT) - lowest
        return poses

    def _run(self) -> float | None:
        quiet, radii = 0, np.array([obj.radius for obj in self.objects])
        centres = np.array([obj.centre_of_mass for obj in self.objects])
        for step in range(round(TIMEOUT_S / simulate.TIMESTEP_S)):
            mujoco.mj_step(self.model, self.data)
            velocity = self.data.qvel.reshape(-1, 6)
            quaternion = self.data.qpos.reshape(-1, 7)[:, 3:]
            linear = velocity[:, :3] + quat_rotate(quaternion, np.cross(velocity[:, 3:], centres))
            speed = np.linalg.norm(linear, axis=1) + radii * np.linalg.norm(velocity[:, 3:], axis=1)
            quiet = quiet + 1 if speed.max() < simulate.REST_SPEED and self.data.ncon >= len(self.objects) else 0
            if quiet >= round(simulate.REST_WINDOW_S / simulate.TIMESTEP_S):
                return (step + 1) * simulate.TIMESTEP_S
        return None

    def _at_rest(self, seconds: float, rng: np.random.Generator) -> tuple[Floats, int, float] | None:
        """Return the poses laid flat; None if an object leans, rolled away, or lies on or in another one."""
        flat, first = [], -1
        for k, (obj, pose) in enumerate(zip(self.objects, self.data.qpos.reshape(-1, 7).copy(), strict=True)):
            pose[3:] /= np.linalg.norm(pose[3:])
            face, angle = stable_face_below(self.faces[k], pose[3:])
            laid = lay_flat(self.faces[k], face, pose)
            middle = apply(laid, obj.centre_of_mass)
            lift = abs(float(middle[2] - apply(pose, obj.centre_of_mass)[2]))
            away = np.hypot(*middle[:2]) > (NEIGHBOUR_REACH if k else simulate.REACH)
            if away or angle > simulate.MAX_SETTLE_ANGLE or lift > MAX_LIFT or self.faces[k].can_topple(face):
                return None
            face, laid = simulate.settle_on_face(obj, self.faces[k], face, laid, rng)
            flat.append(laid)
            first = face if k == 0 else first
        self.data.qpos[:] = np.concatenate(flat)
        mujoco.mj_kinematics(self.model, self.data)
        pairs = [(a, b) for a in range(1, len(flat) + 1) for b in range(a + 1, len(flat) + 1)]
        if any(mujoco.mj_geomDistance(self.model, self.data, a, b, FARTHEST_M, None) < 0 for a, b in pairs):
            return None
        return np.array(flat), first, seconds


def neighbour_clearance(hand: HandModel, path: Posture, object_pose: Floats, neighbours: Neighbours) -> Floats:
    """Compute the hand's least signed distance (S, P) from neighbours' hulls [m], at most `FARTHEST_M`.
    `path` has P postures in the object frame. `object_pose` (S, 7) is in the table frame."""
    spec = mujoco.MjSpec()
    for k, piece in enumerate(hand.pieces):
        _add_piece(spec, spec.worldbody.add_body(mocap=True), f"p{k}", piece)
    neighbours = neighbours.centred
    for k, obj in enumerate(neighbours.objects):
        simulate.add_hull(spec, spec.worldbody.add_body(mocap=True), f"n{k}", obj.hull_vertices, obj.hull_faces)
    model = spec.compile()
    data = mujoco.MjData(model)
    pieces = len(hand.pieces)
    in_object = body_poses(hand, path.hand_pose, path.joint_positions)[:, [piece.body for piece in hand.pieces]]
    clearance = np.full((len(object_pose), len(path)), FARTHEST_M)
    for s, pose in enumerate(object_pose):
        for p, bodies in enumerate(compose(pose, in_object)):
            placed = np.concatenate([bodies, neighbours.poses[s]])
            data.mocap_pos[:], data.mocap_quat[:] = placed[:, :3], placed[:, 3:]
            mujoco.mj_kinematics(model, data)
            gap = np.linalg.norm(data.geom_xpos[:pieces, None] - data.geom_xpos[None, pieces:], axis=-1)
            gap -= model.geom_rbound[:pieces, None] + model.geom_rbound[None, pieces:]
            for a, b in np.argwhere(gap < clearance[s, p]):
                distance = mujoco.mj_geomDistance(model, data, int(a), pieces + int(b), FARTHEST_M, None)
                clearance[s, p] = min(clearance[s, p], distance)
    return clearance


def _add_piece(spec: Any, body: Any, name: str, piece: ConvexPiece) -> None:
    if piece.kind == "hull":
        simulate.add_hull(spec, body, name, piece.vertices, piece.faces)
    else:
        add_shape(spec, body.add_geom(), piece, name)


#: Least gap between two objects [m]; the least gap from walls is `GAP`, as for the object.
BETWEEN: Final = 0.005
#: Largest number of draws of a scene, and of the place of each neighbour in a draw.
_DRAWS: Final = 32
_PLACES: Final = 100
#: Largest distance of a neighbour's centre from the object's, in sums of both bounding radii, and its growth per draw.
_REACH: Final = 1.25
_FARTHER: Final = 0.1


def place_neighbours(
    obj: ObjectModel,
    again: Callable[[int, int], Floats],
    others: Sequence[ObjectModel],
    supports: Sequence[Obstacle],
    *,
    within: tuple[float, float] | None = None,
    count: int,
    seed: int,
) -> tuple[Floats, Floats]:
    """Place M neighbours beside an object; return poses (S, 7) of the object and (S, M, 7) of neighbours.
    All are `BETWEEN` apart and clear of supports. `again` returns the pose (7,) of the object in scene i at attempt k;
    the neighbours `others` rest on z = 0. All stay inside the rectangle `within` about the origin, with sides x and y
    [m]. Scene i depends on the objects, the supports, the seed and i alone. Raises SceneError: the neighbours do not
    all fit. MeshError: a neighbour never comes to rest, or is flat."""
    # Copies of one object must not rest in the same pose.
    seeds = [int(np.random.SeedSequence([seed, 1 + k]).generate_state(1)[0]) for k in range(len(others))]
    resting = [
        simulate.drop(one, count=count, seed=own)["scene/object_pose"] for one, own in zip(others, seeds, strict=True)
    ]
    hulls = _Hulls([obj, *others], supports, within)
    poses = np.zeros((count, 1 + len(others), 7))
    for scene in range(count):
        rest = [one[scene] for one in resting]
        for k in range(_DRAWS):
            target, rng = again(scene, k), np.random.default_rng([seed, scene, k, len(others)])
            if (found := _draw_poses(hulls, target, rest, _REACH + _FARTHER * k, rng)) is not None:
                poses[scene] = found
                break
        else:
            raise SceneError(
                f"there is no room for {len(others)} neighbours beside {obj.name} in scene {scene}: none of {_DRAWS} "
                f"draws left {1e3 * BETWEEN:.0f} mm between all of them; take fewer or smaller ones, or a wider scene"
            )
    poses = move_poses(poses, np.zeros(3))
    return poses[:, 0], poses[:, 1:]


def _draw_poses(
    hulls: _Hulls, target: Floats, resting: Sequence[Floats], reach: float, rng: np.random.Generator
) -> Floats | None:
    """Draw poses (1 + M, 7) of one scene; None if a neighbour does not fit."""
    placed = [target]
    middle = hulls.horizontal_centre(0, target)
    for number, rest in enumerate(resting, start=1):
        far = reach * (hulls.objects[0].radius + hulls.objects[number].radius)
        for _ in range(_PLACES):
            pose = rotate_about_vertical(rest, rng.uniform(0, 2 * np.pi))
            low, high = hulls.shift_range(number, pose)
            centre = hulls.horizontal_centre(number, pose)
            low, high = np.maximum(low, middle - far - centre), np.minimum(high, middle + far - centre)
            if (low > high).any():
                continue
            pose[:2] += rng.uniform(low, high)
            if hulls.is_clear(number, pose) and hulls.is_apart([*placed, pose]):
                placed.append(pose)
                break
        else:
            return None
    return np.array(placed)


class _Hulls:
    """Convex hulls of objects, to test their places in a scene."""

    def __init__(
        self, objects: Sequence[ObjectModel], supports: Sequence[Obstacle], within: tuple[float, float] | None
    ) -> None:
        self.objects = objects
        self._supports = supports
        self._room = np.inf if within is None else np.asarray(within) / 2 - GAP
        spec: Any = mujoco.MjSpec()
        for number, one in enumerate(objects):
            simulate.add_hull(spec, spec.worldbody.add_body(mocap=True), str(number), one.hull_vertices, one.hull_faces)
        self._model = spec.compile()
        self._data = mujoco.MjData(self._model)

    def horizontal_centre(self, number: int, pose: Floats) -> Floats:
        """Return the horizontal position (2,) of an object's centre of mass [m]."""
        return apply(pose, self.objects[number].centre_of_mass)[:2]

    def shift_range(self, number: int, pose: Floats) -> tuple[Floats, Floats]:
        """Return the least and largest shift (2,), (2,) along x and y that keeps an object inside the walls."""
        corners = apply(pose, self.objects[number].hull_vertices)[:, :2]
        return -self._room - corners.min(axis=0), self._room - corners.max(axis=0)

    def is_clear(self, number: int, pose: Floats) -> bool:
        """Check whether an object is `GAP` away from every support except the one it stands on."""
        corners = apply(pose, self.objects[number].hull_vertices)
        return all(_is_separated(support, corners) for support in self._supports)

    def is_apart(self, poses: Sequence[Floats]) -> bool:
        """Check whether the object of the last pose is `BETWEEN` away from the objects of the other poses."""
        last = len(poses) - 1
        self._data.mocap_pos[: last + 1] = [pose[:3] for pose in poses]
        self._data.mocap_quat[: last + 1] = [pose[3:] for pose in poses]
        mujoco.mj_kinematics(self._model, self._data)
        gaps = (mujoco.mj_geomDistance(self._model, self._data, k, last, BETWEEN, None) for k in range(last))
        return all(gap >= BETWEEN for gap in gaps)


def _is_separated(support: Obstacle, corners: Floats) -> bool:
    """Check whether a plane of a support separates it from a hull, by `GAP` unless the plane faces up.
    The result is False for two bodies that are apart but not separated by such a plane."""
    room = (corners @ support.planes[:, :3].T - support.planes[:, 3]).min(axis=0)
    least = np.where(support.planes[:, 2] > 1 - 1e-6, -SUNK, GAP)
    return bool((room >= least).any())
