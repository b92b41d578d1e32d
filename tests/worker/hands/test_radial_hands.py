"""Hands whose fingers stand around an axis take hold along it, whatever rounding does to them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import Floats, quat_from_axis_angle, quat_multiply, quat_rotate
from graspd.service.store.asset_summary import summary
from graspd.service.store.assets import builtin_files
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.jaws import fingertip_pad, sign_of
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel
from tests.worker.hands.urdfs import joint, link, robot

RADIUS = 0.045
_PLATE = '<geometry><box size="0.16 0.1 0.02"/></geometry>'


def rpy(matrix: Floats) -> str:
    pitch = np.arcsin(-np.clip(matrix[2, 0], -1, 1))
    return f"{np.arctan2(matrix[2, 1], matrix[2, 2]):.17g} {pitch:.17g} {np.arctan2(matrix[1, 0], matrix[0, 0]):.17g}"


def claw(fingers: int, turn: Floats, *, noise: float = 0.0, lower: float = -0.4) -> bytes:
    """Fingers of two links around the z axis, bending inwards; `turn` (4,) is where the axis goes in the root frame."""
    random = np.random.default_rng(fingers)
    matrix = np.stack([quat_rotate(turn, axis) for axis in np.eye(3)], axis=1)
    place = f'<origin xyz="{_at(matrix @ [0, 0, -0.015])}" rpy="{rpy(matrix)}"/>'
    palm = f'<collision>{place}<geometry><box size="0.09 0.09 0.03"/></geometry></collision>'
    parts = [link("palm", palm)]
    for k in range(fingers):
        about = quat_from_axis_angle(np.array([0, 0, 1.0]), np.asarray(2 * np.pi * k / fingers))
        frame = np.stack([quat_rotate(quat_multiply(turn, about), axis) for axis in np.eye(3)], axis=1)
        at = frame @ (np.array([RADIUS, 0, 0]) + noise * random.normal(size=3))
        parts += [link(f"a{k}", _bar(0.06)), link(f"b{k}", _bar(0.045))]
        bend = {"axis": "0 -1 0", "limit": f'<limit lower="{lower}" upper="1.4" effort="10"/>'}
        base = joint(f"ja{k}", "palm", f"a{k}", origin=_at(at), **bend)
        parts.append(base.replace("<origin xyz", f'<origin rpy="{rpy(frame)}" xyz'))
        parts.append(
            joint(
                f"jb{k}", f"a{k}", f"b{k}", origin="0 0 0.06", extra=f'<mimic joint="ja{k}" multiplier="0.7"/>', **bend
            )
        )
    return robot(*parts)


def _at(point: Floats) -> str:
    return " ".join(f"{value:.17g}" for value in point)


def _bar(length: float) -> str:
    place = f'<origin xyz="0 0 {length / 2}"/>'
    return f'<collision>{place}<geometry><box size="0.016 0.018 {length}"/></geometry></collision>'


def hand(data: bytes) -> HandModel:
    return load_hand({"h.urdf": data}, name="h", digest="0" * 32)


TURNS = {
    "upright": np.array([1.0, 0, 0, 0]),
    "on its side": quat_from_axis_angle(np.array([1.0, 0, 0]), np.asarray(np.pi / 2)),
    "upside down": quat_from_axis_angle(np.array([0, 1.0, 0]), np.asarray(np.pi)),
    "tilted": quat_from_axis_angle(np.array([0.6, 0.8, 0]), np.asarray(0.5)),
}


@pytest.mark.parametrize("fingers", [3, 4, 5, 6])
@pytest.mark.parametrize("turn", TURNS)
def test_the_palm_faces_along_the_fingers_and_all_of_them_close(fingers: int, turn: str) -> None:
    model = hand(claw(fingers, TURNS[turn]))
    axis = quat_rotate(TURNS[turn], np.array([0, 0, 1.0]))
    # Rounding of nine digits in the file; a direction within five degrees of a root axis is that axis.
    np.testing.assert_allclose(model.palm.approach, axis, atol=1e-6)
    assert (model.closing == 1).all()
    assert np.linalg.norm(model.palm.centre - (model.palm.centre @ axis) * axis) < 1e-6


@pytest.mark.parametrize("noise", [1e-12, 1e-9, 1e-6, 1e-4])
def test_rounding_does_not_turn_the_palm(noise: float) -> None:
    model = hand(claw(3, TURNS["upright"], noise=noise))
    np.testing.assert_allclose(model.palm.approach, [0, 0, 1], atol=1e-9)


def test_a_tie_is_told_and_one_that_is_settled_is_not() -> None:
    # Fingers that lie in the plane in which they begin, half closed: nothing tells its upper side.
    flat = claw(3, TURNS["upright"], lower=-np.pi)
    told = "the palm may face either way along its axis, a tie: say which with --approach"
    lying = flat.replace(b'lower="-3.141592653589793" upper="1.4"', b'lower="1.0707963" upper="2.0707963"').replace(
        b'multiplier="0.7"', b'multiplier="0"'
    )
    facts = check_hand({"h.urdf": lying}, "h")["facts"]
    assert told in facts["notes"] and "approach (a tie)" in facts["guessed"]
    assert any("approach (a tie)" in line for line in summary(AssetKind.HAND, facts))
    assert told not in check_hand({"h.urdf": lying}, "h", {"approach": (0, 0, 1)})["facts"]["notes"]
    assert told not in check_hand({"h.urdf": claw(3, TURNS["upright"])}, "h")["facts"]["notes"]


@pytest.mark.parametrize("degrees", [7.0, 20.0, 35.0, 100.0])
def test_a_turned_root_frame_turns_the_palm_with_it(degrees: float) -> None:
    turn = quat_from_axis_angle(np.array([1.0, 2, 3]) / np.sqrt(14), np.asarray(np.deg2rad(degrees)))
    for fingers in (2, 3):
        model = hand(claw(fingers, turn))
        np.testing.assert_allclose(model.palm.approach, quat_rotate(turn, np.array([0, 0, 1.0])), atol=1e-6)


@pytest.mark.parametrize("mirrored", [False, True])
def test_two_fingers_that_oppose_one_take_hold_between_them_and_not_sideways(mirrored: bool) -> None:
    """What the tips do as such a hand closes points half to the side."""
    side = -1 if mirrored else 1
    places = ((side * 0.05, 0.0, 0.0), (-side * 0.05, 0.03, np.pi), (-side * 0.05, -0.03, np.pi))
    parts = [link("palm", f'<collision><origin xyz="{side * 0.03} 0 -0.02"/>{_PLATE}</collision>')]
    for k, (x, y, yaw) in enumerate(places):
        about = yaw if not mirrored else np.pi - yaw
        bend = {"axis": "0 -1 0", "limit": '<limit lower="0" upper="1.4" effort="10"/>'}
        base = joint(f"j{k}", "palm", f"f{k}", origin=f"{x} {y} 0", **bend)
        parts += [
            link(f"f{k}", _bar(0.05)),
            base.replace("<origin xyz", f'<origin rpy="0 0 {about}" xyz'),
            link(f"t{k}", _bar(0.04)),
            joint(f"k{k}", f"f{k}", f"t{k}", origin="0 0 0.05", **bend),
        ]
    np.testing.assert_allclose(hand(robot(*parts)).palm.approach, [0, 0, 1], atol=1e-9)


def test_a_published_hand_in_a_turned_root_frame_faces_as_it_did() -> None:
    urdf, turn = builtin_files(AssetKind.HAND, "barrett"), "0.3 -0.5 1.1"
    name = next(name for name in urdf if name.endswith(".urdf"))
    above = f'{link("world", "")}<joint name="mount" type="fixed"><parent link="world"/><child link="palm"/>'
    mounted = urdf[name].replace(b"</robot>", f'{above}<origin rpy="{turn}"/></joint></robot>'.encode())
    options = {"root": "world"}
    as_it_is = load_hand({name: urdf[name]}, name="h", digest="0" * 32)
    turned = load_hand({name: mounted}, name="h", digest="0" * 32, options=options)
    pose = turned.frames["palm"][1]
    np.testing.assert_allclose(turned.palm.approach, quat_rotate(pose[3:], as_it_is.palm.approach), atol=1e-4)
    assert turned.closing.tolist() == as_it_is.closing.tolist()


def test_limits_of_twice_as_far_one_way_close_whatever_their_last_digit_is() -> None:
    for lower in ("-0.7", "-0.7000001", "-0.6999999"):
        assert (hand(claw(3, TURNS["upright"]).replace(b'"-0.4"', f'"{lower}"'.encode())).closing == 1).all()


def test_a_tip_that_only_turns_about_itself_presses_where_the_joint_before_it_moves_it() -> None:
    roll = joint("roll{0}", "b{0}", "c{0}", origin="0 0 0.045", axis="0 0 1")
    ball = (
        '<collision><origin xyz="0 0 0.01"/><geometry><cylinder radius="0.008" length="0.02"/></geometry></collision>'
    )
    tips = "".join(link(f"c{k}", ball) + roll.format(k) for k in range(3))
    model = hand(claw(3, TURNS["upright"]).replace(b"</robot>", tips.encode() + b"</robot>"))
    still = replace(model, preshape=np.zeros(model.dofs))
    for tip in still.fingertips:
        # Inwards: -x of the finger's frame, as even as the points of its surface are.
        assert fingertip_pad(still, tip).normal[0] < -0.9


def test_the_order_of_two_jaws_is_not_that_of_rounding() -> None:
    for noise in (1e-17, -1e-17):
        line = np.array([noise, 1.0, -noise])
        assert sign_of(line) == 1 and sign_of(-line) == -1
        assert sign_of(np.array([1.0, -1.0 - noise, 0])) == 1
