"""The four reference hands: kinematics against yourdfpy, and each quirk that their notes name."""

from __future__ import annotations

import functools
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
import yourdfpy

from graspd.service.model.transforms import IDENTITY_POSE, pose_to_matrix
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import files_from_path, hand_from_path, load_hand
from graspd.worker.hands.model import HandModel

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


def test_every_real_hand_has_surface_palm_and_closes_to_a_point(real: tuple[str, Path, HandModel]) -> None:
    _, _, hand = real
    assert np.linalg.norm(hand.palm.approach) == pytest.approx(1.0)
    assert (hand.lower < hand.upper).all() and (hand.effort > 0).all() and (hand.masses > 0).all()
    assert ((hand.preshape >= hand.lower) & (hand.preshape <= hand.upper)).all()
    q = np.stack([hand.preshape, np.clip(hand.preshape + 0.15 * hand.closing, hand.lower, hand.upper)])
    tips = body_poses(hand, np.tile(IDENTITY_POSE, (2, 1)), hand.expand(q))[:, list(hand.fingertips), :3]
    spread = np.linalg.norm(tips - tips.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
    assert spread[1] < spread[0]
    assert max((len(p.faces) for p in hand.pieces if p.kind == "hull"), default=0) <= 100


@pytest.mark.parametrize(
    ("name", "root", "normal"),
    [
        ("allegro", "base_link", (1, 0, 0)),
        ("barrett", "base_link", (0, 0, 1)),
        ("bh280", "bh_palm", (0, 0, 1)),
        ("shadow", "palm", (0, -1, 0)),
    ],
)
def test_root_and_palm_normal_are_guessed_from_the_urdf_alone(
    shared_data: Path, name: str, root: str, normal: tuple[int, int, int]
) -> None:
    hand = bare(shared_data, name)
    assert hand.root_link == root
    np.testing.assert_allclose(hand.palm.approach, normal, atol=1e-9)


@functools.cache
def load(shared_data: Path, name: str) -> HandModel:
    return hand_from_path(shared_data / "hands" / URDFS[name])


def bare(shared_data: Path, name: str, **options: object) -> HandModel:
    """The hand from its URDF and meshes alone, without the notes beside them."""
    return _bare(shared_data, name, json.dumps(options))


@functools.cache
def _bare(shared_data: Path, name: str, options: str) -> HandModel:
    return load_hand(bare_files(shared_data, name), name=name, digest="0" * 32, options=json.loads(options))


@functools.cache
def bare_files(shared_data: Path, name: str) -> dict[str, bytes]:
    _, files, _ = files_from_path(shared_data / "hands" / URDFS[name])
    return {file: content for file, content in files.items() if file != "hand.json"}


def facts(shared_data: Path, name: str) -> dict[str, Any]:
    """The notes on a hand."""
    return json.loads((shared_data / "hands" / URDFS[name]).with_name("hand.json").read_text())


def test_every_real_hand_is_accepted_as_it_is(shared_data: Path) -> None:
    for name in URDFS:
        found = check_hand(bare_files(shared_data, name), name)
        assert found["verdict"] == "accept", found["message"]
        said = facts(shared_data, name)
        assert len(found["facts"]["fingertips"]) == len(said["fingertips"])
        above = 2 if name == "shadow" else 0
        assert len(found["facts"]["dofs"]) == said["dof"] - above


def test_allegros_quirks_frames_tips_and_limits_without_zero(shared_data: Path) -> None:
    hand, said = load(shared_data, "allegro"), facts(shared_data, "allegro")
    assert said["inertial_missing"] == ["palm", "wrist"]
    assert hand.masses.sum() == pytest.approx(said["total_mass_kg"], abs=2e-3)
    assert (hand.masses > 0).all()
    tips = [p for p in load(shared_data, "allegro").pieces if p.kind == "hull"]
    assert len(tips) == 4 and len({p.body for p in tips}) == 4
    own = [piece.vertices - piece.vertices.mean(axis=0) for piece in tips]
    spans = [np.sort(np.linalg.norm(vertices, axis=1)) for vertices in own]
    for span in spans[1:]:
        np.testing.assert_allclose(span, spans[0], atol=1e-9)
    hand = load(shared_data, "allegro")
    thumb = hand.dof_names.index("joint_12.0")
    assert hand.lower[thumb] > 0 and hand.preshape[thumb] >= hand.lower[thumb]
    np.testing.assert_allclose(load(shared_data, "allegro").effort, 0.7)
    np.testing.assert_allclose(bare(shared_data, "allegro").effort, 10.0)


def test_barretts_quirks_efforts_signs_masses_and_tips(shared_data: Path) -> None:
    assert (load(shared_data, "barrett").effort > 0).all()
    hand = load(shared_data, "barrett")
    bending = [i for i, name in enumerate(hand.dof_names) if "prox" not in name]
    assert (hand.closing[bending] == -1).all()
    assert (hand.closing[[i for i, name in enumerate(hand.dof_names) if "prox" in name]] == 0).all()
    # 3 kg for a hand of 1 kg: nothing that is static needs them, so they are kept and shown, not corrected.
    hand, said = load(shared_data, "barrett"), facts(shared_data, "barrett")
    assert hand.masses.sum() == pytest.approx(said["total_mass_kg"], rel=1e-4)
    hand = load(shared_data, "barrett")
    assert "finger_1_med_liink" in hand.body_names
    assert hand_from_path(shared_data / "hands" / URDFS["barrett"], {"drop": ["finger_1_med_liink"]}).dofs == 6
    hand = bare(shared_data, "barrett")
    named = [hand.body_names[body] for body in hand.fingertips]
    assert sorted(named) == sorted(facts(shared_data, "barrett")["fingertips"].values())


def test_bh280_couples_by_mimics_and_stands_open_at_zero(shared_data: Path) -> None:
    hand = load(shared_data, "bh280")
    poses = body_poses(hand, IDENTITY_POSE, hand.expand(np.zeros(4)))[0]
    first, second = (poses[hand.body_names.index(f"bh_finger_{k}3"), :3] for k in (1, 2))
    # Fingers 1 and 2 stand 5 cm apart on the same side of the palm, finger 3 on the other.
    third = poses[hand.body_names.index("bh_finger_33"), :3]
    across = first - second
    axis = int(np.argmax(np.abs(across)))
    assert np.delete(across, axis) == pytest.approx([0.0, 0.0], abs=1e-6) and abs(across[axis]) < 0.06
    assert np.linalg.norm(third - first) > 0.1
    assert hand.dofs == 4 and len(hand.joint_names) == 8
    joints = dict(zip(hand.joint_names, hand.expand(np.array([0.0, 0.0, 1.0, 0.0])), strict=True))
    assert joints["bh_j13_joint"] == pytest.approx(0.3442622950819672)


def test_bh280_transmissions_and_foreign_tags_do_not_matter(shared_data: Path) -> None:
    _, files, _ = files_from_path(shared_data / "hands" / URDFS["bh280"])
    text = files["bh280.urdf"]
    assert b"<transmission" in text and b"drake:" in text and b"FROGGERCOL" in text
    hand = bare(shared_data, "bh280")
    assert not [name for name in hand.body_names if "FROGGER" in name]
    assert len(hand.pieces) >= sum(facts(shared_data, "bh280")["collision_elements"].values())


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


def test_shadows_meshes_of_two_units_are_closed_hulls(shared_data: Path) -> None:
    hand = load(shared_data, "shadow")
    extents = {p.link: float(np.ptp(p.vertices, axis=0).max()) for p in hand.pieces if p.kind == "hull"}
    # The knuckle is in metres, the distal link in millimetres with a scale: 16 mm and 27 mm parts.
    assert extents["ffknuckle"] == pytest.approx(0.016, abs=2e-3)
    assert extents["ffdistal"] == pytest.approx(0.027, abs=2e-3)
    assert not facts(shared_data, "shadow")["collision_mesh_files"]["th_distal_pst_full.obj"]["watertight"]
    (tip,) = (p for p in load(shared_data, "shadow").pieces if p.link == "thdistal" and p.kind == "hull")
    assert trimesh.Trimesh(tip.vertices, tip.faces).is_watertight
    assert hand.effort[hand.dof_names.index("THJ5")] == 5.0


def test_shadow_has_the_tendon_coupling_that_a_user_adds(shared_data: Path) -> None:
    fingers = ("FF", "MF", "RF", "LF")
    assert bare(shared_data, "shadow").dofs == 22
    couplings = {f"{finger}J1": {"of": f"{finger}J2", "multiplier": 1.0} for finger in fingers}
    hand = bare(shared_data, "shadow", couplings=couplings)
    assert hand.dofs == 18
    joints = dict(zip(hand.joint_names, hand.expand(hand.upper), strict=True))
    assert all(joints[f"{finger}J1"] == joints[f"{finger}J2"] for finger in fingers)


def test_shadows_arm_is_left_out_told_or_kept(shared_data: Path) -> None:
    whole = bare(shared_data, "shadow", root="world")
    assert whole.root_link == "world" and whole.dofs == 24
    assert "forearm" in {piece.link for piece in whole.pieces}
    files = bare_files(shared_data, "shadow")
    note = "WRJ2, WRJ1 above the palm left out, poses are those of 'palm' (--root world)"
    assert note in check_hand(files, "shadow")["facts"]["notes"]
    assert not any("left out" in one for one in check_hand(files, "shadow", {"root": "world"})["facts"]["notes"])
    hand = bare(shared_data, "shadow")
    assert hand.root_link == "palm" and hand.dofs == 22
    assert not {"forearm", "wrist"} & {piece.link for piece in hand.pieces}
    path = shared_data / "hands" / URDFS["shadow"]
    hand = hand_from_path(path, {"root": "world", "fix": {"WRJ1": 0.0, "WRJ2": 0.0}})
    assert hand.dofs == 22 and hand.root_link == "world"


def test_on_its_forearm_a_palm_faces_where_its_fingers_close(shared_data: Path) -> None:
    hand = hand_from_path(shared_data / "hands/shadow/shadow_hand_right.urdf", {"root": "world"})
    # Noted in the frame of the palm link, (0, -1, 0); the forearm turns that by a quarter about z.
    np.testing.assert_allclose(hand.palm.approach, [1, 0, 0], atol=1e-4)
    assert [hand.closing[hand.dof_names.index(name)] for name in ("WRJ1", "WRJ2", "FFJ3")] == [0, 0, 1]
