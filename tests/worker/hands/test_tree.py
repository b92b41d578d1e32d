"""From URDF joints to bodies; where a hand begins; the reference hands, their quirks, and two models of one hand."""

import dataclasses
import functools
import json
import math
from pathlib import Path

import numpy as np
import pytest
import yourdfpy

from benchmarks.hand_matching import match_hands
from graspd.exchange.bench_hand import write_hand
from graspd.service.model.errors import HandError, InputError
from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import IDENTITY_POSE, apply, compose, invert, pose_to_matrix, quat_from_axis_angle
from graspd.service.store.assets import builtin_asset, builtin_names
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.collisions import touching_bodies
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import files_from_path, hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.mounting import wrist_positions
from graspd.worker.hands.surface import piece_distance
from tests.worker.hands.urdfs import chain, joint, limits, link, load, report, robot

THREE = (joint("j1", "palm", "a"), joint("j2", "a", "b"), joint("j3", "b", "c"))
_BOX = '<collision><geometry><box size="{} {} {}"/></geometry></collision>'
FOREARM = '<collision><origin xyz="0.01 0 0.1"/>' + _BOX.format(0.05, 0.06, 0.2)[11:]


def test_a_fixed_joint_merges_its_links_into_one_body() -> None:
    hand = load(chain(joint("j1", "palm", "a"), joint("j2", "a", "b", kind="fixed"), joint("j3", "b", "c")))
    assert hand.body_names == ("palm", "a", "c")
    whole = load(chain(*THREE)).neighbours
    assert {(0, 1), (1, 2), (2, 3), (0, 2), (1, 3)} <= whole and (0, 3) not in whole, "parents and grandparents"
    assert [piece.body for piece in hand.pieces if piece.link == "b"] == [1]
    # Link b sits 40 mm up on a, and so does the frame of joint j3, another 40 mm up.
    np.testing.assert_allclose(hand.origin[2, :3], [0, 0, 0.08], atol=1e-12)


def test_a_chain_of_mimics_resolves_with_its_offsets() -> None:
    follow_1 = '<mimic joint="j1" multiplier="0.8" offset="0.1"/>'
    follow_2 = '<mimic joint="j2" multiplier="0.5" offset="-0.05"/>'
    followers = joint("j2", "a", "b", extra=follow_1), joint("j3", "b", "c", extra=follow_2)
    hand = load(chain(joint("j1", "palm", "a"), *followers))
    assert hand.dof_names == ("j1",)
    # q2 = 0.8 q1 + 0.1 and q3 = 0.5 q2 - 0.05 = 0.4 q1.
    np.testing.assert_allclose(hand.expand(np.array([1.0])), [1.0, 0.9, 0.4], atol=1e-12)


def test_expand_and_reduce_are_inverse() -> None:
    hand = load(chain(*THREE), couplings={"j3": {"of": "j2", "multiplier": -0.5, "offset": 0.2}})
    q = np.array([[0.3, 0.4], [1.0, 0.1]])
    np.testing.assert_allclose(hand.reduce(hand.expand(q)), q, atol=1e-12)


def test_couplings_bound_what_they_follow() -> None:
    hand = load(chain(*THREE), couplings={"j3": {"of": "j2", "multiplier": 3.0}})
    assert hand.upper[hand.dof_names.index("j2")] == pytest.approx(0.5)


def test_a_frozen_joint_keeps_its_value_and_freezes_what_follows() -> None:
    frozen = load(chain(*THREE), fix={"j2": 0.7})
    free = load(chain(*THREE))
    assert frozen.joint_names == ("j1", "j3")
    tip = body_poses(free, IDENTITY_POSE, np.array([0.2, 0.7, 0.4]))[0, -1]
    np.testing.assert_allclose(body_poses(frozen, IDENTITY_POSE, np.array([0.2, 0.4]))[0, -1], tip, atol=1e-12)
    hand = load(chain(*THREE), fix={"j1": 0.5}, couplings={"j2": {"of": "j1", "multiplier": 2.0}})
    assert hand.joint_names == ("j3",)


def test_roots_and_dropped_links_take_what_hangs_on_them() -> None:
    hand = load(chain(*THREE), root="a")
    assert hand.root_link == "a" and hand.joint_names == ("j2", "j3")
    assert {piece.link for piece in hand.pieces} == {"a", "b", "c"}
    hand = load(chain(*THREE), drop=["c"])
    assert hand.joint_names == ("j1", "j2")
    assert load(chain(*THREE), drop=["palm"]).root_link == "a"
    with pytest.raises(HandError, match="--fix j2=0"):
        load(chain(*THREE), root="a", couplings={"j2": {"of": "j1"}})


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"drop": ["nowhere"]}, "nowhere"),
        ({"preshape": {"j1": 9.0}}, "limits"),
        ({"stifness": 3.0}, "stifness"),  # codespell:ignore stifness
        ({"stiffness": -1.0}, "stiffness"),
        ({"effort": 0.0}, "effort"),
        ({"couplings": {"j1": {"of": "j2"}, "j2": {"of": "j1"}}}, "joint 'j1' mimics itself through 'j2'; free one"),
        ({"approach": [0, 0, 0]}, "zero"),
        ({"fix": {"j1": 0.0, "j2": 0.0, "j3": 0.0}}, "no moving joint"),
    ],
)
def test_an_option_that_cannot_be_is_named(options: dict, named: str) -> None:
    with pytest.raises(HandError, match=named):
        load(chain(*THREE), **options)


def test_an_effort_is_assumed_only_where_the_urdf_gives_none() -> None:
    links = ("palm", "a", 'effort="0"'), ("a", "b", ""), ("b", "c", 'effort="5.0"'), ("c", "d", 'effort="100"')
    limit = '<limit lower="0" upper="1" {} velocity="1"/>'
    joints = [joint(f"j{child}", parent, child, limit=limit.format(said)) for parent, child, said in links]
    np.testing.assert_allclose(load(chain(*joints, links="abcd")).effort, [0.7, 0.7, 5.0, 100.0])


def test_a_continuous_joint_turns_and_a_prismatic_one_slides() -> None:
    hand = load(chain(joint("j1", "palm", "a", kind="continuous", limit="<limit effort='1' velocity='1'/>"), links="a"))
    np.testing.assert_allclose([hand.lower[0], hand.upper[0]], [-np.pi, np.pi])
    hand = load(robot(link("palm"), link("a"), joint("j1", "palm", "a", kind="prismatic")))
    pose = body_poses(hand, IDENTITY_POSE, np.array([0.3]))[0, 1]
    np.testing.assert_allclose(pose[:3], [0, 0.3, 0.04], atol=1e-12)


def bone(name: str, length: float) -> str:
    return link(name, f'<collision><origin xyz="0 0 {length / 2}"/>' + _BOX.format(0.02, 0.02, length)[11:])


def limb(name: str, parent: str, lengths: tuple[float, ...], at: str = "0 0 0.3") -> list[str]:
    """A chain of bones, each on a joint."""
    parts = []
    for number, length in enumerate(lengths):
        child = f"{name}{number}"
        parts += [bone(child, length), joint(f"{child}_joint", parent, child, origin=at)]
        parent, at = child, f"0 0 {length}"
    return parts


def gripper(palm: str, parent: str, at: str = "0 0 0.3") -> list[str]:
    """A palm that is fixed to a link, and two fingers that bend towards each other."""
    return [
        link(palm, _BOX.format(0.08, 0.04, 0.02)),
        joint(f"{palm}_mount", parent, palm, kind="fixed", origin=at),
        bone(f"{palm}_a", 0.06),
        joint(f"{palm}_a_joint", palm, f"{palm}_a", origin="0.03 0 0.01", axis="0 -1 0"),
        bone(f"{palm}_b", 0.06),
        joint(f"{palm}_b_joint", palm, f"{palm}_b", origin="-0.03 0 0.01", axis="0 1 0"),
    ]


def humanoid(*hands: str) -> bytes:
    parts = [link("pelvis", _BOX.format(0.2, 0.2, 0.3))]
    for side in ("left", "right"):
        parts += limb(f"{side}_leg", "pelvis", (0.4, 0.4), "0 0.1 -0.3")
        parts += limb(f"{side}_arm", "pelvis", (0.3, 0.3))
    for side in hands:
        parts += gripper(f"{side}_hand_palm", f"{side}_arm1")
    return robot(*parts)


def test_a_humanoid_is_told_its_hands() -> None:
    message = report(humanoid("left", "right"))["message"]
    assert "--root left_hand_palm" in message and "--root right_hand_palm" in message and "\n" not in message
    assert report(humanoid("left", "right"), root="right_hand_palm")["verdict"] == "accept"


def test_one_hand_of_a_robot_begins_behind_its_arm_which_is_kept() -> None:
    hand = load(humanoid("right"))
    assert hand.root_link == "right_hand_palm" and hand.dofs == 2
    assert [j.name for j in hand.arm] == ["right_arm0_joint", "right_arm1_joint", "right_hand_palm_mount"]
    said = report(humanoid("right"))["message"]
    assert "right_arm0_joint, right_arm1_joint above the palm left out" in said
    urdf = robot(link("base"), *limb("arm", "base", (0.3, 0.3, 0.1)), *gripper("palm", "arm2", "0 0 0.1"))
    hand = load(urdf)
    assert hand.root_link == "arm2" and hand.dofs == 2 and len(hand.arm) == 3


@pytest.mark.parametrize("urdf", [humanoid(), robot(link("base"), *limb("arm", "base", (0.3, 0.3, 0.1)))])
def test_a_robot_without_a_hand_is_refused_with_the_mend(urdf: bytes) -> None:
    with pytest.raises(HandError, match="--root LINK"):
        load(urdf)


def test_fingers_without_shapes_are_named_prefixes_passed_over() -> None:
    parts = [link("palm", _BOX.format(0.08, 0.04, 0.02)), link("a", ""), link("b", "")]
    parts += [joint("ja", "palm", "a"), joint("jb", "palm", "b")]
    assert "a, b have no collision shapes" in report(robot(*parts))["message"]
    urdf = humanoid("right").replace(b"</robot>", b'<drake:filter name="x"><drake:member/></drake:filter></robot>')
    assert report(urdf)["verdict"] == "accept"


def with_wrist(forearm: str = FOREARM, yaw: str = limits(-0.5, 0.2)) -> bytes:
    """world - arm - forearm - wrist - palm, a camera on the forearm."""
    return robot(
        link("world"),
        link("arm", _BOX.format(0.1, 0.1, 0.1)),
        link("forearm", forearm),
        link("wrist", _BOX.format(0.02, 0.02, 0.02)),
        link("camera", _BOX.format(0.01, 0.02, 0.01)),
        joint("base", "world", "arm", kind="fixed"),
        joint("elbow", "arm", "forearm", origin="0.1 0 0.3"),
        joint("lens", "forearm", "camera", kind="fixed", origin="0.05 0 0.1"),
        joint("yaw", "forearm", "wrist", origin="0.01 0.02 0.22", axis="1 0 0", limit=yaw),
        joint("pitch", "wrist", "hub", origin="0 0 0.03", axis="0 1 0", limit=limits(-0.7, 0.4)),
        link("hub", ""),
        *gripper("palm", "hub", "0 0 0.02"),
    )


def links_of(hand: HandModel) -> set[str]:
    return set() if hand.mounting is None else {piece.link for piece in hand.mounting.pieces}


def test_the_mounting_reaches_up_the_wrist_from_rest_to_limits() -> None:
    hand = load(with_wrist())
    assert hand.root_link == "hub" and hand.mounting is not None
    assert links_of(hand) == {"wrist", "forearm", "camera"}
    assert hand.mounting.joint_names == ("pitch", "yaw")
    assert hand.mounting.lower.tolist() == [-0.7, -0.5] and hand.mounting.upper.tolist() == [0.4, 0.2]
    mounting = hand.mounting
    found = wrist_positions(mounting)
    assert found[0].tolist() == [0.0, 0.0] and len(found) == 25
    assert (np.diff(np.linalg.norm(found, axis=1)) >= -1e-12).all()
    assert (found.min(axis=0) == mounting.lower).all() and (found.max(axis=0) == mounting.upper).all()
    assert np.linalg.norm(found, axis=1).max() < math.pi


def test_the_mounting_stands_where_the_robot_has_it() -> None:
    hand, whole = load(with_wrist()), load(with_wrist(), root="forearm")
    pitch, yaw = 0.3, -0.4
    q = np.array([{"pitch": pitch, "yaw": yaw}.get(name, 0.0) for name in whole.dof_names])
    at = body_poses(whole, IDENTITY_POSE, whole.expand(q))[0]
    to_root = invert(at[whole.body_names.index("hub")])
    mine = body_poses(hand.mounting, IDENTITY_POSE, np.array([pitch, yaw]))[0]
    for piece in hand.mounting.pieces:
        (twin,) = (p for p in whole.pieces if p.link == piece.link)
        expected = apply(to_root, apply(at[twin.body], twin.vertices))
        assert apply(mine[piece.body], piece.vertices) == pytest.approx(expected, abs=1e-12)


def test_joints_that_turn_as_arms_or_stand_far_off_are_no_wrist() -> None:
    assert links_of(load(with_wrist(yaw=limits(-2.9, 2.9)))) == {"wrist"}
    mounting = load(humanoid("right")).mounting
    assert mounting is not None and {piece.link for piece in mounting.pieces} == {"right_arm1"}
    assert wrist_positions(mounting).shape == (1, 0)
    assert load(robot(*gripper("palm", "base", "0 0 0"), link("base", ""))).mounting is None


def test_a_stated_angle_holds_a_wrist_and_a_dropped_link_ends_it() -> None:
    fixed = load(with_wrist(), root="hub", fix={"pitch": 0.25}).mounting
    assert fixed is not None and fixed.joint_names == ("yaw",)
    free = load(with_wrist()).mounting
    still, moved = body_poses(fixed, IDENTITY_POSE, [0.1])[0], body_poses(free, IDENTITY_POSE, [0.25, 0.1])[0]
    pairs = (fixed, still), (free, moved)
    ours, theirs = ({p.link: apply(at[p.body], p.vertices) for p in model.pieces} for model, at in pairs)
    assert ours.keys() == theirs.keys() and all(ours[name] == pytest.approx(theirs[name]) for name in ours)
    assert links_of(load(with_wrist(), root="hub", drop=["forearm"])) == {"wrist"}


def test_bad_shapes_above_a_hand_are_told_and_do_not_refuse_it() -> None:
    lost = with_wrist(forearm='<collision><geometry><mesh filename="lost.stl"/></geometry></collision>')
    hand = load(lost)
    assert hand.mounting is None and hand.dofs == 2
    report = check_hand({"r.urdf": lost}, "r")
    (note,) = (note for note in report["facts"]["notes"] if "no obstacles in scenes" in note)
    assert "links above 'hub'" in note and "lost.stl" in note
    assert report["verdict"] == "accept" and note in report["message"]
    assert "no obstacles in scenes" not in check_hand({"r.urdf": with_wrist()}, "r")["message"]


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
SHADOW = hand_from_path("shadow")
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
        for body, child in enumerate(hand.body_names):
            expected = oracle.get_transform(child, hand.root_link)
            np.testing.assert_allclose(poses[body], expected, atol=FRAME_TOLERANCE, err_msg=child)


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
    for name in hand.joint_names:
        difference = compose(invert(real[theirs(name)]), mine[name])
        assert np.linalg.norm(difference[:3]) < 2 * tolerance, name
        # Fixed angles are given as -0.785398 and the like.
        assert abs(difference[3]) == pytest.approx(1, abs=1e-9), name


def named(hand: HandModel, names: list[str]) -> HandModel:
    return dataclasses.replace(hand, joint_names=tuple(names))


def test_another_base_is_found_another_hand_is_refused() -> None:
    origin, hangs = SHADOW.origin.copy(), np.flatnonzero(SHADOW.parent == 0)
    origin[hangs] = compose(invert(BASE), origin[hangs])
    found = match_hands(SHADOW, dataclasses.replace(SHADOW, name="other", origin=origin))
    # Double precision, and a least-squares fit that ends at steps of 1e-15.
    assert found.base[:3] == pytest.approx(BASE[:3], abs=1e-8)
    assert abs(float(found.base[3:] @ BASE[3:])) == pytest.approx(1.0, abs=1e-12)
    assert found.fingertips_m < 1e-8
    axis = SHADOW.axis.copy()
    bend = SHADOW.joint_body[SHADOW.joint_names.index("MFJ3")]
    axis[bend] *= -1
    with pytest.raises(InputError, match=r"fingertip 'MF_distal' is up to \d+\.\d+ mm .* 1 mm are allowed") as error:
        match_hands(SHADOW, dataclasses.replace(SHADOW, name="mirrored", axis=axis))
    assert "\n" not in str(error.value)


def test_neither_order_nor_case_nor_prefix_of_names_counts() -> None:
    other = named(SHADOW, [f"robot0:{name.lower()}" for name in SHADOW.joint_names])
    assert match_hands(SHADOW, other).joints.tolist() == list(range(len(SHADOW.joint_names)))
    order = np.arange(len(SHADOW.joint_names))[::-1]
    names, body = [SHADOW.joint_names[k] for k in order], SHADOW.joint_body[order]
    other = dataclasses.replace(named(SHADOW, names), joint_body=body)
    assert match_hands(SHADOW, other).joints.tolist() == order.tolist()


def test_a_joint_of_another_name_is_named_and_can_be_said() -> None:
    names = ["bend" if name == "FFJ3" else name for name in SHADOW.joint_names]
    with pytest.raises(InputError, match=r"shadow has FFJ3; shadow has bend; .*--joint-map OURS=THEIRS"):
        match_hands(SHADOW, named(SHADOW, names))
    assert match_hands(SHADOW, named(SHADOW, names), {"FFJ3": "bend"}).fingertips_m < 1e-8
    with pytest.raises(InputError, match="joint 'curl', which shadow does not have"):
        match_hands(SHADOW, named(SHADOW, names), {"FFJ3": "curl"})


def test_a_urdf_and_the_mjcf_that_is_written_of_it_are_one_hand(tmp_path) -> None:
    back = hand_from_path(tmp_path / write_hand(SHADOW, "shadow", tmp_path))
    # Twelve digits are written.
    assert match_hands(SHADOW, back).fingertips_m < 1e-9
    assert {t.coefficients for t in back.tendons} == {(1.0, 1.0)} and len(back.tendons) == 4
    for ours, theirs in zip(SHADOW.tendons, back.tendons, strict=True):
        assert theirs.gain(back.stiffness) == pytest.approx(ours.gain(SHADOW.stiffness))
        assert theirs.limit(back.effort) == pytest.approx(ours.limit(SHADOW.effort))
