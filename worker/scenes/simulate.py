"""Drops of an object onto a table: MuJoCo simulates the convex hull until it comes to rest.

Only the hull can touch a plane, so it is the whole collision model; mass and inertia are those of the true mesh."""

import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError, MeshError
from graspd.service.model.libraries import version_of
from graspd.service.model.transforms import Floats, apply, quat_rotate
from graspd.worker.engines.mujoco_warnings import is_invalid
from graspd.worker.grasps import move_poses
from graspd.worker.objects.disk_cache import cached_arrays
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.mesh_geometry import to_file_frame
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes import rest as resting
from graspd.worker.scenes.rest import RestingFaces, lay_flat, resting_faces, same_face_mask, stable_face_below

#: Density of the object; its value has no effect on the motion of a free body on a plane [kg/m^3].
DENSITY: Final = 500.0
TIMESTEP_S: Final = 0.002
#: At rest, no point of the object moves faster than this during a whole window [m/s].
REST_SPEED: Final = 0.01
REST_WINDOW_S: Final = 0.1
TIMEOUT_S: Final = 4.0
#: Gap between table and object at release [m].
DROP_HEIGHT: Final = (0.005, 0.05)
#: An object that rests farther than this from the middle of the table has rolled away [m].
REACH: Final = 0.25
#: Largest rotation that may lay the object flat on its face [rad]; a larger one means that it was not at rest.
MAX_SETTLE_ANGLE: Final = np.radians(5.0)
MAX_ATTEMPTS: Final = 50
#: Number of drops behind `scene/rest_probability`: the standard deviation of a share is about 6 % at most.
REFERENCE_DROPS: Final = 64
_REFERENCE_SEED: Final = 2**31
#: Sliding, torsional and rolling friction as on cloth, where a can or a ball comes to rest.
_CONTACT: Final[dict[str, Any]] = {"friction": [0.8, 0.005, 0.002], "condim": 6, "solref": [0.006, 1]}


@dataclass(frozen=True)
class RestPose:
    pose: Floats  # (7,) object frame in the table frame, laid flat on `face`
    face: int
    seconds: float


@dataclass(frozen=True)
class _Table:
    model: mujoco.MjModel
    data: mujoco.MjData
    faces: RestingFaces
    obj: ObjectModel


def drop(obj: ObjectModel, *, count: int, seed: int) -> dict[str, Floats]:
    """Drop an object onto a table until it rests, `count` times.
    A drop is repeated with a new sample if it times out, if the object leans or rolls away, or if it can topple (see
    `RestingFaces.can_topple`). An object that can roll is laid on another face, see `settle_on_face`. Scene i depends
    only on the object, the seed and i. Return `scene/object_pose` (S, 7) with the lowest point at z = 0,
    `scene/rest_probability` (S,), see `rest_probability`, and `scene/drop_seconds` (S,). Raises InputError: count or
    seed is negative. MeshError: the hull is flat, or the object never comes to rest."""
    if count < 0 or seed < 0:
        raise InputError(f"scenes and seed must not be negative; got {count} scenes, seed {seed}")
    table = _build_table(obj.centred)
    rests = []
    for scene in range(count):
        rest, rng = _drop_until_rest(table, (seed, scene)), np.random.default_rng([seed, scene, MAX_ATTEMPTS])
        face, pose = settle_on_face(obj.centred, table.faces, rest.face, rest.pose, rng)
        rests.append(RestPose(pose, face, rest.seconds))
    poses = move_poses(np.array([rest.pose for rest in rests]).reshape(count, 7), np.zeros(3))
    return {
        "scene/object_pose": to_file_frame(poses, obj.centre),
        "scene/rest_probability": rest_probability(obj, [rest.face for rest in rests]),
        "scene/drop_seconds": np.array([rest.seconds for rest in rests]),
    }


def settle_on_face(
    obj: ObjectModel, faces: RestingFaces, face: int, pose: Floats, rng: np.random.Generator
) -> tuple[int, Floats]:
    """Return the face on which a centred object stays after coming to rest on `face`, and its pose (7,).
    If the object can roll there, a face on which it cannot roll is drawn from the reference drops. If there is no such
    face, the pose is unchanged."""
    if not faces.can_roll(face) or not (steady := _steady_faces(obj)):
        return face, pose
    chosen = int(rng.choice(steady))
    return chosen, lay_flat(faces, chosen, pose)


def rest_probability(obj: ObjectModel, faces: Sequence[int]) -> Floats:
    """Return the share (S,) of drops on each face, over `REFERENCE_DROPS` drops and the scene's own drop."""
    return (reference_share(obj, faces) * REFERENCE_DROPS + 1.0) / (REFERENCE_DROPS + 1.0)


def reference_share(obj: ObjectModel, faces: Sequence[int]) -> Floats:
    """Return the share (S,) of `REFERENCE_DROPS` drops of the object alone that end on each face."""
    if not faces:
        return np.zeros(0)
    obj = obj.centred
    known, reference = resting_faces(obj), np.array(_reference_faces(obj))
    return np.array([same_face_mask(known, face, reference).sum() for face in faces]) / REFERENCE_DROPS


@cached_by_content(64)
def _reference_faces(obj: ObjectModel) -> tuple[int, ...]:
    """Return the resting faces of the reference drops; two seconds of computation, cached on disk."""
    code = (sys.modules[__name__], resting)

    def drops() -> dict[str, NDArray[Any]]:
        table = _build_table(obj)
        rests = [_drop_until_rest(table, (_REFERENCE_SEED, k)) for k in range(REFERENCE_DROPS)]
        return {"face": np.array([rest.face for rest in rests])}

    def fits(kept: Mapping[str, NDArray[Any]]) -> bool:
        face = kept.get("face", np.zeros(0))
        known = face.shape == (REFERENCE_DROPS,) and face.dtype == np.int64
        return known and bool(np.isin(face, np.arange(len(resting_faces(obj).offset))).all())

    kept = cached_arrays("drops", (obj.content, version_of("mujoco")), code, drops, fits=fits)
    return tuple(kept["face"].tolist())


@cached_by_content(64)
def _steady_faces(obj: ObjectModel) -> tuple[int, ...]:
    faces = resting_faces(obj)
    return tuple(face for face in _reference_faces(obj) if not faces.can_roll(face))


def model_above_table(objects: Sequence[ObjectModel]) -> Any:
    """Compile objects above a table; raise MeshError if MuJoCo refuses one."""
    try:
        return spec_above_table(objects).compile()
    except ValueError as error:
        names, reason = ", ".join(repr(obj.name) for obj in objects), str(error).splitlines()[0]
        raise MeshError(f"{names} cannot be dropped: {reason}; check that each mesh has volume") from None


def spec_above_table(objects: Sequence[ObjectModel]) -> Any:
    spec = mujoco.MjSpec()
    spec.option.timestep = TIMESTEP_S
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[5, 5, 0.1], **_CONTACT)
    for number, obj in enumerate(objects):
        body = spec.worldbody.add_body(name=str(number))
        body.add_freejoint()
        add_hull(spec, body, str(number), obj.hull_vertices, obj.hull_faces, **_CONTACT)
        mass = DENSITY * obj.volume
        body.explicitinertial = True
        body.mass, body.ipos = mass, obj.centre_of_mass
        body.fullinertia = (mass * obj.inertia)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return spec


def add_hull(spec: Any, body: Any, name: str, vertices: Floats, faces: NDArray[Any], **options: Any) -> None:
    """Add a convex hull to a body of a MuJoCo specification, with the geom's `options`."""
    mesh = spec.add_mesh(name=name, inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert = np.asarray(vertices, np.float32).ravel()
    mesh.userface = np.asarray(faces, np.int32).ravel()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, **options)


def _build_table(obj: ObjectModel) -> _Table:
    model = model_above_table([obj])
    return _Table(model, mujoco.MjData(model), resting_faces(obj), obj)


def _drop_until_rest(table: _Table, key: tuple[int, int]) -> RestPose:
    for attempt in range(MAX_ATTEMPTS):
        if (rest := _drop_once(table, np.random.default_rng([*key, attempt]))) is not None:
            return rest
    raise MeshError(f"{table.obj.name!r} did not come to rest in any of {MAX_ATTEMPTS} drops; is it a perfect ball?")


def _drop_once(table: _Table, rng: np.random.Generator) -> RestPose | None:
    quaternion = rng.normal(size=4)
    quaternion /= np.linalg.norm(quaternion)
    lowest = float(quat_rotate(quaternion, table.obj.hull_vertices)[:, 2].min())
    centre = quat_rotate(quaternion, table.obj.centre_of_mass)
    position = np.array([-centre[0], -centre[1], rng.uniform(*DROP_HEIGHT) - lowest])
    data = table.data
    mujoco.mj_resetData(table.model, data)
    data.qpos[:] = np.concatenate([position, quaternion])
    seconds = _run(table)
    if seconds is None or is_invalid(data):
        return None
    quaternion = data.qpos[3:] / np.linalg.norm(data.qpos[3:])
    face, angle = stable_face_below(table.faces, quaternion)
    if angle > MAX_SETTLE_ANGLE or table.faces.can_topple(face):
        return None
    pose = lay_flat(table.faces, face, np.concatenate([data.qpos[:3], quaternion]))
    away = float(np.hypot(*apply(pose, table.obj.centre_of_mass)[:2]))
    return RestPose(pose, face, seconds) if away < REACH else None


def _run(table: _Table) -> float | None:
    model, data, quiet = table.model, table.data, 0
    for step in range(round(TIMEOUT_S / TIMESTEP_S)):
        mujoco.mj_step(model, data)
        # The speed of the centre of mass plus the angular speed times the radius bounds the speed of any point.
        spin = data.qvel[3:]
        centre_velocity = data.qvel[:3] + quat_rotate(data.qpos[3:], np.cross(spin, table.obj.centre_of_mass))
        speed = np.linalg.norm(centre_velocity) + table.obj.radius * np.linalg.norm(spin)
        quiet = quiet + 1 if speed < REST_SPEED and data.ncon > 0 else 0
        if quiet >= round(REST_WINDOW_S / TIMESTEP_S):
            return (step + 1) * TIMESTEP_S
    return None
