"""Postures in which fingers oppose one another: they do so by the hand's kinematics, over most of its span."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graspd.worker.hands import pinch_postures as oppositions
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.pinch_postures import oppositions_of


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_fingertips_lie_on_both_sides_of_the_middle(name: str) -> None:
    hand = hand_from_path(name)
    found = oppositions_of(hand)
    assert len(found) >= 20
    assert (np.diff(found.width) >= 0).all()
    assert ((found.q >= hand.lower) & (found.q <= hand.upper)).all()
    root = np.tile([0.0, 0, 0, 1, 0, 0, 0], (len(found), 1))
    tips = body_poses(hand, root, hand.expand(found.q))[:, list(hand.fingertips), :3]
    along = np.einsum("nfi,ni->nf", tips - found.middle[:, None], found.axis)
    # The one finger lies before the middle, the mean of the others beyond it; frames of links lie off their pads.
    alone = along.argmin(axis=1)
    others = (along.sum(axis=1) - along.min(axis=1)) / (along.shape[1] - 1)
    assert np.bincount(alone).max() > 0.9 * len(found)
    assert (others - along.min(axis=1) > 0.25 * found.width).all()


def test_a_wide_hand_opposes_its_fingers_over_a_range_of_widths() -> None:
    widths = oppositions_of(hand_from_path("barrett")).width
    assert widths[0] < 0.08 < 0.12 < widths[-1]


def test_a_hand_of_one_finger_opposes_nothing() -> None:
    hand = hand_from_path("barrett")
    alone = oppositions_of(replace(hand, name="alone", fingertips=hand.fingertips[:1]))
    assert len(alone) == 0
    assert alone.widest == 0.0


def test_postures_that_the_machine_keeps_are_those_that_were_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    hand = hand_from_path("barrett")
    found = []
    for find in (oppositions._oppositions, lambda hand: pytest.fail("it is there already")):
        monkeypatch.setattr(oppositions, "_oppositions", find)
        monkeypatch.setattr(oppositions, "_known", {})
        found.append(vars(oppositions_of(hand)))
    assert all(np.array_equal(found[0][name], array) for name, array in found[1].items())
