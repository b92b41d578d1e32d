"""From URDF joints to bodies: merging, mimics, couplings, dropped links."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from graspd.service.model.errors import HandError
from graspd.service.model.transforms import IDENTITY_POSE
from graspd.worker.hands.kinematics import body_poses
from tests.worker.hands.urdfs import chain, joint, link, load, robot

THREE = (joint("j1", "palm", "a"), joint("j2", "a", "b"), joint("j3", "b", "c"))


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
    hand = load(
        chain(joint("j1", "palm", "a"), joint("j2", "a", "b", extra=follow_1), joint("j3", "b", "c", extra=follow_2))
    )
    assert hand.dof_names == ("j1",)
    # q2 = 0.8 q1 + 0.1 and q3 = 0.5 q2 - 0.05 = 0.4 q1.
    np.testing.assert_allclose(hand.expand(np.array([1.0])), [1.0, 0.9, 0.4], atol=1e-12)


def test_expand_and_reduce_are_inverse() -> None:
    hand = load(chain(*THREE), couplings={"j3": {"of": "j2", "multiplier": -0.5, "offset": 0.2}})
    q = np.array([[0.3, 0.4], [1.0, 0.1]])
    np.testing.assert_allclose(hand.reduce(hand.expand(q)), q, atol=1e-12)


def test_couplings_bound_what_they_follow_and_must_leave_it_room() -> None:
    hand = load(chain(*THREE), couplings={"j3": {"of": "j2", "multiplier": 3.0}})
    assert hand.upper[hand.dof_names.index("j2")] == pytest.approx(0.5)
    with pytest.raises(HandError, match="no room"):
        load(chain(*THREE), couplings={"j3": {"of": "j2", "multiplier": 1.0, "offset": 5.0}})


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
        ({"approach": [0, 0, 0]}, "zero"),
        ({"fix": {"j1": 0.0, "j2": 0.0, "j3": 0.0}}, "no moving joint"),
    ],
)
def test_an_option_that_cannot_be_is_named(options: dict[str, Any], named: str) -> None:
    with pytest.raises(HandError, match=named):
        load(chain(*THREE), **options)


def test_an_effort_is_assumed_only_where_the_urdf_gives_none() -> None:
    joints = [
        joint(f"j{i}", p, c, limit=f'<limit lower="0" upper="1" {said} velocity="1"/>')
        for i, (p, c, said) in enumerate(
            [("palm", "a", 'effort="0"'), ("a", "b", ""), ("b", "c", 'effort="5.0"'), ("c", "d", 'effort="100"')]
        )
    ]
    np.testing.assert_allclose(load(chain(*joints, links="abcd")).effort, [0.7, 0.7, 5.0, 100.0])


def test_a_continuous_joint_turns_and_a_prismatic_one_slides() -> None:
    hand = load(chain(joint("j1", "palm", "a", kind="continuous", limit="<limit effort='1' velocity='1'/>"), links="a"))
    np.testing.assert_allclose([hand.lower[0], hand.upper[0]], [-np.pi, np.pi])
    hand = load(robot(link("palm"), link("a"), joint("j1", "palm", "a", kind="prismatic")))
    pose = body_poses(hand, IDENTITY_POSE, np.array([0.3]))[0, 1]
    np.testing.assert_allclose(pose[:3], [0, 0.3, 0.04], atol=1e-12)
