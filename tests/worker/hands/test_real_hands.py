"""The four reference hands: kinematics against yourdfpy, and each quirk that their notes name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yourdfpy

from worker.hands.kinematics import body_poses
from worker.hands.load import files_from_path, hand_from_path, load_hand
from worker.hands.model import HandModel
from worker.transforms import IDENTITY_POSE, pose_to_matrix

URDFS = {
    "allegro": "allegro/allegro_hand_right.urdf",
    "barrett": "barrett/bhand_model.urdf",
    "bh280": "barrett_bh280/bh280.urdf",
    "shadow": "shadow/shadow_hand_right.urdf",
}
#: Both sides compute in float64; link chains are a handful of rotations long.
FRAME_TOLERANCE = 1e-9


@pytest.fixture(scope="module", params=sorted(URDFS))
def real(request: pytest.FixtureRequest, shared_data: Path) -> tuple[str, Path, HandModel]:
    path = shared_data / "hands" / URDFS[request.param]
    return request.param, path, hand_from_path(path)


def test_forward_kinematics_agrees_with_yourdfpy(real: tuple[str, Path, HandModel]) -> None:
    _, path, hand = real
    oracle = yourdfpy.URDF.load(str(path), load_meshes=False, build_scene_graph=True)
    rng = np.random.default_rng(7)
    for _ in range(5):
        q = rng.uniform(hand.lower, hand.upper)
        joints = dict(zip(hand.joint_names, hand.expand(q), strict=True))
        # The oracle is given every joint, so that its own (wrong) chaining of mimics does not enter.
        oracle.update_cfg(np.array([joints.get(name, 0.0) for name in oracle.actuated_joint_names]))
        poses = pose_to_matrix(body_poses(hand, IDENTITY_POSE, hand.expand(q))[0])
        for body, link in enumerate(hand.body_names):
            expected = oracle.get_transform(link, hand.root_link)
            np.testing.assert_allclose(poses[body], expected, atol=FRAME_TOLERANCE, err_msg=link)


def test_every_real_hand_has_a_surface_and_a_palm(real: tuple[str, Path, HandModel]) -> None:
    _, _, hand = real
    assert np.linalg.norm(hand.palm.approach) == pytest.approx(1.0)
    assert (hand.lower < hand.upper).all() and (hand.effort > 0).all() and (hand.masses > 0).all()
    assert ((hand.preshape >= hand.lower) & (hand.preshape <= hand.upper)).all()


def test_closing_brings_the_fingertips_together(real: tuple[str, Path, HandModel]) -> None:
    _, _, hand = real
    q = np.stack([hand.preshape, np.clip(hand.preshape + 0.15 * hand.closing, hand.lower, hand.upper)])
    tips = body_poses(hand, np.tile(IDENTITY_POSE, (2, 1)), hand.expand(q))[:, list(hand.fingertips), :3]
    spread = np.linalg.norm(tips - tips.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
    assert spread[1] < spread[0]


def test_hulls_are_small_enough_for_fast_queries(real: tuple[str, Path, HandModel]) -> None:
    _, _, hand = real
    assert max((len(p.faces) for p in hand.pieces if p.kind == "hull"), default=0) <= 100


@pytest.mark.parametrize(
    ("name", "root", "normal"),
    [
        ("allegro", None, (1, 0, 0)),
        ("barrett", None, (0, 0, 1)),
        ("bh280", None, (0, 0, 1)),
        ("shadow", "palm", (0, -1, 0)),
    ],
)
def test_the_palm_normal_is_guessed_right(
    shared_data: Path, name: str, root: str | None, normal: tuple[int, int, int]
) -> None:
    path = shared_data / "hands" / URDFS[name]
    _, files, _ = files_from_path(path)
    hand = load_hand(files, name=name, digest="0" * 32, options={"root": root} if root else {})
    np.testing.assert_allclose(hand.palm.approach, normal, atol=1e-9)


def load(shared_data: Path, name: str) -> HandModel:
    return hand_from_path(shared_data / "hands" / URDFS[name])


def test_allegro_posture_respects_limits_that_exclude_zero(shared_data: Path) -> None:
    hand = load(shared_data, "allegro")
    thumb = hand.dof_names.index("joint_12.0")
    assert hand.lower[thumb] > 0 and hand.preshape[thumb] >= hand.lower[thumb]


def test_allegro_placeholder_effort_becomes_the_real_torque_limit(shared_data: Path) -> None:
    np.testing.assert_allclose(load(shared_data, "allegro").effort, 0.7)


def test_barrett_zero_effort_does_not_switch_the_hand_off(shared_data: Path) -> None:
    assert (load(shared_data, "barrett").effort > 0).all()


def test_barrett_closes_in_the_negative_direction(shared_data: Path) -> None:
    hand = load(shared_data, "barrett")
    bending = [i for i, name in enumerate(hand.dof_names) if "prox" not in name]
    assert (hand.closing[bending] == -1).all()


def test_barrett_spread_joints_close_nothing(shared_data: Path) -> None:
    hand = load(shared_data, "barrett")
    assert (hand.closing[[i for i, name in enumerate(hand.dof_names) if "prox" in name]] == 0).all()


def test_bh280_mimic_tags_leave_four_degrees_of_freedom(shared_data: Path) -> None:
    hand = load(shared_data, "bh280")
    assert hand.dofs == 4 and len(hand.joint_names) == 8
    joints = dict(zip(hand.joint_names, hand.expand(np.array([0.0, 0.0, 1.0, 0.0])), strict=True))
    assert joints["bh_j13_joint"] == pytest.approx(0.3442622950819672)


def test_barrett_with_couplings_is_the_same_hand_as_bh280(shared_data: Path) -> None:
    ratio = 0.3442622950819672
    couplings = {f"finger_{k}_dist_joint": {"of": f"finger_{k}_med_joint", "multiplier": ratio} for k in (1, 2, 3)}
    couplings["finger_2_prox_joint"] = {"of": "finger_1_prox_joint", "multiplier": -1.0}
    one = hand_from_path(shared_data / "hands" / URDFS["barrett"], {"couplings": couplings})
    two = load(shared_data, "bh280")
    assert one.dofs == 4
    at = dict(zip(one.dof_names, (-0.6, -1.0, -0.8, -1.2), strict=True))
    values = {"bh_j11_joint": 0.6, "bh_j12_joint": 1.0, "bh_j22_joint": 0.8, "bh_j32_joint": 1.2}
    assert list(at) == ["finger_1_prox_joint", "finger_1_med_joint", "finger_2_med_joint", "finger_3_med_joint"]
    first = body_poses(one, IDENTITY_POSE, one.expand(np.array(list(at.values()))))[0]
    second = body_poses(two, IDENTITY_POSE, two.expand(np.array([values[d] for d in two.dof_names])))[0]
    for k in (1, 2, 3):
        a = first[one.body_names.index(f"finger_{k}_dist_link"), :3]
        b = second[two.body_names.index(f"bh_finger_{k}3"), :3]
        # The reference notes measured 0.41 mm between the two files.
        assert np.linalg.norm(a - b) < 0.5e-3


def test_shadow_meshes_of_two_units_come_out_alike(shared_data: Path) -> None:
    hand = load(shared_data, "shadow")
    extents = {p.link: float(np.ptp(p.vertices, axis=0).max()) for p in hand.pieces if p.kind == "hull"}
    # The knuckle is in metres, the distal link in millimetres with a scale: 16 mm and 27 mm parts.
    assert extents["ffknuckle"] == pytest.approx(0.016, abs=2e-3)
    assert extents["ffdistal"] == pytest.approx(0.027, abs=2e-3)


def test_shadow_forearm_and_wrist_are_left_out(shared_data: Path) -> None:
    hand = load(shared_data, "shadow")
    assert hand.root_link == "palm" and hand.dofs == 22
    assert not {"forearm", "wrist"} & {piece.link for piece in hand.pieces}


def test_shadow_wrist_can_be_frozen_instead(shared_data: Path) -> None:
    path = shared_data / "hands" / URDFS["shadow"]
    hand = hand_from_path(path, {"root": "world", "fix": {"WRJ1": 0.0, "WRJ2": 0.0}})
    assert hand.dofs == 22 and hand.root_link == "world"
