"""Supports and rest poses of the scenes that users specify: tables, bins, shelves, and files."""

from dataclasses import replace
from typing import Final

import numpy as np

from graspd.service.model.errors import SceneError
from graspd.service.model.scene_spec import BIN_SIZE, MOST_TOUCH, SHELF_SIZE, Box, SceneSpec, scene_supports
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, compose, quat_from_axis_angle, quat_rotate
from graspd.worker.grasps import move_poses
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes.rest import lay_flat, resting_faces
from graspd.worker.scenes.simulate import drop, reference_share, rest_probability
from graspd.worker.simulation.environment import Obstacle

#: Least gap between an object and a wall [m].
GAP: Final = 0.01
#: Least probability of a resting face with `faces all`.
LEAST_PROBABILITY: Final = 0.03
#: Tolerated penetration of an object into its support [m], since poses in files are rounded.
SUNK: Final = 5e-4


def supports_of(spec: SceneSpec) -> tuple[Obstacle, ...]:
    """Return the supports in the scene frame; none for a free object."""
    found = (
        Obstacle.box(s.pose, s.size) if isinstance(s, Box) else Obstacle.half_space(s.normal, s.offset)
        for s in scene_supports(spec)
    )
    return tuple(found) if spec.touch >= MOST_TOUCH else tuple(replace(o, tips_m=1e-3 * spec.touch) for o in found)


def walled_area(spec: SceneSpec) -> tuple[float, float] | None:
    """Return sides x and y of the area in a bin's walls or on a shelf's board [m]; None without limits."""
    return {"bin": BIN_SIZE, "shelf": (SHELF_SIZE[1], SHELF_SIZE[0])}.get(spec.kind)


def rest_poses(spec: SceneSpec, obj: ObjectModel, *, count: int, seed: int) -> dict[str, Floats]:
    """Compute the object's rest poses in `count` scenes (`faces all`: one for each stable face).
    Return `scene/object_pose` (S, 7) in the scene frame, `scene/rest_probability` (S,), `scene/drop_seconds` (S,).
    Raises SceneError: the object does not fit between the supports, or penetrates one. MeshError: no rest pose."""
    if spec.target is not None:
        poses = np.tile(np.asarray(spec.target, float), (count, 1))
        found = _rest_columns(poses, np.ones(count))
    elif spec.faces == "all":
        found = _rest_on_each_face(obj, seed)
    else:
        found = drop(obj, count=count, seed=seed)
    poses = found["scene/object_pose"]
    if (size := walled_area(spec)) is not None:
        rngs = [np.random.default_rng([seed, scene]) for scene in range(len(poses))]
        poses = np.array([move_inside(obj, pose, size, rng) for pose, rng in zip(poses, rngs, strict=True)])
    poses = poses if spec.target is not None else move_poses(poses, np.zeros(3))
    require_no_penetration(obj, poses, supports_of(spec))
    return {**found, "scene/object_pose": poses}


def _rest_columns(poses: Floats, probability: Floats) -> dict[str, Floats]:
    seconds = np.zeros(len(poses))
    return {"scene/object_pose": poses, "scene/rest_probability": probability, "scene/drop_seconds": seconds}


def _rest_on_each_face(obj: ObjectModel, seed: int) -> dict[str, Floats]:
    """Return one scene per stable face on which at least `LEAST_PROBABILITY` of drops end.
    Faces on which the object rolls are used only if there are no others."""
    faces = resting_faces(obj)
    stable = faces.stable_faces
    share = reference_share(obj, stable.tolist())
    kept = stable[share >= LEAST_PROBABILITY]
    if not len(kept):
        kept = stable[[int(np.argmax(share))]]
    chosen = [face for face in kept.tolist() if not faces.can_roll(face)] or kept.tolist()
    poses = []
    for number, face in enumerate(chosen):
        turn = np.random.default_rng([seed, number]).uniform(0, 2 * np.pi)
        pose = rotate_about_vertical(lay_flat(faces, face, IDENTITY_POSE), turn)
        pose[:2] -= apply(pose, obj.centre_of_mass)[:2]
        poses.append(pose)
    return _rest_columns(np.array(poses), rest_probability(obj, chosen))


def rotate_about_vertical(pose: Floats, angle: float) -> Floats:
    """Return the pose rotated about the vertical axis through the origin."""
    about = np.concatenate([np.zeros(3), quat_from_axis_angle(np.array([0.0, 0, 1]), np.asarray(angle))])
    return compose(about, pose)


def move_inside(obj: ObjectModel, pose: Floats, size: tuple[float, float], rng: np.random.Generator) -> Floats:
    """Move a pose to a random place in a rectangle x by y [m] about the origin; SceneError if too small."""
    corners = quat_rotate(pose[3:], obj.hull_vertices)[:, :2]
    low, high = corners.min(axis=0), corners.max(axis=0)
    room = np.asarray(size) / 2 - GAP
    if (high - low > 2 * room).any():
        need, have = 1e3 * (high - low), 1e3 * 2 * room
        raise SceneError(
            f"{obj.name} needs {need[0]:.0f} x {need[1]:.0f} mm and there is room for {have[0]:.0f} x {have[1]:.0f} mm "
            "between the walls; choose scene table, or a file with larger supports"
        )
    return np.concatenate([rng.uniform(-room - low, room - high), pose[2:]])


def require_no_penetration(obj: ObjectModel, poses: Floats, supports: tuple[Obstacle, ...]) -> None:
    """Raise SceneError if the object at a pose (S, 7) penetrates a support by more than `SUNK`."""
    for pose in poses:
        corners = apply(pose, obj.hull_vertices)
        for number, support in enumerate(supports):
            depth = -float(support.distance(corners).min())
            if depth > SUNK:
                fault = f"{obj.name} is {1e3 * depth:.1f} mm deep in support {number} of its scene"
                raise SceneError(f"{fault}; move the object or the support")
