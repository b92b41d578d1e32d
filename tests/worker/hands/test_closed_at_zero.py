"""Fingers that are closed where their joints are 0: limits from 0 on say nothing of the way they close."""

from __future__ import annotations

import numpy as np
import pytest

from graspd.worker.hands.closing import posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel
from tests.worker.hands.urdfs import joint, link, robot

_PALM = '<collision><geometry><box size="0.09 0.09 0.02"/></geometry></collision>'
#: A finger that leans in by 30 degrees.
_FINGER = (
    '<collision><origin xyz="{x} {y} 0.04" rpy="{roll} {pitch} 0"/>'
    '<geometry><box size="0.012 0.012 0.09"/></geometry></collision>'
)


def three_fingers(outwards: float, **options: object) -> HandModel:
    """Fingers at 0 .. 1.2 rad that meet ahead of the palm at 0; `outwards` 1: and part from there; -1: they cross."""
    parts: list[str] = []
    for number, angle in enumerate(2 * np.pi * np.arange(3) / 3):
        c, s = np.cos(angle), np.sin(angle)
        shape = _FINGER.format(x=-0.02 * c, y=-0.02 * s, roll=0.5 * s, pitch=-0.5 * c)
        axis = f"{-outwards * s} {outwards * c} 0"
        parts += [
            link(f"finger{number}", shape),
            joint(
                f"bend{number}",
                "palm",
                f"finger{number}",
                origin=f"{0.05 * c} {0.05 * s} 0.01",
                axis=axis,
                limit='<limit lower="0" upper="1.2" effort="1" velocity="1"/>',
            ),
        ]
    urdf = robot(link("palm", _PALM), *parts)
    return load_hand({"r.urdf": urdf}, name="r", digest="0" * 32, options={"approach": [0, 0, 1], **options})


def apart(hand: HandModel, share: float) -> float:
    """Distance of the fingertips' ends from their middle [m]."""
    poses = body_poses(hand, np.array([0.0, 0, 0, 1, 0, 0, 0]), hand.expand(posture(hand, share)))[0]
    ends = np.array([p.vertices[np.argmax(p.vertices[:, 2])] for p in hand.pieces if p.body > 0])
    return float(np.ptp(poses[1:, :3] + ends, axis=0).max())


def test_fingers_that_meet_at_zero_close_towards_it() -> None:
    hand = three_fingers(1.0)
    assert hand.closing.tolist() == [-1, -1, -1]
    assert hand.preshape == pytest.approx(0.75 * hand.upper)


def test_what_is_stated_counts_for_more() -> None:
    hand = three_fingers(1.0, closing={"bend0": 1})
    assert hand.closing.tolist() == [1, -1, -1]


def test_a_wrist_that_stands_ahead_of_the_palm_is_not_the_palm() -> None:
    """A plate of 10 mm whose fingers bend over it, on a wrist that stands 60 mm ahead of it."""
    plate = '<collision><origin xyz="0 0 0.05"/><geometry><box size="0.01 0.08 0.1"/></geometry></collision>'
    wrist = '<collision><origin xyz="0 0 -0.03"/><geometry><box size="0.13 0.08 0.06"/></geometry></collision>'
    finger = '<collision><origin xyz="0 0 0.04"/><geometry><box size="0.01 0.01 0.08"/></geometry></collision>'
    thumb = '<collision><origin xyz="0.04 0 0"/><geometry><box size="0.08 0.01 0.01"/></geometry></collision>'
    fingers = [
        part
        for number, y in enumerate((-0.03, 0.0, 0.03))
        for part in (link(f"f{number}", finger), joint(f"j{number}", "palm", f"f{number}", origin=f"0 {y} 0.1"))
    ]
    fingers += [link("thumb", thumb), joint("t", "palm", "thumb", origin="0.005 0 0.01", axis="0 -1 0")]
    hand = load_hand({"r.urdf": robot(link("palm", plate + wrist), *fingers)}, name="r", digest="0" * 32)
    assert hand.palm.approach == pytest.approx([1, 0, 0])
    assert hand.palm.centre[0] == pytest.approx(0.005) and 0.05 < hand.palm.centre[2] < 0.1
