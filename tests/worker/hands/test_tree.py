"""From URDF joints to bodies: merging, mimics, couplings; where a hand begins, behind its arm or in a whole robot."""

import math

import numpy as np
import pytest

from graspd.service.model.errors import HandError
from graspd.service.model.transforms import IDENTITY_POSE, apply, invert
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.mounting import wrist_positions
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
