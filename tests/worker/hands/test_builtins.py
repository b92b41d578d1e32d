"""The built-in hands are the same hands as the makers' files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import IDENTITY_POSE, compose, invert
from graspd.service.store.assets import builtin_asset, builtin_names
from graspd.worker.hands.collisions import touching_bodies
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.surface import piece_distance

ALLEGRO = [f"{f}_{j}" for f in ("index", "middle", "ring") for j in ("abduction", "proximal", "middle", "distal")]
ALLEGRO += ["thumb_rotation", "thumb_proximal", "thumb_middle", "thumb_distal"]
#: The facts are written with 4 to 6 decimals.
FRAME_TOLERANCE_M = 2e-5


@pytest.mark.parametrize(("name", "joints", "dofs"), [("allegro", 16, 16), ("barrett", 8, 4), ("shadow", 22, 22)])
def test_built_in_hands_have_their_dofs(name: str, joints: int, dofs: int) -> None:
    hand = hand_from_path(name)
    assert (len(hand.joint_names), hand.dofs) == (joints, dofs)
    assert builtin_asset(AssetKind.HAND, name)[0].digest == hand.digest


@pytest.mark.parametrize("name", builtin_names(AssetKind.HAND))
def test_fingers_stand_out_from_the_palm_and_do_not_touch(name: str) -> None:
    hand = hand_from_path(name)
    tips = body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0, list(hand.fingertips), :3]
    assert ((tips - hand.palm.centre) @ hand.palm.approach).mean() > 0.01
    assert not touching_bodies(hand, hand.preshape, 0.0) - hand.neighbours
    palm = [piece for piece in hand.pieces if piece.body == 0]
    just_out = hand.palm.centre + 1e-3 * hand.palm.approach
    just_in = hand.palm.centre - 2e-3 * hand.palm.approach
    assert min(float(piece_distance(p, just_out[None])[0]) for p in palm) > 0
    assert min(float(piece_distance(p, just_in[None])[0]) for p in palm) < 0


def frames_of(name: str | Path, joints: dict[str, float]) -> dict[str, np.ndarray]:
    """Pose of the body that each joint carries."""
    hand = hand_from_path(name)
    values = np.array([joints[joint] for joint in hand.joint_names])
    poses = body_poses(hand, IDENTITY_POSE, values)[0]
    return {joint: poses[body] for joint, body in zip(hand.joint_names, hand.joint_body, strict=True)}


def test_allegro_frames_are_those_of_the_maker(shared_data: Path) -> None:
    rng = np.random.default_rng(1)
    q = rng.uniform(0.3, 1.0, 16)
    mine = frames_of("allegro", dict(zip(ALLEGRO, q, strict=True)))
    path = shared_data / "hands" / "allegro" / "allegro_hand_right.urdf"
    real = frames_of(path, {f"joint_{i}.0": value for i, value in enumerate(q)})
    for i, joint in enumerate(ALLEGRO):
        np.testing.assert_allclose(mine[joint], real[f"joint_{i}.0"], atol=FRAME_TOLERANCE_M, err_msg=joint)


def test_barrett_frames_are_those_of_the_maker(shared_data: Path) -> None:
    mine_q, real_q = {}, {}
    for k in (1, 2, 3):
        medial = -0.4 * k
        mine_q |= {f"finger_{k}_medial": medial, f"finger_{k}_distal": medial / 3}
        real_q |= {f"finger_{k}_med_joint": medial, f"finger_{k}_dist_joint": medial / 3}
    for k, spread in ((1, -0.7), (2, 0.7)):
        mine_q[f"finger_{k}_spread"] = real_q[f"finger_{k}_prox_joint"] = spread
    mine = frames_of("barrett", mine_q)
    real = frames_of(shared_data / "hands" / "barrett" / "bhand_model.urdf", real_q)
    for k in (1, 2, 3):
        # The maker's fingers differ by 0.41 mm among each other; ours are all alike.
        distance = np.linalg.norm(mine[f"finger_{k}_distal"][:3] - real[f"finger_{k}_dist_joint"][:3])
        assert distance < 0.5e-3


def test_shadow_frames_are_those_of_the_maker(shared_data: Path) -> None:
    hand = hand_from_path("shadow")
    rng = np.random.default_rng(2)
    joints = dict(zip(hand.joint_names, hand.expand(rng.uniform(hand.lower, hand.upper)), strict=True))
    mine = frames_of("shadow", joints)
    real = frames_of(shared_data / "hands" / "shadow" / "shadow_hand_right.urdf", joints)
    for joint in hand.joint_names:
        difference = compose(invert(real[joint]), mine[joint])
        np.testing.assert_allclose(difference[:3], 0, atol=FRAME_TOLERANCE_M, err_msg=joint)
        # The fixed angles are given as -0.785398 and the like.
        np.testing.assert_allclose(np.abs(difference[3]), 1, atol=1e-9, err_msg=joint)
