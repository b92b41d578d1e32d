"""Which way joints close a hand: where its fingertips go, whatever its limits say."""

from __future__ import annotations

import json
from pathlib import Path

from typer.testing import CliRunner

from graspd.cli import build
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel
from tests.worker.hands.urdfs import joint, link, robot

_PALM = '<collision><geometry><box size="0.09 0.02 0.09"/></geometry></collision>'
_PHALANX = '<collision><origin xyz="0 0 0.02"/><geometry><box size="0.014 0.014 0.04"/></geometry></collision>'


def limit(lower: float, upper: float) -> str:
    return f'<limit lower="{lower}" upper="{upper}" effort="1" velocity="1"/>'


def finger(name: str, x: float, bends: str = limit(-0.2, 1.5)) -> list[str]:
    """A finger along z that bends to +y, where the palm faces, about -x; it swings sideways about y."""
    return [
        link(f"{name}0", _PHALANX),
        link(f"{name}1", _PHALANX),
        link(f"{name}2", _PHALANX),
        joint(f"{name}_spread", "palm", f"{name}0", origin=f"{x} 0 0.045", axis="0 1 0", limit=limit(-0.1, 0.5)),
        joint(f"{name}_bend", f"{name}0", f"{name}1", origin="0 0 0.04", axis="-1 0 0", limit=bends),
        joint(f"{name}_tip", f"{name}1", f"{name}2", origin="0 0 0.04", axis="-1 0 0", limit=limit(-0.1, 1.5)),
    ]


def urdf(*thumb: str, bends: str = limit(-0.2, 1.5)) -> bytes:
    return robot(link("palm", _PALM), *finger("index", -0.025, bends), *finger("ring", 0.025), *thumb)


def opposing_thumb(bends: str) -> list[str]:
    """Before the palm, along z: it bends back to the fingers, about +x, behind an axial joint along itself."""
    return [
        link("thumb0", _PHALANX),
        link("thumb1", _PHALANX),
        link("thumb2", _PHALANX),
        joint("thumb_axial", "palm", "thumb0", origin="0 0.09 0.02", axis="0 0 1", limit=limit(-0.2, 2.0)),
        joint("thumb_bend", "thumb0", "thumb1", origin="0 0 0.04", axis="1 0 0", limit=bends),
        joint("thumb_tip", "thumb1", "thumb2", origin="0 0 0.04", axis="1 0 0", limit=bends),
    ]


def hand_of(text: bytes, **options: object) -> HandModel:
    said = {"approach": [0, 1, 0], **options}
    return load_hand({"r.urdf": text}, name="r", digest="0" * 32, options=said)


def closing_of(hand: HandModel) -> dict[str, int]:
    return dict(zip(hand.dof_names, (int(one) for one in hand.closing), strict=True))


def test_a_thumb_closes_to_the_fingers_against_its_limits() -> None:
    found = closing_of(hand_of(urdf(*opposing_thumb(limit(-1.5, 0.2)))))
    assert (found["thumb_bend"], found["thumb_tip"]) == (1, 1)
    assert closing_of(hand_of(urdf(*opposing_thumb(limit(-1.2, 0.8)))))["thumb_bend"] == 1


def test_a_joint_that_goes_as_far_both_ways_is_left_straight() -> None:
    assert closing_of(hand_of(urdf(*opposing_thumb(limit(-1.2, 1.2)))))["thumb_bend"] == 0


def test_a_joint_in_line_with_its_finger_closes_nothing() -> None:
    assert closing_of(hand_of(urdf(*opposing_thumb(limit(-0.2, 1.5)))))["thumb_axial"] == 0


def test_a_joint_about_the_approach_spreads_and_flexion_closes_whatever_the_limits() -> None:
    found = closing_of(hand_of(urdf(*opposing_thumb(limit(-0.2, 1.5)), bends=limit(-1.0, 1.5))))
    assert [found[f"{name}_spread"] for name in ("index", "ring")] == [0, 0]
    assert [found[f"{name}_{part}"] for name in ("index", "ring") for part in ("bend", "tip")] == [1, 1, 1, 1]


def test_what_is_stated_of_one_joint_counts_for_it_alone() -> None:
    text = urdf(*opposing_thumb(limit(-1.5, 0.2)))
    stated = closing_of(hand_of(text, closing={"thumb_bend": -1}))
    assert stated == {**closing_of(hand_of(text)), "thumb_bend": -1}


def test_a_finger_that_no_joint_closes_is_told_and_the_closing_is_in_the_json(tmp_path: Path) -> None:
    text = urdf(*opposing_thumb(limit(-0.2, 1.5)))
    closed = check_hand({"r.urdf": text}, "r", {"approach": [0, 1, 0]})
    assert "no joint closes" not in closed["message"]
    still = {"approach": [0, 1, 0], "closing": dict.fromkeys(("thumb_axial", "thumb_bend", "thumb_tip"), 0)}
    assert "no joint closes the finger of thumb2:" in check_hand({"r.urdf": text}, "r", still)["message"]
    (tmp_path / "r.urdf").write_bytes(text)
    command = ["hands", "check", str(tmp_path / "r.urdf"), "--approach", "0,1,0", "--no-self-test", "--json"]
    told = CliRunner().invoke(build(), command)
    assert json.loads(told.stdout)["closing"] == closing_of(hand_of(text))
