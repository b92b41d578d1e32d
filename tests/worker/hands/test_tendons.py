"""Tendons: who says so, what they pull, and with what gain."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import HandError
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import files_from_path, hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.tendons import Tendon, actuators
from graspd.worker.objects.disk_cache import TOLD_IF_SET, content_of
from tests.worker.hands.mjcfs import CLAW

FINGERS = ("FF", "MF", "RF", "LF")


def files(text: str = CLAW) -> dict[str, bytes]:
    tip = trimesh.creation.box((8.0, 8.0, 16.0)).export(file_type="stl")
    return {"claw.xml": text.encode(), "meshes/tip.stl": bytes(tip)}


def load(text: str = CLAW, **options: Any) -> HandModel:
    return load_hand(files(text), name="claw", digest="0" * 32, options=options)


def pulls(hand: HandModel) -> dict[str, dict[str, float]]:
    return {t.name: {hand.dof_names[d]: c for d, c in zip(t.dofs, t.coefficients, strict=True)} for t in hand.tendons}


def test_joints_of_a_finger_on_one_actuated_tendon_are_free_and_share_it() -> None:
    hand = load()
    ((name, pulled),) = pulls(hand).items()
    assert pulled == {"left_bend": 1.0, "left_curl": 0.5}
    assert name.startswith("tendon")
    # The model's servo: 4 N m/rad of length, 2 N m at most; joints get the pull times their coefficients.
    assert hand.tendons[0].gain(hand.stiffness) == pytest.approx(4.0)
    assert hand.tendons[0].limit(hand.effort) == pytest.approx(2.0)


def test_jaws_side_by_side_on_one_tendon_keep_their_ratio() -> None:
    text = re.sub('<joint joint="left_curl" coef="0.5"/>', '<joint joint="right_slide" coef="0.5"/>', CLAW)
    hand = load(re.sub('<position joint="right_slide"[^>]*>', "", text))
    assert not hand.tendons
    assert "right_slide" not in hand.dof_names


def test_a_command_of_torques_commands_the_pull_that_exerts_them() -> None:
    tendon, stiffness = Tendon("t", (0, 2), (1.0, 0.4)), np.array([5.0, 9.0, 2.0])
    pull = 0.7
    told = pull * np.array([1.0, 0.0, 0.4]) / stiffness
    length = actuators((tendon,), 3) @ told
    assert length.tolist() == pytest.approx([told[0] + 0.4 * told[2], told[1]])
    assert tendon.gain(stiffness) * length[0] == pytest.approx(pull)


def test_asset_json_puts_joints_on_a_tendon_over_a_ratio_and_takes_it_away() -> None:
    barrett = hand_from_path("barrett")
    assert "finger_1_distal" not in barrett.dof_names
    said = {"cord": {"finger_1_medial": 1.0, "finger_1_distal": 0.3}}
    hand = hand_from_path("barrett", {"tendons": said})
    assert pulls(hand) == said
    assert set(hand.dof_names) - set(barrett.dof_names) == {"finger_1_distal"}
    assert not load(tendons={}).tendons


@pytest.mark.parametrize(
    ("tendons", "says"),
    [
        ({"t": {"left_bend": 1, "nothing": 1}}, "'nothing', which is no moving joint"),
        ({"t": {"left_bend": 1, "left_curl": 0}}, "fewer than two joints"),
        ({"t": {"left_bend": 1, "left_curl": 1}, "u": {"left_curl": 1, "left_spread": 1}}, "'left_curl' is on two"),
    ],
)
def test_a_tendon_that_cannot_be_is_refused_in_one_line(tendons: dict[str, Any], says: str) -> None:
    with pytest.raises(HandError, match=says) as error:
        load(tendons=tendons)
    assert "\n" not in str(error.value)


def test_what_a_hand_does_not_have_does_not_change_its_content() -> None:
    @dataclass
    class Before:
        upper: float = 1.0

    @dataclass
    class After(Before):
        tendons: tuple[str, ...] = field(default=(), metadata=TOLD_IF_SET)

    # What is known of a hand is kept under it.
    assert content_of(After()) == content_of(Before())
    assert content_of(After(tendons=("t",))) != content_of(Before())
    assert {f.name for f in fields(HandModel) if "told_if_set" in f.metadata} == {"tendons", "drag", "mounting"}


def test_a_shadow_urdf_has_the_tendons_that_urdf_cannot_say(shared_data: Path) -> None:
    path = shared_data / "hands/shadow/shadow_hand_right.urdf"
    hand = hand_from_path(path)
    assert pulls(hand) == {f"{f}J0": {f"{f}J2": 1.0, f"{f}J1": 1.0} for f in FINGERS}
    assert hand.dofs == 22
    assert not hand_from_path(path, {"tendons": {}}).tendons
    name, given, stated = files_from_path(path)
    assert (
        "FFJ2 and FFJ1, MFJ2 and MFJ1, RFJ2 and RFJ1, LFJ2 and LFJ1 on one tendon each"
        in check_hand(given, name, stated)["message"]
    )
