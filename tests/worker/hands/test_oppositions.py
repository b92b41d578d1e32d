"""Postures in which fingers oppose one another: at pads, on a plane, beside pads; who has none is refused."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import HandError
from graspd.service.model.transforms import IDENTITY_POSE, apply, quat_rotate
from graspd.worker.generation import validated_grasps
from graspd.worker.hands import pinch_postures as oppositions
from graspd.worker.hands.flat_pinches import HEIGHTS_M, OVER_M, pinches_of
from graspd.worker.hands.grasp_widths import Size, spans_of
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import oppositions_of
from graspd.worker.hands.surface import sample_surface
from tests.worker.hands.grippers import gripper
from tests.worker.hands.urdfs import BOX, joint, link, robot
from tests.worker.models import object_from_mesh


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


def test_a_wide_hand_opposes_over_a_range_one_finger_nothing() -> None:
    widths = oppositions_of(hand_from_path("barrett")).width
    assert widths[0] < 0.08 < 0.12 < widths[-1]
    hand = hand_from_path("barrett")
    alone = oppositions_of(replace(hand, name="alone", fingertips=hand.fingertips[:1]))
    assert len(alone) == 0
    assert alone.widest == 0.0


HEIGHT_M = 0.012


@pytest.mark.parametrize("name", ["allegro", "barrett", "shadow"])
def test_opposed_fingertips_end_on_one_plane_and_none_is_as_low(name: str) -> None:
    hand, found = hand_from_path(name), pinches_of(hand_from_path(name), HEIGHT_M)
    assert len(found) >= 20
    assert (np.diff(found.width) >= 0).all()
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
    assert len(pinches_of(hand, HEIGHTS_M[-1] + 1e-4)) == 0
    assert len(pinches_of(replace(hand, name="alone", fingertips=hand.fingertips[:1]), HEIGHT_M)) == 0


@pytest.mark.parametrize("size", ["small", "wide"])
def test_hand_looks_at_thing_from_both_sides_and_leaves_it_room(size: Size) -> None:
    hand = hand_from_path("allegro")
    found, points = spans_of(hand, size), sample_surface(hand, 3000)
    assert len(found) >= 10
    assert ((found.q >= hand.lower) & (found.q <= hand.upper)).all()
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
    pads = oppositions_of(hand).width
    assert spans_of(hand, "small").width[0] < pads[0] - 0.005
    assert spans_of(hand, "wide").width[-1] > pads[-1] + 0.005


def pointer() -> HandModel:
    """A stick of three links that bends a little: none of them ever faces another."""
    bends = '<limit lower="0" upper="0.3" effort="1" velocity="1"/>'
    thin = BOX.replace("0.02 0.02 0.04", "0.01 0.01 0.04")
    joints = joint("one", "a", "b", limit=bends), joint("two", "b", "c", limit=bends)
    files = {"pointer.urdf": robot(*(link(name, thin) for name in "abc"), *joints)}
    return load_hand(files, name="pointer", digest="0" * 32)


def test_without_opposing_digits_grasps_are_not_even_planned() -> None:
    ball = object_from_mesh(trimesh.creation.icosphere(2, 0.02))
    with pytest.raises(HandError, match=r"pointer: no two opposing digits.*--root"):
        validated_grasps(pointer(), ball, JobOptions(want="candidates", grasps=1), count=1)


def test_what_a_hand_can_hold_is_asked_once_on_a_machine(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    # Without the cache in memory, as a process that begins.
    assert [oppositions._can_hold.__wrapped__(hand) for hand in (gripper(), pointer())] == [True, False]
    monkeypatch.setattr(oppositions, "opposes", lambda hand: pytest.fail("asked again"))
    assert [oppositions._can_hold.__wrapped__(hand) for hand in (gripper(), pointer())] == [True, False]
