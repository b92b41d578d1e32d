"""The self-test of a hand: objects that suit it, and a line that says whether it is ready."""

from dataclasses import replace
from itertools import count
from types import SimpleNamespace

import numpy as np
import pytest

from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.states import AssetKind
from graspd.service.store.asset_summary import summary
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import oppositions_of
from graspd.worker.objects.model import ObjectModel
from graspd.worker.stages import hand_self_test
from graspd.worker.stages.hand_self_test import SelfTest, fitting_width, plain_objects, self_test, tried_softly
from graspd.worker.validation.payload import Limit
from tests.worker.hands.urdfs import OPENING, gripper, joint, link, robot

_PALM = '<collision><geometry><box size="0.09 0.09 0.02"/></geometry></collision>'
_FINGER = '<collision><origin xyz="0 0 0.05"/><geometry><box size="0.012 0.012 0.1"/></geometry></collision>'


def held(count: int):
    ones = np.ones(count)
    columns = {f"quality/{name}": ones for name in ("success", "verdict_margin")}
    columns |= {f"quality/{name}": ones[:, None] for name in ("epsilon", "verdict_outcome")}
    return SimpleNamespace(columns=columns, grasps=SimpleNamespace(grasp=SimpleNamespace(take=lambda rows: None)))


def test_objects_are_as_wide_as_suits_the_opening() -> None:
    width = fitting_width(gripper())
    assert width == pytest.approx(hand_self_test.OF_OPENING * OPENING)
    for obj in plain_objects(width).values():
        # A sphere of triangles lies inside the true one by less than a hundredth.
        assert np.ptp(obj.vertices, axis=0).min() == pytest.approx(width, rel=0.01)


def test_verdict_is_that_of_tables_and_tells_of_weak_free_grasps() -> None:
    held = SelfTest(0.91, 64, 0.04, {"box": 0.9, "sphere": 0.92}, 0.6, 16)
    assert held.line == "ready: 91 % hold, 60 % lift off a table"
    dropped = replace(held, gsr=0.5, by_object={"box": 0.1, "sphere": 0.9})
    free = "ready for tables: 60 % lift off a table; of free grasps 50 % hold, 10 % of a box; most objects slip"
    assert dropped.line.startswith(free)
    assert "lost while the hand closes" in replace(dropped, lost=0.8).line
    assert "within 0.9 mm of fingertip motion" in replace(dropped, give_m=0.9e-3).line
    assert replace(held, table=0.55).line.startswith("suspicious: 91 % hold, but 55 % lift off a table")
    assert replace(dropped, table=0.55).line.startswith("suspicious: 50 % hold, 55 % lift off a table, 10 % of a box")


def test_what_a_hand_lifts_at_best_is_a_line_of_its_check() -> None:
    limit = Limit("claw", 0.6, 16, 1.44, 4.53)
    held = SelfTest(0.91, 64, 0.04, {"box": 0.9}, 0.8, 16, limit=limit)
    facts = held.facts()
    assert (facts["table_n"], facts["limit"]["lifts_kg"], facts["limit"]["bound_kg"]) == (16, 1.44, 4.53)
    first, second = summary(AssetKind.HAND, {"self_test": facts})
    assert "ready: 91 % hold" in first and "claw lifts 1.4 kg" in second and "at most 4.5 kg" in second
    assert replace(limit, bound_kg=np.inf).facts()["bound_kg"] is None
    assert len(summary(AssetKind.HAND, {"self_test": replace(held, limit=None).facts()})) == 1


def three_fingers(**options) -> HandModel:
    fingers = [link(f"finger{k}", _FINGER) for k in range(3)]
    for k, (x, y) in enumerate(((0.03, 0.0), (-0.015, 0.026), (-0.015, -0.026))):
        fingers.append(joint(f"bend{k}", "palm", f"finger{k}", origin=f"{x} {y} 0.01", axis=f"{y} {-x} 0"))
    urdf = robot(link("palm", _PALM), *fingers)
    return load_hand({"r.urdf": urdf}, name="r", digest="0" * 32, options=options)


def test_a_finger_of_one_joint_reaches_to_its_pad() -> None:
    hand = three_fingers(approach=[0, 0, 1])
    assert jaws_of(hand) is None
    # Its joints lie 30 mm from the palm's middle, its pads beyond half of the 100 mm of a finger.
    assert hand_self_test.OF_REACH * 0.05 < fitting_width(hand) < hand_self_test.OF_REACH * 0.11


def test_objects_are_no_thinner_than_opposed_pads_come_together(monkeypatch: pytest.MonkeyPatch) -> None:
    hand = hand_from_path("barrett")
    known, width = oppositions_of(hand), fitting_width(hand)
    assert known.width[0] < width
    thick = replace(known, width=known.width + 0.03)
    monkeypatch.setattr("graspd.worker.stages.hand_self_test.oppositions_of", lambda hand: thick)
    assert fitting_width(hand) == pytest.approx(thick.width[0])
    assert width < thick.width[0] < hand_self_test.WIDTH_M[1]


def test_a_busy_machine_leaves_nothing_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.monotonic", count(0.0, 1e4).__next__)

    def batches(hand: HandModel, obj: ObjectModel, count: int, run: ExecutionContext):
        run.progress(1, 10, "planning")
        run.check("planning")
        return [held(count)]

    monkeypatch.setattr(hand_self_test, "_batches", batches)
    monkeypatch.setattr(hand_self_test, "_lifted", lambda hand, obj, count, run: (count, 0.5, None))
    found = tried_softly(gripper)
    assert (found["table_n"], found["table"]) == (16, 0.5)
    assert (found["n"], sorted(found["by_object"])) == (64, ["box", "cylinder", "sphere"])


def test_a_servo_that_is_stiff_for_its_limit_gives_little() -> None:
    """0.1 N m at 20 N m/rad are 5 mrad, and the pad lies 50 to 100 mm from its joint."""
    hand = three_fingers(effort=0.1, stiffness=20.0)
    assert 0.005 * 0.05 < hand_self_test._give(hand) < 0.005 * 0.1 and hand_self_test._give(gripper()) == np.inf


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (InputError("no way in"), "suspicious: no way in"),
        (ValueError("array"), "not tried: the test itself failed (ValueError)"),
    ],
)
def test_a_test_that_ends_badly_is_told_and_stops_nothing(error: Exception, says: str, monkeypatch) -> None:
    def breaks(hand: HandModel, run: ExecutionContext) -> SelfTest:
        raise error

    monkeypatch.setattr(hand_self_test, "self_test", breaks)
    assert tried_softly(gripper)["says"] == says
    monkeypatch.undo()
    with pytest.raises(TaskCancelled):
        tried_softly(gripper, ExecutionContext(cancelled=lambda: True))


@pytest.mark.slow
def test_a_parallel_gripper_holds_what_fits() -> None:
    found = self_test(gripper(), grasps=12, on_table=6)
    assert (found.n, found.table_n, found.limit.grasps) == (12, 6, 6)
    assert found.gsr >= 0.7 and found.table >= 0.6 and 0.1 < found.limit.lifts_kg <= found.limit.bound_kg
