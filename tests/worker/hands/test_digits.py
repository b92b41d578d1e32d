"""Names of digits, parts of their surface, and hands that use some digits only."""

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.worker.hands.digits import (
    NAMES,
    Part,
    digit_names,
    digit_order,
    finger_of_body,
    hand_with_digits,
    points_of_parts,
)
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.surface import sample_surface
from tests.worker.hands.urdfs import gripper
from tests.worker.models import two_finger_hand

AT_REST = np.array([[0.0, 0, 0, 1, 0, 0, 0]])
#: Names of fingertips as their vendors give them, by the start of the body's name.
VENDORS = {
    "allegro": {"index": "index", "middle": "middle", "ring": "ring", "thumb": "thumb"},
    "shadow": {"FF": "index", "MF": "middle", "RF": "ring", "LF": "little", "TH": "thumb"},
    "barrett": {"finger_1": "index", "finger_2": "middle", "finger_3": "thumb"},
}
SHARED = {
    "allegro": {"link_3": "index", "link_7": "middle", "link_11": "ring", "link_15": "thumb"},
    "shadow": {"ff": "index", "mf": "middle", "rf": "ring", "lf": "little", "th": "thumb"},
    "barrett_bh280": {"bh_finger_33": "thumb"},
}


def names_as_published(path: str, published: dict[str, str]) -> None:
    hand = hand_from_path(path)
    names = digit_names(hand)
    found = {hand.body_names[tip]: name for tip, name in zip(hand.fingertips, names, strict=True)}
    for start, name in published.items():
        assert [told for body, told in found.items() if body.startswith(start)] == [name]
    assert [names[k] for k in digit_order(hand)] == list(NAMES[: len(names)])


@pytest.mark.parametrize("name", VENDORS)
def test_digits_of_built_in_hands_have_the_names_of_their_vendors(name: str) -> None:
    names_as_published(name, VENDORS[name])


@pytest.mark.parametrize("name", SHARED)
def test_digits_of_other_hands_have_the_names_of_their_vendors(name: str, shared_data) -> None:
    names_as_published(str(shared_data / "hands" / name), SHARED[name])


def test_a_gripper_has_no_names_and_keeps_its_order() -> None:
    jaws = gripper()
    assert digit_names(jaws) == () and digit_order(jaws).tolist() == list(range(len(jaws.fingertips)))


@pytest.fixture(scope="module")
def allegro():
    return hand_from_path("allegro")


def test_joints_of_unused_digits_are_locked_open_and_the_others_are_as_before(allegro) -> None:
    pinch = hand_with_digits(allegro, ("thumb", "index"))
    finger, names = finger_of_body(allegro), digit_names(allegro)
    idle = np.zeros(allegro.dofs, bool)
    idle[allegro.dof[np.isin(finger, [names.index("middle"), names.index("ring")])]] = True
    assert idle.sum() == 8 and [allegro.body_names[tip].split("_")[0] for tip in pinch.fingertips] == ["index", "thumb"]
    for name in ("lower", "upper", "preshape", "closing"):
        np.testing.assert_array_equal(getattr(pinch, name)[~idle], getattr(allegro, name)[~idle])
    assert (pinch.closing[idle] == 0).all() and (pinch.upper - pinch.lower)[idle] == pytest.approx(
        2e-3 * allegro.span[idle]
    )
    assert (pinch.lower >= allegro.lower - 1e-12).all() and (pinch.upper <= allegro.upper + 1e-12).all()
    assert ((pinch.lower < pinch.preshape) & (pinch.preshape < pinch.upper)).all()
    # Locked fingers are open: no posture of their own range has a fingertip farther from the palm's front.
    tips = [allegro.fingertips[names.index(name)] for name in ("middle", "ring")]
    ahead = [body_poses(h, AT_REST, h.expand(h.preshape[None]))[0, tips, :3] for h in (pinch, allegro)]
    assert (ahead[0] @ allegro.palm.approach < ahead[1] @ allegro.palm.approach).all()
    assert pinch.content != allegro.content


def test_all_digits_leave_the_hand_as_it_is(allegro) -> None:
    every = hand_with_digits(allegro, NAMES[:4])
    assert every.content == allegro.content


@pytest.mark.parametrize(
    ("hand", "names", "message"),
    [
        ("allegro", ("thumb",), "two digits or more"),
        ("allegro", ("thumb", "thumb"), "two digits or more"),
        ("allegro", ("thumb", "little"), "no little; its digits are thumb, index, middle, ring"),
        ("gripper", ("thumb", "index"), "closes all its fingers"),
    ],
)
def test_digits_that_cannot_be_chosen_are_refused_in_one_line(hand: str, names: tuple[str, ...], message: str) -> None:
    with pytest.raises(InputError, match=message) as error:
        hand_with_digits(gripper() if hand == "gripper" else hand_from_path(hand), names)
    assert "\n" not in str(error.value)


def test_sides_face_along_the_axis_of_flexion_and_pads_are_the_rest() -> None:
    hand = two_finger_hand()  # its fingers turn about y
    points = sample_surface(hand, 600)
    side, pad, whole, none = (
        points_of_parts(hand, np.full(3, part), points) for part in (Part.SIDES, Part.PAD, Part.WHOLE, Part.NONE)
    )
    finger = points.body > 0
    np.testing.assert_array_equal(side, finger & (np.abs(points.normal[:, 1]) > np.sqrt(0.5)))
    np.testing.assert_array_equal(pad, ~side)
    assert whole.all() and not none.any() and side.any()
    # Of a ball, the two caps within 45 degrees are 1 - cos 45 of the surface; of a cylinder, half.
    tip = finger & (points.position[:, 2] > 0.07)
    assert points.area[side & finger].sum() / points.area[finger].sum() == pytest.approx(0.45, abs=0.08) and tip.any()
