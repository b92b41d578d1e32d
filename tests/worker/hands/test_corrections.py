"""What is corrected in the browser is what the command line says and writes: the same hand comes of it."""

import json

import numpy as np
import pytest

from graspd.service.store.descriptions import HandCorrections, apply_corrections, read_hand_facts
from graspd.worker.hands.jaws import pads_of
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.stages.models import hand_glb
from tests.worker.commands_run import graspd
from tests.worker.hands.urdfs import gripper, joint, link, robot

CLAW = robot(
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
    (tmp_path / "claw.urdf").write_bytes(CLAW)
    facts = read_hand_facts(hand_glb(hand_from_path(tmp_path / "claw.urdf")))
    there = apply_corrections({"file": "claw.urdf"}, facts, HandCorrections.model_validate(said))
    named = load_hand({"claw.urdf": CLAW, "asset.json": json.dumps(there).encode()}, name="claw", digest="")
    written = tmp_path / "asset.json"
    graspd("hands check --no-self-test --write", written, tmp_path / "claw.urdf", *options)
    here = hand_from_path(tmp_path / "claw.urdf")
    # The page keeps the palm that one sees on it; the command guesses it anew from what else it is told.
    assert same(named, here, palm=palm)
    assert set(there) >= {"root", "palm", "preshape", "closing", "fingertips", "file"}


def test_a_corrected_approach_is_a_direction_and_no_more() -> None:
    hand = load_hand({"claw.urdf": CLAW}, name="claw", digest="")
    said = HandCorrections.model_validate({"palm": {"link": "palm", "approach": [0, 2, 0]}})
    there = apply_corrections({"file": "claw.urdf", "approach": [1, 0, 0]}, read_hand_facts(hand_glb(hand)), said)
    made = load_hand({"claw.urdf": CLAW, "asset.json": json.dumps(there).encode()}, name="claw", digest="")
    assert made.palm.approach.tolist() == [0, 1, 0] and same(made, hand, palm=False)
    assert np.allclose(made.palm.centre, hand.palm.centre, atol=2e-6)


def test_the_model_tells_every_link_and_pads_are_where_jaws_meet() -> None:
    hand = load_hand({"claw.urdf": CLAW}, name="claw", digest="")
    facts = read_hand_facts(hand_glb(hand))
    assert set(facts.links) == {"palm", "a", "b", "c", "mount", "tip"} and facts.bodies == ["palm", "a", "b", "c"]
    body, pose = hand.frames["tip"]
    assert hand.body_names[body] == "a" and np.allclose(pose[:3], [0, 0, 0.04])
    one, two = pads_of(gripper())
    assert one.body != two.body and len(one.points) > 3 and len(two.points) > 3
    assert one.normal @ two.normal < -0.95
