"""Two models of one hand: joints by name, bases by fit, fingertips as the validator."""

import dataclasses

import numpy as np
import pytest

from graspd.exchange.bench_hand import write_hand
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import compose, invert, quat_from_axis_angle
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.same_hand import same_hand

HAND = hand_from_path("shadow")
#: Where the other model's root link is, as seen from ours.
BASE = np.concatenate([[0.013, -0.02, 0.034], quat_from_axis_angle(np.array([0.6, 0.0, 0.8]), np.array(2.0))])


def other_base(hand: HandModel) -> HandModel:
    """The same hand with another frame on its root: what hangs on it, and its shapes, are told in that frame."""
    moved = invert(BASE)
    origin = hand.origin.copy()
    hangs = np.flatnonzero(hand.parent == 0)
    origin[hangs] = compose(moved, origin[hangs])
    return dataclasses.replace(hand, name="other", origin=origin)


def named(hand: HandModel, names: list[str]) -> HandModel:
    return dataclasses.replace(hand, joint_names=tuple(names))


def test_another_base_is_found_another_hand_is_refused() -> None:
    found = same_hand(HAND, other_base(HAND))
    # Double precision, and a least-squares fit that ends at steps of 1e-15.
    assert found.base[:3] == pytest.approx(BASE[:3], abs=1e-8)
    assert abs(float(found.base[3:] @ BASE[3:])) == pytest.approx(1.0, abs=1e-12)
    assert found.fingertips_m < 1e-8
    axis = HAND.axis.copy()
    bend = HAND.joint_body[HAND.joint_names.index("MFJ3")]
    axis[bend] *= -1
    with pytest.raises(InputError, match=r"fingertip 'MF_distal' is up to \d+\.\d+ mm .* 1 mm are allowed") as error:
        same_hand(HAND, dataclasses.replace(HAND, name="mirrored", axis=axis))
    assert "\n" not in str(error.value)


def test_neither_order_nor_case_nor_prefix_of_names_counts() -> None:
    other = named(HAND, [f"robot0:{name.lower()}" for name in HAND.joint_names])
    assert same_hand(HAND, other).joints.tolist() == list(range(len(HAND.joint_names)))
    order = np.arange(len(HAND.joint_names))[::-1]
    names, body = [HAND.joint_names[k] for k in order], HAND.joint_body[order]
    other = dataclasses.replace(named(HAND, names), joint_body=body)
    assert same_hand(HAND, other).joints.tolist() == order.tolist()


def test_a_joint_of_another_name_is_named_and_can_be_said() -> None:
    names = ["bend" if name == "FFJ3" else name for name in HAND.joint_names]
    with pytest.raises(InputError, match=r"shadow has FFJ3; shadow has bend; .*--joint-map OURS=THEIRS"):
        same_hand(HAND, named(HAND, names))
    assert same_hand(HAND, named(HAND, names), {"FFJ3": "bend"}).fingertips_m < 1e-8
    with pytest.raises(InputError, match="joint 'curl', which shadow does not have"):
        same_hand(HAND, named(HAND, names), {"FFJ3": "curl"})


def test_a_urdf_and_the_mjcf_that_is_written_of_it_are_one_hand(tmp_path) -> None:
    back = hand_from_path(tmp_path / write_hand(HAND, "shadow", tmp_path))
    # Twelve digits are written.
    assert same_hand(HAND, back).fingertips_m < 1e-9
    assert {t.coefficients for t in back.tendons} == {(1.0, 1.0)} and len(back.tendons) == 4
    for ours, theirs in zip(HAND.tendons, back.tendons, strict=True):
        assert theirs.gain(back.stiffness) == pytest.approx(ours.gain(HAND.stiffness))
        assert theirs.limit(back.effort) == pytest.approx(ours.limit(HAND.effort))
