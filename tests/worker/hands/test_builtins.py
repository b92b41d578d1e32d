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


_PARTS = {"spread": "prox", "medial": "med", "distal": "dist"}
#: The maker's file and names of our joints; the tolerance [m]. The facts are written with 4 to 6 decimals; the maker's
#: fingers of the Barrett hand differ by 0.41 mm among each other, and ours are all alike.
MAKERS = {
    "allegro": ("allegro/allegro_hand_right.urdf", lambda joint: f"joint_{ALLEGRO.index(joint)}.0", 2e-5),
    "barrett": (
        "barrett/bhand_model.urdf",
        lambda joint: f"{joint.rpartition('_')[0]}_{_PARTS[joint.rpartition('_')[2]]}_joint",
        0.5e-3,
    ),
    "shadow": ("shadow/shadow_hand_right.urdf", str, 2e-5),
}


@pytest.mark.parametrize("name", MAKERS)
def test_frames_are_those_of_the_maker(name: str, shared_data: Path) -> None:
    file, theirs, tolerance = MAKERS[name]
    hand, rng = hand_from_path(name), np.random.default_rng(2)
    joints = dict(zip(hand.joint_names, hand.expand(rng.uniform(hand.lower, hand.upper)), strict=True))
    mine = frames_of(name, joints)
    real = frames_of(shared_data / "hands" / file, {theirs(joint): value for joint, value in joints.items()})
    for joint in hand.joint_names:
        difference = compose(invert(real[theirs(joint)]), mine[joint])
        assert np.linalg.norm(difference[:3]) < 2 * tolerance, joint
        # Fixed angles are given as -0.785398 and the like.
        assert abs(difference[3]) == pytest.approx(1, abs=1e-9), joint
