"""The links above a hand's root: which of them count, and where they stand as the wrist turns."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from graspd.service.model.transforms import IDENTITY_POSE, apply, invert
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.mounting import wrist_positions
from tests.worker.hands.test_roots import BOX, gripper, humanoid
from tests.worker.hands.urdfs import joint, link, robot

FOREARM = '<collision><origin xyz="0.01 0 0.1"/>' + BOX.format(0.05, 0.06, 0.2)[11:]


def limits(lower: float, upper: float) -> str:
    return f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="2"/>'


def with_wrist(forearm: str = FOREARM, yaw: str = limits(-0.5, 0.2)) -> bytes:
    """world - arm - forearm - wrist - palm, a camera on the forearm."""
    return robot(
        link("world"),
        link("arm", BOX.format(0.1, 0.1, 0.1)),
        link("forearm", forearm),
        link("wrist", BOX.format(0.02, 0.02, 0.02)),
        link("camera", BOX.format(0.01, 0.02, 0.01)),
        joint("base", "world", "arm", kind="fixed"),
        joint("elbow", "arm", "forearm", origin="0.1 0 0.3"),
        joint("lens", "forearm", "camera", kind="fixed", origin="0.05 0 0.1"),
        joint("yaw", "forearm", "wrist", origin="0.01 0.02 0.22", axis="1 0 0", limit=yaw),
        joint("pitch", "wrist", "hub", origin="0 0 0.03", axis="0 1 0", limit=limits(-0.7, 0.4)),
        link("hub", ""),
        *gripper("palm", "hub", "0 0 0.02"),
    )


def loaded(urdf: bytes, **options: Any) -> HandModel:
    return load_hand({"r.urdf": urdf}, name="r", digest="0" * 32, options=options)


def links_of(hand: HandModel) -> set[str]:
    return set() if hand.mounting is None else {piece.link for piece in hand.mounting.pieces}


def test_the_mounting_reaches_up_the_wrist_to_the_arm() -> None:
    hand = loaded(with_wrist())
    assert hand.root_link == "hub" and hand.mounting is not None
    assert links_of(hand) == {"wrist", "forearm", "camera"}
    assert hand.mounting.joint_names == ("pitch", "yaw")
    assert hand.mounting.lower.tolist() == [-0.7, -0.5] and hand.mounting.upper.tolist() == [0.4, 0.2]


@pytest.mark.parametrize("pitch, yaw", [(0.0, 0.0), (0.3, -0.4)])
def test_the_mounting_stands_where_the_robot_has_it(pitch: float, yaw: float) -> None:
    hand, whole = loaded(with_wrist()), loaded(with_wrist(), root="forearm")
    assert hand.mounting is not None
    at = body_poses(whole, IDENTITY_POSE, whole.expand(_q(whole, pitch=pitch, yaw=yaw)))[0]
    to_root = invert(at[whole.body_names.index("hub")])
    mine = body_poses(hand.mounting, IDENTITY_POSE, np.array([pitch, yaw]))[0]
    for piece in hand.mounting.pieces:
        (twin,) = (p for p in whole.pieces if p.link == piece.link)
        expected = apply(to_root, apply(at[twin.body], twin.vertices))
        assert apply(mine[piece.body], piece.vertices) == pytest.approx(expected, abs=1e-12)


def _q(hand: HandModel, **values: float) -> np.ndarray:
    return np.array([values.get(name, 0.0) for name in hand.dof_names])


def test_a_joint_that_turns_as_an_arms_is_no_wrist() -> None:
    assert links_of(loaded(with_wrist(yaw=limits(-2.9, 2.9)))) == {"wrist"}


def test_a_joint_far_from_the_root_is_no_wrist() -> None:
    mounting = loaded(humanoid("right")).mounting
    assert mounting is not None and {piece.link for piece in mounting.pieces} == {"right_arm1"}
    assert wrist_positions(mounting).shape == (1, 0)


def test_a_stated_angle_holds_a_wrist_and_a_dropped_link_ends_it() -> None:
    fixed = loaded(with_wrist(), root="hub", fix={"pitch": 0.25}).mounting
    assert fixed is not None and fixed.joint_names == ("yaw",)
    free = loaded(with_wrist()).mounting
    assert free is not None
    still, moved = body_poses(fixed, IDENTITY_POSE, [0.1])[0], body_poses(free, IDENTITY_POSE, [0.25, 0.1])[0]
    ours, theirs = (
        {p.link: apply(at[p.body], p.vertices) for p in m.pieces} for m, at in ((fixed, still), (free, moved))
    )
    assert ours.keys() == theirs.keys() and all(ours[name] == pytest.approx(theirs[name]) for name in ours)
    assert links_of(loaded(with_wrist(), root="hub", drop=["forearm"])) == {"wrist"}


def test_what_is_wrong_with_shapes_above_a_hand_is_told_and_does_not_refuse_it() -> None:
    lost = with_wrist(forearm='<collision><geometry><mesh filename="lost.stl"/></geometry></collision>')
    hand = loaded(lost)
    assert hand.mounting is None and hand.dofs == 2
    report = check_hand({"r.urdf": lost}, "r")
    (note,) = (note for note in report["facts"]["notes"] if "no obstacle in scenes" in note)
    assert "what stands above 'hub'" in note and "lost.stl" in note
    assert report["verdict"] == "accept" and note in report["message"]
    assert "no obstacle in scenes" not in check_hand({"r.urdf": with_wrist()}, "r")["message"]


def test_a_hand_without_links_above_its_root_has_no_mounting() -> None:
    assert loaded(robot(*gripper("palm", "base", "0 0 0"), link("base", ""))).mounting is None


def test_wrist_positions_begin_at_rest_and_keep_the_limits() -> None:
    mounting = loaded(with_wrist()).mounting
    assert mounting is not None
    found = wrist_positions(mounting)
    assert found[0].tolist() == [0.0, 0.0] and len(found) == 25
    assert (np.diff(np.linalg.norm(found, axis=1)) >= -1e-12).all()
    assert (found.min(axis=0) == mounting.lower).all() and (found.max(axis=0) == mounting.upper).all()
    assert np.linalg.norm(found, axis=1).max() < math.pi
