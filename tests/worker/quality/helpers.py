"""Postures and grasp sets for the tests of quality."""

import dataclasses

import mujoco
import numpy as np
import trimesh

from graspd.worker.control.postures import pregrasp, squeeze
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.model import HandModel, PalmFrame
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.model import Scene
from tests.worker.models import object_from_mesh, piece, two_finger_hand

#: Pose of a hand that touches nothing.
FAR = np.array([0, 0, -0.5, 1.0, 0, 0, 0])


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


def placed_data(scene: Scene, joints: np.ndarray, pose: np.ndarray = FAR) -> mujoco.MjData:
    """Data of a scene whose hand is at a pose with these joints."""
    data = mujoco.MjData(scene.model)
    scene.set_posture(data, pose, joints)
    mujoco.mj_forward(scene.model, data)
    return data


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
