"""Where a hand begins: behind its arm; a whole robot is told its hands, and what cannot hold anything is refused."""

from __future__ import annotations

import pytest

from graspd.service.model.errors import HandError
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import load_hand
from tests.worker.hands.urdfs import joint, link, robot

BOX = '<collision><geometry><box size="{} {} {}"/></geometry></collision>'


def bone(name: str, length: float) -> str:
    return link(name, f'<collision><origin xyz="0 0 {length / 2}"/>' + BOX.format(0.02, 0.02, length)[11:])


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
        link(palm, BOX.format(0.08, 0.04, 0.02)),
        joint(f"{palm}_mount", parent, palm, kind="fixed", origin=at),
        bone(f"{palm}_a", 0.06),
        joint(f"{palm}_a_joint", palm, f"{palm}_a", origin="0.03 0 0.01", axis="0 -1 0"),
        bone(f"{palm}_b", 0.06),
        joint(f"{palm}_b_joint", palm, f"{palm}_b", origin="-0.03 0 0.01", axis="0 1 0"),
    ]


def humanoid(*hands: str) -> bytes:
    parts = [link("pelvis", BOX.format(0.2, 0.2, 0.3))]
    for side in ("left", "right"):
        parts += limb(f"{side}_leg", "pelvis", (0.4, 0.4), "0 0.1 -0.3")
        parts += limb(f"{side}_arm", "pelvis", (0.3, 0.3))
    for side in hands:
        parts += gripper(f"{side}_hand_palm", f"{side}_arm1")
    return robot(*parts)


def report(urdf: bytes, **options: object) -> dict:
    return check_hand({"r.urdf": urdf}, "r", options)


def test_a_humanoid_is_told_its_hands() -> None:
    message = report(humanoid("left", "right"))["message"]
    assert "--root left_hand_palm" in message and "--root right_hand_palm" in message and "\n" not in message
    assert report(humanoid("left", "right"), root="right_hand_palm")["verdict"] == "accept"


def test_the_one_hand_of_a_robot_is_found_and_its_arm_is_kept() -> None:
    hand = load_hand({"r.urdf": humanoid("right")}, name="r", digest="0" * 32)
    assert hand.root_link == "right_hand_palm" and hand.dofs == 2
    assert [j.name for j in hand.arm] == ["right_arm0_joint", "right_arm1_joint", "right_hand_palm_mount"]
    said = report(humanoid("right"))["message"]
    assert "right_arm0_joint, right_arm1_joint above the palm left out" in said


def test_a_gripper_on_an_arm_begins_behind_its_last_joint() -> None:
    urdf = robot(link("base"), *limb("arm", "base", (0.3, 0.3, 0.1)), *gripper("palm", "arm2", "0 0 0.1"))
    hand = load_hand({"r.urdf": urdf}, name="r", digest="0" * 32)
    assert hand.root_link == "arm2" and hand.dofs == 2 and len(hand.arm) == 3


def test_an_arm_whose_fingers_are_fixed_is_told_which() -> None:
    urdf = robot(link("base"), *limb("arm", "base", (0.3, 0.3, 0.1)), *gripper("palm", "arm2", "0 0 0.1"))
    message = report(urdf, fix={"palm_a_joint": 0.0, "palm_b_joint": 0.0})["message"]
    assert "palm_a_joint, palm_b_joint are fixed joints" in message and "\n" not in message


@pytest.mark.parametrize("hands", [(), ("neither",)])
def test_a_robot_without_a_hand_is_refused_with_the_mend(hands: tuple[str, ...]) -> None:
    urdf = humanoid() if not hands else robot(link("base"), *limb("arm", "base", (0.3, 0.3, 0.1)))
    with pytest.raises(HandError, match="--root LINK"):
        load_hand({"r.urdf": urdf}, name="r", digest="0" * 32)


def test_a_gripper_without_opposing_digits_is_refused() -> None:
    # Both balls turn about their own centres: nothing comes closer to anything.
    ball = '<collision><geometry><sphere radius="{}"/></geometry></collision>'
    parts = [link("palm", ball.format(0.01))]
    for name, x in (("a", 0.03), ("b", -0.03)):
        parts += [
            link(name, ball.format(0.0005)),
            joint(f"{name}_joint", "palm", name, origin=f"{x} 0 0.05", axis="0 0 1"),
        ]
    found = report(robot(*parts))
    assert found["verdict"] == "refuse" and "no two opposing digits" in found["message"]


def test_fingers_without_shapes_are_named() -> None:
    parts = [link("palm", BOX.format(0.08, 0.04, 0.02)), link("a", ""), link("b", "")]
    parts += [joint("ja", "palm", "a"), joint("jb", "palm", "b")]
    assert "a, b have no collision shapes" in report(robot(*parts))["message"]


def test_prefixes_that_nobody_declared_are_passed_over() -> None:
    urdf = humanoid("right").replace(b"</robot>", b'<drake:filter name="x"><drake:member/></drake:filter></robot>')
    assert report(urdf)["verdict"] == "accept"
