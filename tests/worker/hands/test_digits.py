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
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.surface import sample_surface
from tests.worker.hands.urdfs import gripper
from tests.worker.models import two_finger_hand

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
