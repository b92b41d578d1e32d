"""Hands whose fingers stand around an axis take hold along it, whatever rounding does to them."""

from __future__ import annotations

import numpy as np
import pytest

from service.model.transforms import Floats, quat_from_axis_angle, quat_multiply, quat_rotate
from tests.worker.hands.urdfs import joint, link, robot
from worker.hands.check import check_hand
from worker.hands.load import load_hand
from worker.hands.model import HandModel

RADIUS = 0.045


def rpy(matrix: Floats) -> str:
    pitch = np.arcsin(-np.clip(matrix[2, 0], -1, 1))
    return f"{np.arctan2(matrix[2, 1], matrix[2, 2]):.17g} {pitch:.17g} {np.arctan2(matrix[1, 0], matrix[0, 0]):.17g}"


def claw(fingers: int, turn: Floats, *, noise: float = 0.0, lower: float = -0.4) -> bytes:
    """Fingers of two links around the z axis, bending inwards; `turn` (4,) is where the axis goes in the root frame."""
    random = np.random.default_rng(fingers)
    matrix = np.stack([quat_rotate(turn, axis) for axis in np.eye(3)], axis=1)
    place = f'<origin xyz="{_at(matrix @ [0, 0, -0.015])}" rpy="{rpy(matrix)}"/>'
    palm = f'<collision>{place}<geometry><box size="0.09 0.09 0.03"/></geometry></collision>'
    parts = [link("palm", palm)]
    for k in range(fingers):
        about = quat_from_axis_angle(np.array([0, 0, 1.0]), np.asarray(2 * np.pi * k / fingers))
        frame = np.stack([quat_rotate(quat_multiply(turn, about), axis) for axis in np.eye(3)], axis=1)
        at = frame @ (np.array([RADIUS, 0, 0]) + noise * random.normal(size=3))
        parts += [link(f"a{k}", _bar(0.06)), link(f"b{k}", _bar(0.045))]
        bend = {"axis": "0 -1 0", "limit": f'<limit lower="{lower}" upper="1.4" effort="10"/>'}
        base = joint(f"ja{k}", "palm", f"a{k}", origin=_at(at), **bend)
        parts.append(base.replace("<origin xyz", f'<origin rpy="{rpy(frame)}" xyz'))
        parts.append(
            joint(
                f"jb{k}", f"a{k}", f"b{k}", origin="0 0 0.06", extra=f'<mimic joint="ja{k}" multiplier="0.7"/>', **bend
            )
        )
    return robot(*parts)


def _at(point: Floats) -> str:
    return " ".join(f"{value:.17g}" for value in point)


def _bar(length: float) -> str:
    place = f'<origin xyz="0 0 {length / 2}"/>'
    return f'<collision>{place}<geometry><box size="0.016 0.018 {length}"/></geometry></collision>'


def hand(data: bytes) -> HandModel:
    return load_hand({"h.urdf": data}, name="h", digest="0" * 32)


TURNS = {
    "upright": np.array([1.0, 0, 0, 0]),
    "on its side": quat_from_axis_angle(np.array([1.0, 0, 0]), np.asarray(np.pi / 2)),
    "upside down": quat_from_axis_angle(np.array([0, 1.0, 0]), np.asarray(np.pi)),
    "tilted": quat_from_axis_angle(np.array([0.6, 0.8, 0]), np.asarray(0.5)),
}


@pytest.mark.parametrize("fingers", [3, 4, 5, 6])
@pytest.mark.parametrize("turn", TURNS)
def test_the_palm_faces_along_the_fingers_and_all_of_them_close(fingers: int, turn: str) -> None:
    model = hand(claw(fingers, TURNS[turn]))
    axis = quat_rotate(TURNS[turn], np.array([0, 0, 1.0]))
    # Rounding of nine digits in the file; a direction within five degrees of a root axis is that axis.
    np.testing.assert_allclose(model.palm.approach, axis, atol=1e-6)
    assert (model.closing == 1).all()
    assert np.linalg.norm(model.palm.centre - (model.palm.centre @ axis) * axis) < 1e-6


@pytest.mark.parametrize("noise", [1e-12, 1e-9, 1e-6, 1e-4])
def test_rounding_does_not_turn_the_palm(noise: float) -> None:
    model = hand(claw(3, TURNS["upright"], noise=noise))
    np.testing.assert_allclose(model.palm.approach, [0, 0, 1], atol=1e-9)


def test_a_tie_is_told_and_one_that_is_settled_is_not() -> None:
    # Fingers that lie in the plane in which they begin, half closed: nothing tells its upper side.
    flat = claw(3, TURNS["upright"], lower=-np.pi)
    told = "the palm may face either way along its axis, a tie: say which with --approach"
    lying = flat.replace(b'lower="-3.141592653589793" upper="1.4"', b'lower="1.0707963" upper="2.0707963"').replace(
        b'multiplier="0.7"', b'multiplier="0"'
    )
    assert told in check_hand({"h.urdf": lying}, "h")["facts"]["notes"]
    assert told not in check_hand({"h.urdf": lying}, "h", {"approach": (0, 0, 1)})["facts"]["notes"]
    assert told not in check_hand({"h.urdf": claw(3, TURNS["upright"])}, "h")["facts"]["notes"]
