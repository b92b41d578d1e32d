"""Read a hand from USD physics: bodies become links, joints with one degree of freedom stay joints.

Schema: https://openusd.org/release/api/usd_physics_page_front.html. Limits in degrees and drives per degree are
converted to SI units. A link's frame is its body's, without scale."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import PurePosixPath
from typing import Any, Final

import numpy as np

from graspd.service.model.errors import HandError, MeshError
from graspd.service.model.transforms import (
    IDENTITY_POSE,
    Floats,
    compose,
    invert,
    pose_from_matrix,
    quat_rotate,
    quat_to_matrix,
)
from graspd.worker.hands.primitives import hull
from graspd.worker.hands.robot import MAX_LENGTH_M, UNLIMITED_M, Joint, Link, Mimic, Robot, Shape, build_robot
from graspd.worker.objects.formats.usd import Stage, axis_rotation, read_stage

#: Distance below which a joint's anchor is at its body's origin [m].
_AT_ORIGIN_M: Final = 1e-9
#: Larger forces, torques and speeds are placeholders of a missing limit.
_MOST: Final = 1e6
#: Smallest extent of a hand's colliders [m].
_MIN_LENGTH_M: Final = 0.01
_KINDS: Final = {"Cube": "box", "Sphere": "sphere", "Cylinder": "cylinder", "Capsule": "capsule"}
_WORLD: Final = "world"


def read_usd(files: Mapping[str, bytes], main: str) -> Robot:
    """Read and check the articulation of a stage.
    Raises HandError: the stage is unreadable (`read_stage`), or no hand; the message names the prim and the fix."""
    try:
        return _Reader(read_stage(files, main, HandError), main).robot()
    except MeshError as error:
        raise HandError(f"{main}: {error}") from None


class _Reader:
    def __init__(self, stage: Stage, main: str) -> None:
        self.stage, self.main, self.notes = stage, main, list[str]()
        self.frames = {"": np.eye(4)} | {path: np.array(matrix) for path, matrix in stage.facts["bodies"].items()}
        joints = [joint for joint in stage.facts["joints"] if joint["enabled"]]
        self.joints = [joint | {"bodies": [self._body_of(path) for path in joint["targets"]]} for joint in joints]
        paths = [*self.frames, *(joint["path"] for joint in joints)]
        count = Counter([_WORLD, *(PurePosixPath(path).name for path in paths)])
        self.names = {path: PurePosixPath(path).name for path in paths}
        self.names |= {path: path[1:].replace("/", "_") for path, name in self.names.items() if count[name] > 1}
        self.names[""] = _WORLD

    def _body_of(self, path: str) -> str:
        """Return the rigid body at or above a prim; "" for the world."""
        return next((one for one in (path, *map(str, PurePosixPath(path).parents)) if one in self.frames), "")

    def robot(self) -> Robot:
        ordered = {joint["path"]: joint for joint in self._tree()}
        used = dict.fromkeys(path for joint in ordered.values() for path in joint["bodies"])
        if not used:
            raise HandError(f"{self.main}: no physics joint between rigid bodies; give an articulated hand")
        shapes = [shape for path in used for shape in self._shapes(path, "collider")]
        points = np.concatenate([self.stage.mesh(shape)[0] for shape in shapes] or [np.zeros((0, 3))])
        size = float(np.ptp(points, axis=0).max()) if len(points) else _MIN_LENGTH_M
        if not _MIN_LENGTH_M <= size <= MAX_LENGTH_M:
            raise HandError(f"{self.main}: the hand would be {size:.3g} m long; correct metersPerUnit of the stage")
        links, joints = [self._link(path) for path in used], list[Joint]()
        for joint in (ordered[one["path"]] for one in self.joints if one["path"] in ordered):
            made = self._joint(joint)
            anchor = self._anchor(joint, 1)[:3]
            if np.linalg.norm(anchor) > _AT_ORIGIN_M:
                # A joint moves a link about the link's origin: here a link at the joint's anchor.
                at = f"{made.child}:{made.name}"
                links.append(Link(at, (), None))
                back = np.concatenate([-anchor, IDENTITY_POSE[3:]])
                joints.append(Joint(f"{made.child}:fixed", "fixed", at, made.child, back))
                made = replace(made, child=at)
            joints.append(made)
        if others := len(self.frames.keys() - used.keys() - {""}):
            self.notes.append(f"{others} bodies without a joint to the hand are ignored")
        return build_robot("", links, joints, self.notes, self.main, "USD")

    def _tree(self) -> Iterator[dict[str, Any]]:
        """Yield joints from the root outward; a joint that points to the root is reversed."""
        near: dict[str, list[dict[str, Any]]] = {}
        to_world = [joint for joint in self.joints if joint["kind"] == "Fixed" and "" in joint["bodies"]]
        for joint in (joint for joint in self.joints if joint not in to_world):
            if joint["excluded"]:
                self.notes.append(f"{self.names[joint['path']]!r} is outside the articulation and ignored")
                continue
            for path in joint["bodies"]:
                near.setdefault(path, []).append(joint)
        # The world, if a joint moves against it; else a body fixed to it; else one that no joint carries.
        fixed = {path for joint in to_world for path in joint["bodies"]}
        carried = {joint["bodies"][1] for joints in near.values() for joint in joints}
        waiting = sorted(near, key=lambda path: (path != "", path not in fixed, path in carried))[:1]
        seen, done = set(waiting), set[str]()
        while waiting:
            parent = waiting.pop(0)
            for joint in (joint for joint in near[parent] if joint["path"] not in done):
                done.add(joint["path"])
                first, second = joint["bodies"]
                if (child := second if first == parent else first) in seen:
                    raise HandError(f"{self.main}: {joint['path']} closes a loop; exclude it from the articulation")
                seen.add(child)
                waiting.append(child)
                # The same motion, seen from the other body, is about the opposite axis.
                turned = {key: joint[key][::-1] for key in ("bodies", "targets", "positions", "rotations")}
                yield joint if first == parent else {**joint, **turned, "sign": -1}
        if apart := sorted(near.keys() - seen):
            raise HandError(f"{self.main}: several articulations, such as that of {apart[0]}; export one hand")

    def _rigid(self, matrix: Floats) -> Floats:
        """Return the pose (7,) [m] of a 4x4 matrix without its scale; a mirrored frame becomes right-handed."""
        left, size, right = np.linalg.svd(matrix[:3, :3])
        turn, rigid = left @ right, np.eye(4)
        if not np.isfinite(matrix).all() or size[2] <= 1e-9 * size[0]:
            raise HandError(f"{self.main}: a body has no finite frame, or a scale of zero; correct its transform")
        rigid[:3, :3], rigid[:3, 3] = turn * np.sign(np.linalg.det(turn)), matrix[:3, 3] * self.stage.unit
        return pose_from_matrix(rigid)

    def _anchor(self, joint: Mapping[str, Any], side: int) -> Floats:
        """Return the joint's frame (7,) in the frame of one of its bodies [m]."""
        target = np.array(self.stage.facts["frames"].get(joint["targets"][side], np.eye(4)))
        frame, turn = target.copy(), np.array(joint["rotations"][side])
        frame[:, 3] = target @ np.array([*joint["positions"][side], 1.0])
        if not 0.5 < np.linalg.norm(turn) < 2:
            raise HandError(f"{self.main}: joint {joint['path']} has no rotation of its frame; export it again")
        turned = np.concatenate([np.zeros(3), turn / np.linalg.norm(turn)])
        return compose(compose(invert(self._rigid(self.frames[joint["bodies"][side]])), self._rigid(frame)), turned)

    def _joint(self, joint: Mapping[str, Any]) -> Joint:
        name, (parent, child) = self.names[joint["path"]], (self.names[path] for path in joint["bodies"])
        above, below = self._anchor(joint, 0), self._anchor(joint, 1)
        turn = np.concatenate([np.zeros(3), below[3:]])
        # The child's axes at the anchor, in the frame of the parent.
        still = Joint(name, "fixed", parent, child, compose(above, invert(turn)))
        what, free = f"{self.main}: joint {joint['path']}", _free_axes(joint)
        if not free:
            return still
        if len(free) > 1:
            fault = f"{what} ({joint['kind'] or 'D6'}) has {len(free)} degrees of freedom; use revolute joints"
            return replace(still, type="ball", fault=fault)
        axis, ends = free[0]
        slides, metres, degree = axis.startswith("trans"), self.stage.unit, math.radians(1)
        unit, most = (metres, UNLIMITED_M) if slides else (degree, math.pi)
        limited = all(map(math.isfinite, ends))
        lower, upper = (end * unit for end in ends) if limited else (-most, most)
        fault = ""
        if lower > upper or max(-lower, upper) > (MAX_LENGTH_M if slides else 4 * math.pi):
            fault = f"{what}: limits {lower:g} .. {upper:g} are reversed or too large"
        # A force has the unit kg m/s^2; a torque and an inertia have further metres.
        force = self.stage.mass_unit * metres * (1 if slides else metres)
        stiffness, effort = joint.get("drive", (0.0, math.inf))
        leader, slope, offset = joint.get("mimic", ("", 0.0, 0.0))
        return replace(
            still,
            type="prismatic" if slides else "revolute" if limited else "continuous",
            axis=quat_rotate(below[3:], np.eye(3)["XYZ".index(axis[-1])]) * joint.get("sign", 1),
            lower=lower,
            upper=upper,
            effort=_stated(min(effort, joint["effort"] or math.inf) * force),
            stiffness=_stated(stiffness * force / unit),
            velocity=_stated(joint["velocity"] * unit),
            armature=_stated(joint["armature"] * force / (metres if slides else 1)),
            dry_friction=_stated(joint["dry"] * force),
            mimic=Mimic(self.names.get(leader, leader), slope, offset * unit) if leader else None,
            fault=fault,
        )

    def _shapes(self, path: str, key: str) -> list[dict[str, Any]]:
        return [shape for shape in self.stage.facts["shapes"] if shape["body"] == path and shape[key]]

    def _link(self, path: str) -> Link:
        frame = invert(self._rigid(self.frames[path]))
        solid = [self._shape(shape, frame, shape["collider"]) for shape in self._shapes(path, "collider")]
        shown = [self._shape(shape, frame, "none") for shape in self._shapes(path, "shown")]
        return Link(self.names[path], tuple(solid), self.stage.mass({path: 0}) or None, tuple(shown))

    def _shape(self, shape: dict[str, Any], frame: Floats, approximation: str) -> Shape:
        """Return a shape in the body's frame, whose inverse pose is `frame` (7,)."""
        vertices, faces = self.stage.mesh(shape)
        vertices = quat_rotate(frame[3:], vertices) + frame[:3]
        colours = self.stage.colours(shape, len(faces))
        known = colours[~np.isnan(colours).any(axis=1)]
        r, g, b = map(float, known.mean(axis=0)) if len(known) else (0.0, 0.0, 0.0)
        colour, used = (r, g, b) if len(known) else None, vertices[np.unique(faces)]
        if approximation == "boundingSphere" and len(used):
            middle = (used.min(axis=0) + used.max(axis=0)) / 2
            pose = np.concatenate([middle, IDENTITY_POSE[3:]])
            return Shape("sphere", (float(np.linalg.norm(used - middle, axis=1).max()),), pose, colour=colour)
        if exact := self._exact(shape, frame):
            return replace(exact, colour=colour)
        if approximation == "boundingCube" and len(used):
            axes = quat_to_matrix(self._rigid(np.array(shape["matrix"]))[3:]).T @ quat_to_matrix(frame[3:]).T
            corners = np.array(np.meshgrid(*zip((used @ axes.T).min(axis=0), (used @ axes.T).max(axis=0), strict=True)))
            used = corners.reshape(3, -1).T @ axes
        made = hull(used) if approximation in ("convexHull", "boundingCube") else (vertices, faces.astype(np.int32))
        return Shape("mesh", (1.0, 1.0, 1.0), IDENTITY_POSE, mesh=made, colour=colour)

    def _exact(self, shape: Mapping[str, Any], frame: Floats) -> Shape | None:
        """Return a box, sphere, cylinder or capsule; None for another solid, or if its scale makes it one."""
        if (kind := _KINDS.get(shape["kind"])) is None:
            return None
        matrix = np.array(shape["matrix"])
        turned = matrix[:3, :3] @ axis_rotation(shape)
        scale = np.linalg.norm(turned, axis=0)
        matrix[:3, :3] = turned / scale
        uneven = {"box": scale[:1], "cylinder": scale[:2]}.get(kind, scale)
        skew = np.abs(matrix[:3, :3].T @ matrix[:3, :3] - np.eye(3)).max()
        if max(skew, np.ptp(uneven) / scale[0]) > 1e-6:
            return None
        sizes = shape["size"] * 3 if kind == "box" else shape["size"]
        lengths = np.array(sizes) * (scale if kind == "box" else scale[[0, 2]][: len(sizes)]) * self.stage.unit
        return Shape(kind, tuple(map(float, lengths)), compose(frame, self._rigid(matrix)))


def _stated(value: float) -> float:
    return value if 0 < value < _MOST else 0.0


def _free_axes(joint: Mapping[str, Any]) -> list[tuple[str, tuple[float, float]]]:
    """Return the free axes of a joint with limits [degrees or stage units]; low > high locks an axis."""
    limits = float(joint.get("lowerLimit", -math.inf)), float(joint.get("upperLimit", math.inf))
    match joint["kind"]:
        case "Fixed":
            return []
        case "Revolute" | "Prismatic" as kind:
            return [(f"{'rot' if kind == 'Revolute' else 'trans'}{joint.get('axis', 'X')}", limits)]
        case "Spherical" | "Distance":
            return [(f"rot{axis}", limits) for axis in "XYZ"]
    axes = [f"{kind}{axis}" for kind in ("trans", "rot") for axis in "XYZ"]
    ends = [(axis, joint["limits"].get(axis, limits)) for axis in axes]
    return [(axis, (low, high)) for axis, (low, high) in ends if low <= high]
