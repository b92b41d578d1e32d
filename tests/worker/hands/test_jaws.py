"""Jaws of a gripper: which way is closed, how far they open, where the pads are; and hands that have none."""

from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import HandError
from graspd.studies.stability.assets import ring_hand
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.simulation.device import joint_units
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions, build
from tests.worker.hands.grippers import OPENING, gripper
from tests.worker.hands.urdfs import joint, link, robot
from tests.worker.models import object_from_mesh

#: The pads are planes, so points on them tell their distance to rounding.
PLANE_M = 1e-9


@pytest.mark.parametrize("coupled", [True, False], ids=["one drive", "two drives"])
@pytest.mark.parametrize(("zero_is_open", "closes"), [(False, -1.0), (True, -1.0)], ids=["0 closed", "0 open"])
def test_what_brings_the_pads_together_closes(zero_is_open: bool, closes: float, coupled: bool) -> None:
    hand = gripper(zero_is_open=zero_is_open, coupled=coupled)
    assert (hand.closing == closes).all()
    assert (hand.preshape == (0.0 if zero_is_open else 0.04)).all()
    assert hand.palm.approach == pytest.approx([0, 0, 1])
    assert sorted(hand.body_names[body] for body in hand.fingertips) == ["left", "right"]


def test_what_is_stated_of_closing_gains_and_limits_stays() -> None:
    assert gripper({"closing": {"right_slide": 1}}).closing.tolist() == [1.0]
    hand = gripper({"stiffness": 300.0}, effort=12.0)
    assert hand.effort.tolist() == [12.0]
    assert hand.stiffness.tolist() == [300.0]


@pytest.mark.parametrize("zero_is_open", [False, True])
def test_the_opening_is_the_distance_of_the_pads_in_mujoco(zero_is_open: bool) -> None:
    hand = gripper(zero_is_open=zero_is_open)
    jaws = jaws_of(hand)
    assert jaws is not None
    assert jaws.opening == pytest.approx(OPENING, abs=PLANE_M)
    for width in (0.0, 0.02, 0.08):
        q, _, axis = jaws.at(np.array([width]))
        assert np.abs(axis[0]) == pytest.approx([1, 0, 0], abs=1e-9)
        # MuJoCo's distance of meshes and boxes is good to its solver's tolerance of 1e-6 m.
        assert _apart(hand, q[0]) == pytest.approx(width, abs=1e-5)


def _apart(hand: HandModel, q: np.ndarray) -> float:
    """Distance of the two fingers' geoms in MuJoCo [m]."""
    obj = object_from_mesh(trimesh.creation.box((0.02, 0.02, 0.02)))
    scene = build(hand, obj, decompose(obj), MujocoOptions())
    data = mujoco.MjData(scene.model)
    scene.place(data, np.array([0, 0, 1.0, 1, 0, 0, 0]), hand.expand(q))
    mujoco.mj_forward(scene.model, data)
    first, second = (int(np.flatnonzero(scene.model.geom_bodyid == scene.model.body(f"body{b}").id)[0]) for b in (1, 2))
    return float(mujoco.mj_geomDistance(scene.model, data, first, second, 1.0, None))


@pytest.mark.parametrize(("coupled", "each"), [(True, 25.0 * 2), (False, 25.0)])
def test_without_effort_each_pad_gets_newtons(coupled: bool, each: float) -> None:
    hand = gripper(coupled=coupled, effort=None)
    assert hand.effort == pytest.approx(each)
    assert hand.stiffness == pytest.approx(2000.0 * each / 25.0)


def test_a_gripper_without_fingers_is_refused() -> None:
    slide = joint("slide", "palm", "mount", kind="prismatic", limit='<limit lower="0" upper="0.04" effort="10"/>')
    bare = robot(link("palm"), link("mount", ""), slide)
    with pytest.raises(HandError, match="no two surfaces of the hand come together when slide moves"):
        load_hand({"bare.urdf": bare}, name="bare", digest="0" * 32)


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_hands_of_several_fingers_are_no_grippers(name: str) -> None:
    """So they start, step, open and squeeze as hands do: their grasps are what they were without jaws."""
    hand = hand_from_path(name)
    assert jaws_of(hand) is None and (joint_units(hand) == 1.0).all()
    fingers = {"allegro": 3, "barrett": 4, "shadow": 6}[name]
    hand = ring_hand(fingers, coupling="one drive")
    assert jaws_of(hand) is None
    assert sorted(hand.body_names[tip] for tip in hand.fingertips) == [f"finger_{k}_2" for k in range(fingers)]
    assert hand.closing.tolist() == [1.0]
    assert jaws_of(ring_hand(2, coupling="one drive")) is not None


def test_a_robotiq_2f_85_opens_as_far_as_its_maker_says() -> None:
    package = find_spec("airo_models")
    if package is None or not package.submodule_search_locations:
        pytest.skip("airo_models is not installed")
    hand = hand_from_path(Path(package.submodule_search_locations[0]) / "grippers/robotiq_2f_85")
    jaws = jaws_of(hand)
    assert jaws is not None
    assert hand.dofs == 1
    # Its data sheet: 85 mm between the pads; the file's meshes are off by a millimetre.
    assert jaws.opening == pytest.approx(0.085, abs=0.002)
