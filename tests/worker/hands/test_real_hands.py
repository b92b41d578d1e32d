"""The four reference hands: kinematics against yourdfpy, and each quirk that their notes name; the built-in hands; two
models of one hand: joints by name, bases by fit, fingertips as the validator.
"""

import dataclasses
import functools
import json
from pathlib import Path

import numpy as np
import pytest
import yourdfpy

from graspd.exchange.bench_hand import write_hand
from graspd.service.model.errors import InputError
from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import IDENTITY_POSE, compose, invert, pose_to_matrix, quat_from_axis_angle
from graspd.service.store.assets import builtin_asset, builtin_names
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.collisions import touching_bodies
from graspd.worker.hands.hand_matching import match_hands
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import files_from_path, hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import piece_distance

#: Description, root and direction out of the palm.
HANDS = {
    "allegro": ("allegro/allegro_hand_right.urdf", "base_link", [1, 0, 0]),
    "barrett": ("barrett/bhand_model.urdf", "base_link", [0, 0, 1]),
    "bh280": ("barrett_bh280/bh280.urdf", "bh_palm", [0, 0, 1]),
    "shadow": ("shadow/shadow_hand_right.urdf", "palm", [0, -1, 0]),
}
#: Both sides compute in float64; link chains are a handful of rotations long.
FRAME_TOLERANCE = 1e-9
ALLEGRO = [f"{f}_{j}" for f in ("index", "middle", "ring") for j in ("abduction", "proximal", "middle", "distal")]
ALLEGRO += ["thumb_rotation", "thumb_proximal", "thumb_middle", "thumb_distal"]
HAND = hand_from_path("shadow")
#: Where the other model's root link is, as seen from ours.
BASE = np.concatenate([[0.013, -0.02, 0.034], quat_from_axis_angle(np.array([0.6, 0.0, 0.8]), np.array(2.0))])
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


@pytest.fixture(scope="module")
def hands(shared_data: Path):
    return functools.cache(lambda name: hand_from_path(shared_data / "hands" / HANDS[name][0]))


def bare_files(shared_data: Path, name: str) -> tuple[dict[str, bytes], dict]:
    _, files, _ = files_from_path(shared_data / "hands" / HANDS[name][0])
    return files, json.loads(files.pop("hand.json"))


def bare(shared_data: Path, name: str, **options: object) -> HandModel:
    return load_hand(bare_files(shared_data, name)[0], name=name, digest="0" * 32, options=options)


@pytest.mark.parametrize("name", HANDS)
def test_forward_kinematics_agrees_with_yourdfpy(name: str, hands, shared_data: Path) -> None:
    hand, path = hands(name), shared_data / "hands" / HANDS[name][0]
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


@pytest.mark.parametrize("name", HANDS)
def test_every_real_hand_has_surface_palm_and_closes_to_a_point(name: str, hands) -> None:
    hand = hands(name)
    assert np.linalg.norm(hand.palm.approach) == pytest.approx(1.0)
    assert (hand.lower < hand.upper).all() and (hand.effort > 0).all() and (hand.masses > 0).all()
    assert ((hand.preshape >= hand.lower) & (hand.preshape <= hand.upper)).all()
    q = np.stack([hand.preshape, np.clip(hand.preshape + 0.15 * hand.closing, hand.lower, hand.upper)])
    tips = body_poses(hand, np.tile(IDENTITY_POSE, (2, 1)), hand.expand(q))[:, list(hand.fingertips), :3]
    spread = np.linalg.norm(tips - tips.mean(axis=1, keepdims=True), axis=2).mean(axis=1)
    assert spread[1] < spread[0]
    assert max((len(p.faces) for p in hand.pieces if p.kind == "hull"), default=0) <= 100


@pytest.mark.parametrize("name", HANDS)
def test_every_real_hand_is_accepted_and_guessed_from_its_urdf_alone(name: str, shared_data: Path) -> None:
    files, said = bare_files(shared_data, name)
    found = check_hand(files, name)
    assert found["verdict"] == "accept", found["message"]
    facts = found["facts"]
    assert [facts["root"], facts["palm_approach"]] == list(HANDS[name][1:])
    assert len(facts["fingertips"]) == len(said["fingertips"])
    assert len(facts["dofs"]) == said["dof"] - (2 if name == "shadow" else 0)


def test_allegros_masses_efforts_and_limits_without_zero(hands, shared_data: Path) -> None:
    hand, said = hands("allegro"), bare_files(shared_data, "allegro")[1]
    assert said["inertial_missing"] == ["palm", "wrist"]
    assert hand.masses.sum() == pytest.approx(said["total_mass_kg"], abs=2e-3) and (hand.masses > 0).all()
    thumb = hand.dof_names.index("joint_12.0")
    assert hand.lower[thumb] > 0 and hand.preshape[thumb] >= hand.lower[thumb]
    np.testing.assert_allclose(hand.effort, 0.7)
    np.testing.assert_allclose(bare(shared_data, "allegro").effort, 10.0)


def test_barretts_signs_masses_and_tips(shared_data: Path) -> None:
    hand, said = bare(shared_data, "barrett"), bare_files(shared_data, "barrett")[1]
    assert hand.closing.tolist() == [0 if "prox" in name else -1 for name in hand.dof_names]
    assert hand.masses.sum() == pytest.approx(said["total_mass_kg"], rel=1e-4)
    assert {hand.body_names[body] for body in hand.fingertips} == set(said["fingertips"].values())


def test_shadows_arm_is_left_out_told_or_kept(shared_data: Path) -> None:
    whole = bare(shared_data, "shadow", root="world")
    assert whole.root_link == "world" and whole.dofs == 24
    assert "forearm" in {piece.link for piece in whole.pieces}
    files, _ = bare_files(shared_data, "shadow")
    note = "WRJ2, WRJ1 above the palm left out; poses are those of 'palm' (--root world)"
    assert note in check_hand(files, "shadow")["facts"]["notes"]
    assert not any("left out" in one for one in check_hand(files, "shadow", {"root": "world"})["facts"]["notes"])
    hand = bare(shared_data, "shadow")
    assert not {"forearm", "wrist"} & {piece.link for piece in hand.pieces}
    hand = bare(shared_data, "shadow", root="world", fix={"WRJ1": 0.0, "WRJ2": 0.0})
    assert hand.dofs == 22 and hand.root_link == "world"


def test_on_its_forearm_a_palm_faces_where_its_fingers_close(shared_data: Path) -> None:
    hand = hand_from_path(shared_data / "hands/shadow/shadow_hand_right.urdf", {"root": "world"})
    # Noted in the frame of the palm link, (0, -1, 0); the forearm turns that by a quarter about z.
    np.testing.assert_allclose(hand.palm.approach, [1, 0, 0], atol=1e-4)
    assert [hand.closing[hand.dof_names.index(name)] for name in ("WRJ1", "WRJ2", "FFJ3")] == [0, 0, 1]


@pytest.mark.parametrize("name", builtin_names(AssetKind.HAND))
def test_fingers_stand_out_from_the_palm_and_do_not_touch(name: str) -> None:
    hand = hand_from_path(name)
    assert builtin_asset(AssetKind.HAND, name)[0].digest == hand.digest
    tips = body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0, list(hand.fingertips), :3]
    assert ((tips - hand.palm.centre) @ hand.palm.approach).mean() > 0.01
    assert not touching_bodies(hand, hand.preshape, 0.0) - hand.neighbours
    palm = [piece for piece in hand.pieces if piece.body == 0]
    just_out = hand.palm.centre + 1e-3 * hand.palm.approach
    just_in = hand.palm.centre - 2e-3 * hand.palm.approach
    assert min(float(piece_distance(p, just_out[None])[0]) for p in palm) > 0
    assert min(float(piece_distance(p, just_in[None])[0]) for p in palm) < 0


def frames_of(name: str | Path, joints: dict[str, float]) -> dict[str, np.ndarray]:
    hand = hand_from_path(name)
    values = np.array([joints[joint] for joint in hand.joint_names])
    poses = body_poses(hand, IDENTITY_POSE, values)[0]
    return {joint: poses[body] for joint, body in zip(hand.joint_names, hand.joint_body, strict=True)}


@pytest.mark.parametrize("name", MAKERS)
def test_frames_of_built_in_hands_are_those_of_the_maker(name: str, shared_data: Path) -> None:
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


def other_base(hand: HandModel) -> HandModel:
    moved = invert(BASE)
    origin = hand.origin.copy()
    hangs = np.flatnonzero(hand.parent == 0)
    origin[hangs] = compose(moved, origin[hangs])
    return dataclasses.replace(hand, name="other", origin=origin)


def named(hand: HandModel, names: list[str]) -> HandModel:
    return dataclasses.replace(hand, joint_names=tuple(names))


def test_another_base_is_found_another_hand_is_refused() -> None:
    found = match_hands(HAND, other_base(HAND))
    # Double precision, and a least-squares fit that ends at steps of 1e-15.
    assert found.base[:3] == pytest.approx(BASE[:3], abs=1e-8)
    assert abs(float(found.base[3:] @ BASE[3:])) == pytest.approx(1.0, abs=1e-12)
    assert found.fingertips_m < 1e-8
    axis = HAND.axis.copy()
    bend = HAND.joint_body[HAND.joint_names.index("MFJ3")]
    axis[bend] *= -1
    with pytest.raises(InputError, match=r"fingertip 'MF_distal' is up to \d+\.\d+ mm .* 1 mm are allowed") as error:
        match_hands(HAND, dataclasses.replace(HAND, name="mirrored", axis=axis))
    assert "\n" not in str(error.value)


def test_neither_order_nor_case_nor_prefix_of_names_counts() -> None:
    other = named(HAND, [f"robot0:{name.lower()}" for name in HAND.joint_names])
    assert match_hands(HAND, other).joints.tolist() == list(range(len(HAND.joint_names)))
    order = np.arange(len(HAND.joint_names))[::-1]
    names, body = [HAND.joint_names[k] for k in order], HAND.joint_body[order]
    other = dataclasses.replace(named(HAND, names), joint_body=body)
    assert match_hands(HAND, other).joints.tolist() == order.tolist()


def test_a_joint_of_another_name_is_named_and_can_be_said() -> None:
    names = ["bend" if name == "FFJ3" else name for name in HAND.joint_names]
    with pytest.raises(InputError, match=r"shadow has FFJ3; shadow has bend; .*--joint-map OURS=THEIRS"):
        match_hands(HAND, named(HAND, names))
    assert match_hands(HAND, named(HAND, names), {"FFJ3": "bend"}).fingertips_m < 1e-8
    with pytest.raises(InputError, match="joint 'curl', which shadow does not have"):
        match_hands(HAND, named(HAND, names), {"FFJ3": "curl"})


def test_a_urdf_and_the_mjcf_that_is_written_of_it_are_one_hand(tmp_path) -> None:
    back = hand_from_path(tmp_path / write_hand(HAND, "shadow", tmp_path))
    # Twelve digits are written.
    assert match_hands(HAND, back).fingertips_m < 1e-9
    assert {t.coefficients for t in back.tendons} == {(1.0, 1.0)} and len(back.tendons) == 4
    for ours, theirs in zip(HAND.tendons, back.tendons, strict=True):
        assert theirs.gain(back.stiffness) == pytest.approx(ours.gain(HAND.stiffness))
        assert theirs.limit(back.effort) == pytest.approx(ours.limit(HAND.effort))
