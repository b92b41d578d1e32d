"""Small hands and objects for tests of the parts that only read them, their postures, grasps compared bit for bit."""

import dataclasses
from dataclasses import replace

import mujoco
import numpy as np
import trimesh

from graspd.service.model.scene_spec import SceneSpec
from graspd.service.store.shards import json_attribute
from graspd.worker.control.postures import pregrasp, squeeze
from graspd.worker.generation import ValidatedBatch
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.model import ConvexPiece, HandModel, PalmFrame
from graspd.worker.hands.surface import farthest_points
from graspd.worker.objects.mesh_geometry import corner_normals
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.simulation.environment import Scenes
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.model import Scene


def object_from_mesh(mesh: trimesh.Trimesh, name: str = "thing") -> ObjectModel:
    """An `ObjectModel` of a watertight mesh as it stands: nothing repaired, nothing simplified."""
    hull = mesh.convex_hull
    mass = float(mesh.volume)
    return ObjectModel(
        name=name,
        digest=f"{mesh.identifier_hash[:32]:0>32}",
        vertices=np.asarray(mesh.vertices, float),
        faces=np.asarray(mesh.faces, np.int32),
        corner_normals=corner_normals(np.asarray(mesh.vertices, float), np.asarray(mesh.faces, np.int32)),
        volume=mass,
        centre_of_mass=np.asarray(mesh.center_mass, float),
        inertia=np.asarray(mesh.moment_inertia, float) / mass,
        radius=float(np.linalg.norm(mesh.vertices - mesh.center_mass, axis=1).max()),
        hull_vertices=np.asarray(hull.vertices, float),
        hull_faces=np.asarray(hull.faces, np.int32),
    )


def piece(
    body: int, mesh: trimesh.Trimesh, kind: str, size: tuple[float, ...], position: tuple[float, ...]
) -> ConvexPiece:
    """A convex piece of a body whose primitive frame is the body frame moved by `position`."""
    pose = np.array([*position, 1.0, 0, 0, 0])
    vertices = np.asarray(mesh.vertices, float) + np.asarray(position)
    return ConvexPiece(body, kind, size, pose, vertices, np.asarray(mesh.faces, np.int32), f"link_{body}")


def two_finger_hand() -> HandModel:
    """A palm box with two fingers that close towards each other; the palm looks along +z."""
    palm = trimesh.creation.box((0.09, 0.06, 0.03))
    shaft = trimesh.creation.cylinder(radius=0.009, height=0.06, sections=48)
    tip = trimesh.creation.icosphere(subdivisions=3, radius=0.011)
    pieces = [piece(0, palm, "box", (0.09, 0.06, 0.03), (0, 0, -0.015))]
    for body in (1, 2):
        pieces.append(piece(body, shaft, "cylinder", (0.009, 0.06), (0, 0, 0.035)))
        pieces.append(piece(body, tip, "sphere", (0.011,), (0, 0, 0.068)))
    origin = np.array([[0, 0, 0, 1, 0, 0, 0], [-0.04, 0, 0, 1, 0, 0, 0], [0.04, 0, 0, 1, 0, 0, 0]], float)
    return HandModel(
        name="two_finger",
        digest="0" * 32,
        root_link="palm",
        body_names=("palm", "left", "right"),
        parent=np.array([-1, 0, 0], np.int32),
        joint_type=np.array([0, 1, 1], np.int32),
        origin=origin,
        axis=np.array([[0, 0, 1], [0, 1, 0], [0, -1, 0]], float),
        dof=np.array([-1, 0, 1], np.int32),
        multiplier=np.ones(3),
        offset=np.zeros(3),
        dof_names=("left", "right"),
        lower=np.full(2, -0.3),
        upper=np.full(2, 1.2),
        effort=np.ones(2),
        stiffness=np.full(2, 10.0),
        preshape=np.zeros(2),
        closing=np.ones(2),
        joint_names=("left", "right"),
        joint_body=np.array([1, 2], np.int32),
        palm=PalmFrame(np.zeros(3), np.array([0.0, 0, 1])),
        fingertips=(1, 2),
        pieces=tuple(pieces),
        neighbours=frozenset({(0, 1), (0, 2)}),
        masses=np.array([0.3, 0.05, 0.05]),
    )


def on_one_dof(hand: HandModel, rate: float = 1.0, offset: float = 0.0) -> HandModel:
    """A hand of two joints with both driven by the first one's dof, the second at another rate from an offset."""
    first = {
        name: getattr(hand, name)[:1]
        for name in ("dof_names", "lower", "upper", "effort", "stiffness", "preshape", "closing")
    }
    dof, multiplier = np.array([-1, 0, 0], np.int32), np.array([1.0, 1.0, rate])
    offsets = np.array([0.0, 0.0, offset])
    return replace(hand, digest="1" * 32, dof=dof, multiplier=multiplier, offset=offsets, **first)


def on_tables(obj: ObjectModel, *, count: int = 2, seed: int = 1) -> Scenes:
    """So many scenes of an object at rest on a table."""
    table = SceneSpec(kind="table")
    return Scenes(supports_of(table), rest_poses(table, obj, count=count, seed=seed)["scene/object_pose"])


def quality_columns(count: int) -> dict[str, np.ndarray]:
    """Measures of valid grasps for a base shard; they rise from 0.1 to 0.3."""
    rising = np.linspace(0.1, 0.3, count)
    swept = ("contact_area_cm2", "epsilon", "wrench_volume")
    plain = ("intersection_volume_cm3", "penetration_depth_mm", "self_penetration_depth_mm", "stability_loss")
    made = {f"quality/{name}": np.repeat(rising[:, None], 2, axis=1) for name in swept}
    made |= {f"quality/{name}": rising for name in plain}
    made |= {"quality/thresholds_m": np.array([0.002, 0.005]), "quality/contact_links": np.full(count, 4)}
    return made | {"quality/valid": np.ones(count, np.uint8), "quality/success": np.ones(count, np.int8)}


def attributes_of(hand: HandModel, obj: ObjectModel, **more: object) -> dict[str, object]:
    """What a base shard says of the grasps of a hand on an object."""
    said = {"hand": hand.name, "hand_digest": hand.digest, "object": obj.name, "object_digest": obj.digest}
    said |= {"method": "none", "fidelity": json_attribute({"face_error_m": 3e-4}), "seed": 5, "batch": 0}
    return {**said, "joint_names": list(hand.joint_names), **more}


def assert_same_grasps(one: GraspSet | Exception, other: GraspSet) -> None:
    assert isinstance(one, GraspSet)
    columns, others = one.to_columns(), other.to_columns()
    assert columns.keys() == others.keys()
    for name, values in others.items():
        np.testing.assert_array_equal(columns[name], values, err_msg=name)
    np.testing.assert_array_equal(one.stability_loss, other.stability_loss)


def assert_same_batch(one: ValidatedBatch, other: ValidatedBatch) -> None:
    assert_same_grasps(one.grasps, other.grasps)
    assert (one.candidates, one.rejected, one.verdict_key) == (other.candidates, other.rejected, other.verdict_key)
    assert one.columns.keys() == other.columns.keys()
    for name, values in other.columns.items():
        np.testing.assert_array_equal(one.columns[name], values, err_msg=name)


def posture(*rows: tuple[tuple[float, float, float], tuple[float, ...]]) -> Posture:
    """Postures with the root's axes along the object's: (position, joints) each."""
    pose = np.array([[*position, 1.0, 0, 0, 0] for position, _ in rows])
    return Posture(pose, np.array([joints for _, joints in rows], float))


def grasp_set(grasp: Posture) -> GraspSet:
    return GraspSet(grasp, grasp, grasp, np.full(len(grasp), np.nan))


def plate_hand(size: tuple[float, float, float] = (0.05, 0.05, 0.01)) -> HandModel:
    """A gripper: two parallel plates that slide along x towards each other from a small base far below."""
    base = two_finger_hand()
    plate = trimesh.creation.box(size)
    foot = piece(0, trimesh.creation.box((0.02, 0.02, 0.02)), "box", (0.02, 0.02, 0.02), (0, 0, -0.15))
    pieces = (foot, *(piece(body, plate, "box", size, (0, 0, 0)) for body in (1, 2)))
    turn = np.sqrt(0.5)
    origin = np.array([[0, 0, 0, 1, 0, 0, 0], [-0.1, 0, 0, turn, 0, turn, 0], [0.1, 0, 0, turn, 0, -turn, 0]])
    return dataclasses.replace(
        base,
        name="plates",
        digest=f"{hash(size) & 0xFFFFFFFF:032x}",
        joint_type=np.array([0, 2, 2], np.int32),
        origin=origin,
        axis=np.array([[0, 0, 1], [0, 0, 1], [0, 0, 1]], float),
        lower=np.zeros(2),
        upper=np.full(2, 0.1),
        effort=np.full(2, 100.0),
        stiffness=np.full(2, 100.0),
        pieces=pieces,
        palm=PalmFrame(np.array([0.0, 0, -0.14]), np.array([0.0, 0, 1])),
        masses=np.array([0.3, 0.1, 0.1]),
    )


def pad_hand() -> HandModel:
    """`plate_hand` with round pads that touch where its plates would.

    Of two flat faces that meet the validator's engine keeps one point, anywhere on the face.
    """
    plates, radius = plate_hand(), 0.01
    ball = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    pads = tuple(piece(body, ball, "sphere", (radius,), (0, 0, 0.005 - radius)) for body in (1, 2))
    return dataclasses.replace(plates, name="pads", digest="9ad5" * 8, pieces=(plates.pieces[0], *pads))


#: Pose of a hand that touches nothing.
FAR = np.array([0, 0, -0.5, 1.0, 0, 0, 0])


def placed_data(scene: Scene, joints: np.ndarray, pose: np.ndarray = FAR) -> mujoco.MjData:
    """Data of a scene whose hand is at a pose with these joints."""
    data = mujoco.MjData(scene.model)
    scene.place(data, pose, joints)
    mujoco.mj_forward(scene.model, data)
    return data


def choose_contacts(near: np.ndarray, place: np.ndarray, normal: np.ndarray, *, scale: float, limit: int) -> np.ndarray:
    """What `spread_contacts` does, of one set."""
    index = np.flatnonzero(near)
    if len(index) <= limit:
        return index
    return index[farthest_points(np.hstack([place[index] / scale, normal[index]]), limit)]


BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
WHOLE = ConvexPieces((BOX.hull_vertices,), 1.0, 0.0, "box")
#: Their soft drives press with 10 N from 10 cm behind the box.
PADS = dataclasses.replace(pad_hand(), upper=np.full(2, 0.2))
CONTACT = posture(((0, 0, 0), (0.065, 0.065)))


def grasp_of(contact: Posture = CONTACT, force: float = 20.0) -> GraspSet:
    """Pads that open by 10 mm, touch the box, press."""
    command = squeeze(PADS, BOX, contact, total_normal_force=force)
    return GraspSet(contact, pregrasp(PADS, BOX, contact), command, np.full(len(contact), np.nan))


def many_grasps(count: int = 8) -> GraspSet:
    """Pads that hold the box ever nearer to its edge, from firm to none at all."""
    rows = [((0, 0, z), (0.065, 0.065)) for z in np.linspace(0.0, 0.055, count)]
    return grasp_of(contact=posture(*rows))
