"""Which way joints close a hand, where its palm faces, and corrections of both in the browser and the command line."""

import json
from dataclasses import replace

import numpy as np
import pytest

from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import Floats, quat_from_axis_angle, quat_multiply, quat_rotate
from graspd.service.store.asset_summary import summary
from graspd.service.store.descriptions import HandCorrections, apply_corrections, read_hand_facts
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.jaws import dominant_sign, fingertip_pad, pads_of
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.stages.models import hand_glb
from tests.worker.commands_run import graspd
from tests.worker.hands.urdfs import gripper, joint, limits, link, load, report, robot

_PALM = '<collision><geometry><box size="0.09 0.02 0.09"/></geometry></collision>'
_PHALANX = '<collision><origin xyz="0 0 0.02"/><geometry><box size="0.014 0.014 0.04"/></geometry></collision>'
RADIUS = 0.045
_PLATE_SHAPE = '<geometry><box size="0.16 0.1 0.02"/></geometry>'
#: Axis, and angle [rad].
TURNS = {"upright": ((1, 0, 0), 0), "on its side": ((1, 0, 0), np.pi / 2), "upside down": ((0, 1, 0), np.pi)}
TURNS |= {"tilted": ((0.6, 0.8, 0), 0.5)}
TURNS |= {f"{angle} degrees": (np.array([1, 2, 3]) / np.sqrt(14), np.deg2rad(angle)) for angle in (7, 20, 35, 100)}
TURNS = {name: quat_from_axis_angle(np.array(axis, float), np.asarray(angle)) for name, (axis, angle) in TURNS.items()}


def finger(name: str, x: float, bends: str = limits(-0.2, 1.5)) -> list[str]:
    """A finger along z that bends to +y, where the palm faces, about -x; it swings sideways about y."""
    return [
        *(link(f"{name}{k}", _PHALANX) for k in range(3)),
        joint(f"{name}_spread", "palm", f"{name}0", origin=f"{x} 0 0.045", axis="0 1 0", limit=limits(-0.1, 0.5)),
        joint(f"{name}_bend", f"{name}0", f"{name}1", origin="0 0 0.04", axis="-1 0 0", limit=bends),
        joint(f"{name}_tip", f"{name}1", f"{name}2", origin="0 0 0.04", axis="-1 0 0", limit=limits(-0.1, 1.5)),
    ]


def urdf(*thumb: str, bends: str = limits(-0.2, 1.5)) -> bytes:
    return robot(link("palm", _PALM), *finger("index", -0.025, bends), *finger("ring", 0.025), *thumb)


def opposing_thumb(bends: str) -> list[str]:
    return [
        *(link(f"thumb{k}", _PHALANX) for k in range(3)),
        joint("thumb_axial", "palm", "thumb0", origin="0 0.09 0.02", axis="0 0 1", limit=limits(-0.2, 2.0)),
        joint("thumb_bend", "thumb0", "thumb1", origin="0 0 0.04", axis="1 0 0", limit=bends),
        joint("thumb_tip", "thumb1", "thumb2", origin="0 0 0.04", axis="1 0 0", limit=bends),
    ]


def hand_of(text: bytes, **options: object) -> HandModel:
    return load(text, **{"approach": [0, 1, 0], **options})


def closing_of(hand: HandModel) -> dict[str, int]:
    return dict(zip(hand.dof_names, (int(one) for one in hand.closing), strict=True))


def test_thumbs_close_to_the_fingers_whatever_their_limits() -> None:
    text = urdf(*opposing_thumb(limits(-1.5, 0.2)))
    found = closing_of(hand_of(text))
    assert (found["thumb_bend"], found["thumb_tip"]) == (1, 1)
    stated = closing_of(hand_of(text, closing={"thumb_bend": -1}))
    assert stated == {**found, "thumb_bend": -1}, "what is stated of one joint counts for it alone"
    assert closing_of(hand_of(urdf(*opposing_thumb(limits(-1.2, 0.8)))))["thumb_bend"] == 1
    assert closing_of(hand_of(urdf(*opposing_thumb(limits(-1.2, 1.2)))))["thumb_bend"] == 0
    assert closing_of(hand_of(urdf(*opposing_thumb(limits(-0.2, 1.5)))))["thumb_axial"] == 0
    found = closing_of(hand_of(urdf(*opposing_thumb(limits(-0.2, 1.5)), bends=limits(-1.0, 1.5))))
    assert [found[f"{name}_spread"] for name in ("index", "ring")] == [0, 0]
    assert [found[f"{name}_{part}"] for name in ("index", "ring") for part in ("bend", "tip")] == [1, 1, 1, 1]


def test_a_finger_that_no_joint_closes_is_told() -> None:
    text = urdf(*opposing_thumb(limits(-0.2, 1.5)))
    closed = check_hand({"r.urdf": text}, "r", {"approach": [0, 1, 0]})
    assert "no joint closes" not in closed["message"]
    still = {"approach": [0, 1, 0], "closing": dict.fromkeys(("thumb_axial", "thumb_bend", "thumb_tip"), 0)}
    assert "no joint closes the finger of thumb2:" in check_hand({"r.urdf": text}, "r", still)["message"]


def test_a_wrist_that_stands_ahead_of_the_palm_is_not_the_palm() -> None:
    """A plate of 10 mm whose fingers bend over it, on a wrist that stands 60 mm ahead of it."""
    plate = '<collision><origin xyz="0 0 0.05"/><geometry><box size="0.01 0.08 0.1"/></geometry></collision>'
    wrist = '<collision><origin xyz="0 0 -0.03"/><geometry><box size="0.13 0.08 0.06"/></geometry></collision>'
    finger = '<collision><origin xyz="0 0 0.04"/><geometry><box size="0.01 0.01 0.08"/></geometry></collision>'
    thumb = '<collision><origin xyz="0.04 0 0"/><geometry><box size="0.08 0.01 0.01"/></geometry></collision>'
    fingers = [link(f"f{k}", finger) for k in range(3)]
    fingers += [joint(f"j{k}", "palm", f"f{k}", origin=f"0 {0.03 * (k - 1)} 0.1") for k in range(3)]
    fingers += [link("thumb", thumb), joint("t", "palm", "thumb", origin="0.005 0 0.01", axis="0 -1 0")]
    hand = load(robot(link("palm", plate + wrist), *fingers))
    assert hand.palm.approach == pytest.approx([1, 0, 0])
    assert hand.palm.centre[0] == pytest.approx(0.005) and 0.05 < hand.palm.centre[2] < 0.1


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
        follows = f'<mimic joint="ja{k}" multiplier="0.7"/>'
        parts.append(joint(f"jb{k}", f"a{k}", f"b{k}", origin="0 0 0.06", extra=follows, **bend))
    return robot(*parts)


def _at(point: Floats) -> str:
    return " ".join(f"{value:.17g}" for value in point)


def _bar(length: float) -> str:
    place = f'<origin xyz="0 0 {length / 2}"/>'
    return f'<collision>{place}<geometry><box size="0.016 0.018 {length}"/></geometry></collision>'


@pytest.mark.parametrize("fingers", [2, 3, 4, 5, 6])
@pytest.mark.parametrize("turn", TURNS)
def test_the_palm_faces_along_the_fingers_and_all_of_them_close(fingers: int, turn: str) -> None:
    model = load(claw(fingers, TURNS[turn]))
    axis = quat_rotate(TURNS[turn], np.array([0, 0, 1.0]))
    # Rounding of nine digits in the file; a direction within five degrees of a root axis is that axis.
    np.testing.assert_allclose(model.palm.approach, axis, atol=1e-6)
    assert (model.closing == 1).all()
    # Two fingers are jaws: their middle is that of sampled points of their pads.
    assert fingers == 2 or np.linalg.norm(model.palm.centre - (model.palm.centre @ axis) * axis) < 1e-6


def test_fingers_that_meet_at_zero_close_to_it_unless_stated() -> None:
    outwards = claw(3, TURNS["upright"], lower=0.0).replace(b'axis xyz="0 -1 0"', b'axis xyz="0 1 0"')
    hand = load(outwards, approach=[0, 0, 1])
    assert hand.closing.tolist() == [-1, -1, -1] and hand.preshape == pytest.approx(0.75 * hand.upper)
    assert load(outwards, approach=[0, 0, 1], closing={"ja0": 1}).closing.tolist() == [1, -1, -1]


def test_a_tie_is_told_and_one_that_is_settled_is_not() -> None:
    # Fingers that lie in the plane in which they begin, half closed: nothing tells its upper side.
    flat = claw(3, TURNS["upright"], lower=-np.pi)
    told = "the palm may face either way along its axis: state its direction with --approach"
    lying = flat.replace(b'lower="-3.141592653589793" upper="1.4"', b'lower="1.0707963" upper="2.0707963"')
    lying = lying.replace(b'multiplier="0.7"', b'multiplier="0"')
    facts = report(lying)["facts"]
    assert told in facts["notes"] and "approach (a tie)" in facts["guessed"]
    assert any("approach (a tie)" in line for line in summary(AssetKind.HAND, facts))
    assert told not in report(lying, approach=(0, 0, 1))["facts"]["notes"]
    assert told not in report(claw(3, TURNS["upright"]))["facts"]["notes"]


def test_two_fingers_that_oppose_one_take_hold_between_them() -> None:
    parts = [link("palm", f'<collision><origin xyz="0.03 0 -0.02"/>{_PLATE_SHAPE}</collision>')]
    for k, (x, y, yaw) in enumerate(((0.05, 0.0, 0.0), (-0.05, 0.03, np.pi), (-0.05, -0.03, np.pi))):
        bend = {"axis": "0 -1 0", "limit": '<limit lower="0" upper="1.4" effort="10"/>'}
        base = joint(f"j{k}", "palm", f"f{k}", origin=f"{x} {y} 0", **bend)
        parts += [
            link(f"f{k}", _bar(0.05)),
            base.replace("<origin xyz", f'<origin rpy="0 0 {yaw}" xyz'),
            link(f"t{k}", _bar(0.04)),
            joint(f"k{k}", f"f{k}", f"t{k}", origin="0 0 0.05", **bend),
        ]
    np.testing.assert_allclose(load(robot(*parts)).palm.approach, [0, 0, 1], atol=1e-9)


def test_rounding_turns_neither_palm_nor_jaws_nor_closing() -> None:
    for noise in (1e-12, 1e-9, 1e-6, 1e-4):
        np.testing.assert_allclose(load(claw(3, TURNS["upright"], noise=noise)).palm.approach, [0, 0, 1], atol=1e-9)
    for noise in (1e-17, -1e-17):
        line = np.array([noise, 1.0, -noise])
        assert (
            dominant_sign(line) == 1
            and dominant_sign(-line) == -1
            and dominant_sign(np.array([1.0, -1.0 - noise, 0])) == 1
        )
    for lower in ("-0.7", "-0.7000001", "-0.6999999"):
        assert (load(claw(3, TURNS["upright"]).replace(b'"-0.4"', f'"{lower}"'.encode())).closing == 1).all()


def test_a_tip_that_turns_in_place_presses_by_the_joint_before() -> None:
    roll = joint("roll{0}", "b{0}", "c{0}", origin="0 0 0.045", axis="0 0 1")
    shape = '<geometry><cylinder radius="0.008" length="0.02"/></geometry>'
    ball = f'<collision><origin xyz="0 0 0.01"/>{shape}</collision>'
    tips = "".join(link(f"c{k}", ball) + roll.format(k) for k in range(3))
    model = load(claw(3, TURNS["upright"]).replace(b"</robot>", tips.encode() + b"</robot>"))
    still = replace(model, preshape=np.zeros(model.dofs))
    for tip in still.fingertips:
        # Inwards: -x of the finger's frame, as even as the points of its surface are.
        assert fingertip_pad(still, tip).normal[0] < -0.9


CLAW_URDF = robot(
    *map(link, ("palm", "a", "b", "c")),
    link("mount", ""),
    link("tip", ""),
    joint("ja", "palm", "a", origin="0.02 0 0.02", axis="0 -1 0"),
    joint("jb", "palm", "b", origin="-0.02 0 0.02"),
    joint("jc", "palm", "c", origin="-0.02 0.03 0.02"),
    joint("jm", "palm", "mount", kind="fixed", origin="0.01 0.02 0.03"),
    joint("jt", "a", "tip", kind="fixed", origin="0 0 0.04"),
)


def same(one: HandModel, other: HandModel, *, palm: bool) -> bool:
    """Numbers in files are rounded to a micrometre or a microradian."""
    pairs = [(one.closing, other.closing), (one.preshape, other.preshape)]
    if palm:
        pairs += [(one.palm.centre, other.palm.centre), (one.palm.approach, other.palm.approach)]
    return one.fingertips == other.fingertips and all(np.allclose(a, b, atol=2e-6) for a, b in pairs)


@pytest.mark.parametrize(
    ("said", "options", "palm"),
    [
        ({}, [], True),
        ({"closing": {"ja": -1}}, ["--closing", "ja=-1"], False),
        ({"fingertips": ["a"], "preshape": {"jb": 0.7}}, ["--fingertips", "a", "--pre-shape", "jb=0.7"], False),
        ({"palm": {"link": "mount"}}, ["--palm", "mount"], True),
    ],
)
def test_corrections_and_options_make_the_same_hand(said, options, palm: bool, tmp_path) -> None:
    (tmp_path / "claw.urdf").write_bytes(CLAW_URDF)
    facts = read_hand_facts(hand_glb(hand_from_path(tmp_path / "claw.urdf")))
    there = apply_corrections({"file": "claw.urdf"}, facts, HandCorrections.model_validate(said))
    named = load_hand({"claw.urdf": CLAW_URDF, "asset.json": json.dumps(there).encode()}, name="claw", digest="")
    written = tmp_path / "asset.json"
    graspd("hands check --no-self-test --write", written, tmp_path / "claw.urdf", *options)
    here = hand_from_path(tmp_path / "claw.urdf")
    # The page keeps the palm that one sees on it; the command guesses it anew from what else it is told.
    assert same(named, here, palm=palm)
    assert set(there) >= {"root", "palm", "preshape", "closing", "fingertips", "file"}


def test_a_corrected_approach_is_a_direction_and_no_more() -> None:
    hand = load_hand({"claw.urdf": CLAW_URDF}, name="claw", digest="")
    said = HandCorrections.model_validate({"palm": {"link": "palm", "approach": [0, 2, 0]}})
    there = apply_corrections({"file": "claw.urdf", "approach": [1, 0, 0]}, read_hand_facts(hand_glb(hand)), said)
    made = load_hand({"claw.urdf": CLAW_URDF, "asset.json": json.dumps(there).encode()}, name="claw", digest="")
    assert made.palm.approach.tolist() == [0, 1, 0] and same(made, hand, palm=False)
    assert np.allclose(made.palm.centre, hand.palm.centre, atol=2e-6)


def test_the_model_tells_every_link_and_pads_are_where_jaws_meet() -> None:
    hand = load_hand({"claw.urdf": CLAW_URDF}, name="claw", digest="")
    facts = read_hand_facts(hand_glb(hand))
    assert set(facts.links) == {"palm", "a", "b", "c", "mount", "tip"} and facts.bodies == ["palm", "a", "b", "c"]
    body, pose = hand.frames["tip"]
    assert hand.body_names[body] == "a" and np.allclose(pose[:3], [0, 0, 0.04])
    one, two = pads_of(gripper())
    assert one.body != two.body and len(one.points) > 3 and len(two.points) > 3
    assert one.normal @ two.normal < -0.95
