"""Small hands and objects for tests of the parts that only read them; comparison of grasps bit for bit."""

from dataclasses import replace

import numpy as np
import trimesh

from graspd.service.model.scene_spec import SceneSpec
from graspd.service.store.shards import json_attribute
from graspd.worker.generation import ValidatedBatch
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import ConvexPiece, HandModel, PalmFrame
from graspd.worker.objects.mesh_geometry import corner_normals
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.simulation.environment import Scenes


def unit_vectors(rng: np.random.Generator, count: int, size: int = 3) -> np.ndarray:
    """(N, size) directions drawn evenly; of size 4 quaternions of rotations."""
    found = rng.normal(size=(count, size))
    return found / np.linalg.norm(found, axis=1, keepdims=True)


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
