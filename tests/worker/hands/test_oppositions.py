"""Digits and their surface; jaws, and postures in which fingers oppose one another; hands without them."""

from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from benchmarks.integrators.hands import ring_hand
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import HandError, InputError
from graspd.service.model.transforms import IDENTITY_POSE, apply, quat_rotate
from graspd.worker.generation import validated_grasps
from graspd.worker.hands import pinch_postures as oppositions
from graspd.worker.hands.digits import (
    NAMES,
    Part,
    digit_names,
    digit_order,
    finger_of_body,
    hand_with_digits,
    points_of_parts,
)
from graspd.worker.hands.flat_pinches import HEIGHTS_M, OVER_M, flat_pinches
from graspd.worker.hands.grasp_widths import Size, postures_for_size
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import pinch_postures_of
from graspd.worker.hands.surface import sample_surface
from graspd.worker.simulation.device import joint_units
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions, build_scene
from tests.worker.hands.urdfs import BOX, OPENING, gripper, joint, limits, link, robot
from tests.worker.models import object_from_mesh, two_finger_hand

#: Start of the names of fingertips, by their vendors; hands of `shared/data` have a folder.
PUBLISHED = {
    "allegro": {"thumb": "thumb", "index": "index", "middle": "middle", "ring": "ring"},
    "shadow": {"TH": "thumb", "FF": "index", "MF": "middle", "RF": "ring", "LF": "little"},
    "barrett": {"finger_3": "thumb", "finger_1": "index", "finger_2": "middle"},
    "hands/allegro": {"link_15": "thumb", "link_3": "index", "link_7": "middle", "link_11": "ring"},
    "hands/shadow": {"th": "thumb", "ff": "index", "mf": "middle", "rf": "ring", "lf": "little"},
    "hands/barrett_bh280": {"bh_finger_3": "thumb"},
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_digits_have_the_names_of_their_vendors(name: str, request: pytest.FixtureRequest) -> None:
    folder = "/" in name
    hand = hand_from_path(request.getfixturevalue("shared_data") / name if folder else name)
    names = digit_names(hand)
    for start, digit in PUBLISHED[name].items():
        assert hand.body_names[hand.fingertips[names.index(digit)]].startswith(start)
    assert [names[k] for k in digit_order(hand)] == list(NAMES[: len(names)])


def test_joints_of_unused_digits_are_locked_open_and_the_others_are_as_before() -> None:
    hand = hand_from_path("allegro")
    pinch = hand_with_digits(hand, ("thumb", "index"))
    idle = np.isin(np.arange(16), hand.dof[np.isin(finger_of_body(hand), (1, 2))])  # middle and ring finger
    assert pinch.fingertips == (hand.fingertips[0], hand.fingertips[3]) and idle.sum() == 8
    for name in ("lower", "upper", "preshape", "closing"):
        np.testing.assert_array_equal(getattr(pinch, name)[~idle], getattr(hand, name)[~idle])
    span, bends = (pinch.upper - pinch.lower)[idle], idle & (hand.closing > 0)
    assert span == pytest.approx(2e-3 * hand.span[idle]) and (pinch.closing[idle] == 0).all() and bends.sum() == 6
    assert pinch.lower[bends] == pytest.approx(hand.lower[bends])
    assert ((pinch.lower < pinch.preshape) & (pinch.preshape < pinch.upper)).all()
    assert hand_with_digits(hand, NAMES[:4]).content == hand.content != pinch.content


@pytest.mark.parametrize(
    ("hand", "names", "message"),
    [
        ("allegro", ("thumb", "thumb"), "two digits or more"),
        ("allegro", ("thumb", "little"), "no little; its digits are thumb, index, middle, ring$"),
        ("gripper", ("thumb", "index"), "closes all its fingers"),
    ],
)
def test_digits_that_cannot_be_chosen_are_refused(hand: str, names: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        hand_with_digits(gripper() if hand == "gripper" else hand_from_path(hand), names)


def test_sides_face_along_the_axis_of_flexion_and_pads_are_the_rest() -> None:
    hand = two_finger_hand()  # its fingers turn about y
    points = sample_surface(hand, 600)
    parts = (Part.SIDES, Part.PAD, Part.WHOLE, Part.NONE)
    side, pad, whole, none = (points_of_parts(hand, np.full(3, part), points) for part in parts)
    np.testing.assert_array_equal(side, (points.body > 0) & (np.abs(points.normal[:, 1]) > np.sqrt(0.5)))
    np.testing.assert_array_equal(pad, ~side)
    assert whole.all() and not none.any() and side.any()


HEIGHT_M = 0.012
#: The pads are planes, so points on them tell their distance to rounding.
PLANE_M = 1e-9


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_fingertips_lie_on_both_sides_of_the_middle(name: str) -> None:
    hand = hand_from_path(name)
    found = pinch_postures_of(hand)
    assert len(found) >= 20 and (np.diff(found.width) >= 0).all()
    assert ((found.q >= hand.lower) & (found.q <= hand.upper)).all()
    root = np.tile([0.0, 0, 0, 1, 0, 0, 0], (len(found), 1))
    tips = body_poses(hand, root, hand.expand(found.q))[:, list(hand.fingertips), :3]
    along = np.einsum("nfi,ni->nf", tips - found.middle[:, None], found.axis)
    # The one finger lies before the middle, the mean of the others beyond it; frames of links lie off their pads.
    alone = along.argmin(axis=1)
    others = (along.sum(axis=1) - along.min(axis=1)) / (along.shape[1] - 1)
    assert np.bincount(alone).max() > 0.9 * len(found)
    assert (others - along.min(axis=1) > 0.25 * found.width).all()


def test_a_wide_hand_opposes_over_a_range_one_finger_nothing() -> None:
    widths = pinch_postures_of(hand_from_path("barrett")).width
    assert widths[0] < 0.08 < 0.12 < widths[-1]
    hand = hand_from_path("barrett")
    alone = pinch_postures_of(replace(hand, name="alone", fingertips=hand.fingertips[:1]))
    assert len(alone) == 0 and alone.widest == 0.0


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_opposed_fingertips_end_on_one_plane_and_none_is_as_low(name: str) -> None:
    hand, found = hand_from_path(name), flat_pinches(hand_from_path(name), HEIGHT_M)
    assert len(found) >= 20 and (np.diff(found.width) >= 0).all()
    down = hand.palm.approach - (found.axis @ hand.palm.approach)[:, None] * found.axis
    down /= np.linalg.norm(down, axis=1, keepdims=True)
    bodies = body_poses(hand, np.tile(IDENTITY_POSE, (len(found), 1)), hand.expand(found.q))
    # How far each piece reaches beyond the middle, which is half the height above the plane.
    away = [(p.body, apply(bodies[:, p.body, None], p.vertices) - found.middle[:, None]) for p in hand.pieces]
    reach = [(body, np.einsum("nvi,ni->nv", points, down).max(axis=1)) for body, points in away]
    tips = {tip: np.max([r for body, r in reach if body == tip], axis=0) for tip in hand.fingertips}
    lowest = np.max(list(tips.values()), axis=0)
    assert lowest == pytest.approx(HEIGHT_M / 2, abs=2e-3)  # the surface is sampled
    low = np.sum([lowest - tip < HEIGHT_M for tip in tips.values()], axis=0)
    assert (low >= 2).all()
    others = np.max([r for body, r in reach if body not in hand.fingertips], axis=0)
    assert (lowest - others > 0.5 * OVER_M).all()


def test_what_reaches_the_pads_has_no_such_postures() -> None:
    hand = hand_from_path("barrett")
    assert len(flat_pinches(hand, HEIGHTS_M[-1] + 1e-4)) == 0
    assert len(flat_pinches(replace(hand, name="alone", fingertips=hand.fingertips[:1]), HEIGHT_M)) == 0


@pytest.mark.parametrize("size", ["small", "wide"])
def test_hand_looks_at_thing_from_both_sides_and_leaves_it_room(size: Size) -> None:
    hand = hand_from_path("allegro")
    found, points = postures_for_size(hand, size), sample_surface(hand, 3000)
    assert len(found) >= 10 and ((found.q >= hand.lower) & (found.q <= hand.upper)).all()
    pose = body_poses(hand, np.tile(IDENTITY_POSE, (len(found), 1)), hand.expand(found.q))[:, points.body]
    place = quat_rotate(pose[..., 3:], points.position) + pose[..., :3]
    look = quat_rotate(pose[..., 3:], points.normal)
    for side in (-1, 1):
        end = found.middle + side * 0.5 * found.width[:, None] * found.axis
        near = np.linalg.norm(place - end[:, None], axis=2).argmin(axis=1)
        row = np.arange(len(found))
        # Points lie 4 mm apart.
        assert np.linalg.norm(place[row, near] - end, axis=1).max() < 0.006
        assert np.median(-side * np.einsum("ni,ni->n", look[row, near], found.axis)) > 0.7
    # A ball at the middle; what is wide may be held at its rim, so that its middle lies ahead. The search sees fewer
    # points of the hand than are looked at here.
    if size == "small":
        clear = np.linalg.norm(place - found.middle[:, None], axis=2).min(axis=1) > 0.2 * found.width
        assert clear.mean() > 0.9


def test_spans_begin_where_pads_end() -> None:
    hand = hand_from_path("allegro")
    pads = pinch_postures_of(hand).width
    assert postures_for_size(hand, "small").width[0] < pads[0] - 0.005
    assert postures_for_size(hand, "wide").width[-1] > pads[-1] + 0.005


def pointer() -> HandModel:
    """A stick of three links that bends a little: none of them ever faces another."""
    thin = BOX.replace("0.02 0.02 0.04", "0.01 0.01 0.04")
    joints = joint("one", "a", "b", limit=limits(0, 0.3)), joint("two", "b", "c", limit=limits(0, 0.3))
    files = {"pointer.urdf": robot(*(link(name, thin) for name in "abc"), *joints)}
    return load_hand(files, name="pointer", digest="0" * 32)


def test_without_opposing_digits_grasps_are_not_even_planned() -> None:
    ball = object_from_mesh(trimesh.creation.icosphere(2, 0.02))
    with pytest.raises(HandError, match=r"pointer: no two opposing digits.*--root"):
        validated_grasps(pointer(), ball, JobOptions(want="candidates", grasps=1), count=1)


@pytest.mark.usefixtures("own_cache")
def test_what_a_hand_can_hold_is_asked_once_on_a_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    # Without the cache in memory, as a process that begins.
    assert [oppositions._can_hold.__wrapped__(hand) for hand in (gripper(), pointer())] == [True, False]
    monkeypatch.setattr(oppositions, "can_oppose", lambda hand: pytest.fail("asked again"))
    assert [oppositions._can_hold.__wrapped__(hand) for hand in (gripper(), pointer())] == [True, False]


@pytest.mark.parametrize("coupled", [True, False], ids=["one drive", "two drives"])
@pytest.mark.parametrize(("zero_is_open", "closes"), [(False, -1.0), (True, -1.0)], ids=["0 closed", "0 open"])
def test_what_brings_the_pads_together_closes(zero_is_open: bool, closes: float, coupled: bool) -> None:
    hand = gripper(zero_is_open=zero_is_open, coupled=coupled)
    assert (hand.closing == closes).all() and (hand.preshape == (0.0 if zero_is_open else 0.04)).all()
    assert hand.palm.approach == pytest.approx([0, 0, 1])
    assert sorted(hand.body_names[body] for body in hand.fingertips) == ["left", "right"]


def test_what_is_stated_of_closing_gains_and_limits_stays() -> None:
    assert gripper({"closing": {"right_slide": 1}}).closing.tolist() == [1.0]
    hand = gripper({"stiffness": 300.0}, effort=12.0)
    assert hand.effort.tolist() == [12.0] and hand.stiffness.tolist() == [300.0]


@pytest.mark.parametrize("zero_is_open", [False, True])
def test_the_opening_is_the_distance_of_the_pads_in_mujoco(zero_is_open: bool) -> None:
    hand = gripper(zero_is_open=zero_is_open)
    jaws = jaws_of(hand)
    assert jaws is not None and jaws.opening == pytest.approx(OPENING, abs=PLANE_M)
    for width in (0.0, 0.02, 0.08):
        q, _, axis = jaws.nearest_postures(np.array([width]))
        assert np.abs(axis[0]) == pytest.approx([1, 0, 0], abs=1e-9)
        # MuJoCo's distance of meshes and boxes is good to its solver's tolerance of 1e-6 m.
        assert _apart(hand, q[0]) == pytest.approx(width, abs=1e-5)


def _apart(hand: HandModel, q: np.ndarray) -> float:
    """Distance of the two fingers' geoms in MuJoCo [m]."""
    obj = object_from_mesh(trimesh.creation.box((0.02, 0.02, 0.02)))
    scene = build_scene(hand, obj, decompose(obj), MujocoOptions())
    data = mujoco.MjData(scene.model)
    scene.set_posture(data, np.array([0, 0, 1.0, 1, 0, 0, 0]), hand.expand(q))
    mujoco.mj_forward(scene.model, data)
    first, second = (int(np.flatnonzero(scene.model.geom_bodyid == scene.model.body(f"body{b}").id)[0]) for b in (1, 2))
    return float(mujoco.mj_geomDistance(scene.model, data, first, second, 1.0, None))


@pytest.mark.parametrize(("coupled", "each"), [(True, 25.0 * 2), (False, 25.0)])
def test_without_effort_each_pad_gets_newtons(coupled: bool, each: float) -> None:
    hand = gripper(coupled=coupled, effort=None)
    assert hand.effort == pytest.approx(each) and hand.stiffness == pytest.approx(2000.0 * each / 25.0)


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
    assert hand.dofs == 1
    # Its data sheet: 85 mm between the pads; the file's meshes are off by a millimetre.
    assert jaws.opening == pytest.approx(0.085, abs=0.002)
