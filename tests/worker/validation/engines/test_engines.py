"""What every installed engine must say of two pads and a box: the physics are known in closed form."""

import sys
from typing import Any

import numpy as np
import pytest

from graspd.service.model.domain import JobOptions
from graspd.service.model.engines import ENGINES
from graspd.service.model.errors import InputError
from graspd.service.store.validity import second_engine_counts
from graspd.studies.engines import summarise
from graspd.worker import generation
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.generation import score_grasps
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.validation.engines import registry
from graspd.worker.validation.engines.registry import (
    EngineVerdicts,
    check_engines,
    engine_columns,
    validate_with_engine,
)
from tests.worker.models import on_one_dof
from tests.worker.quality.helpers import BOX, PADS, WHOLE, posture
from tests.worker.validation.test_lift import BOX as STANDING
from tests.worker.validation.test_lift import HAND, PLACED, grasp

GRAVITY = 10.0  # [m/s^2], of the protocol
FORCE = 1.0  # of each pad [N]: so small that pushes along the pads' normals move their soft drives by 1 cm
FRICTION = 0.6
LIMIT = 2 * FRICTION * FORCE / GRAVITY  # mass that the pinch bears [kg]


def pinch(
    engine: str, *, mass: float = 0.05, friction: float = FRICTION, force: float = FORCE, hand: HandModel = PADS
) -> EngineVerdicts:
    """Two opposite pads on the middle of a box, each with a normal force [N]; a drive of both has twice the force."""
    shift = len(hand.joint_names) / hand.dofs * force / hand.stiffness[0]
    contact, open_hand = posture(((0, 0, 0), (0.065, 0.065))), posture(((0, 0, 0), (0.055, 0.055)))
    pressed = posture(((0, 0, 0), (0.065 + shift,) * 2))
    grasps = GraspSet(contact, open_hand, pressed, np.full(1, np.nan))
    obj, run = BOX.with_mass(mass=mass, friction=friction), ExecutionContext(threads=1)
    return validate_with_engine(engine, hand, obj, grasps, level="dexgraspbench", pieces=WHOLE, run=run)


@pytest.mark.parametrize(
    ("given", "held"),
    [
        ({"mass": 0.95 * LIMIT}, True),
        # At 1.05 of its weight the box accelerates by 0.48 m/s^2: 95 cm within a push, of which 5 cm are a loss.
        ({"mass": 1.05 * LIMIT}, False),
        ({"mass": 0.95 * LIMIT, "hand": on_one_dof(PADS)}, True),
        ({"mass": 1.05 * LIMIT, "hand": on_one_dof(PADS)}, False),
        ({"force": 0.0}, False),
        ({"friction": 1e-6}, False),
        # A third more than the pinch holds at friction 0.6, and too little to push the box off a pad.
        ({"mass": 0.16}, False),
        ({"mass": 0.16, "friction": 50.0}, True),
    ],
)
def test_a_pinch_holds_what_its_friction_bears(engine: str, given: dict[str, Any], held: bool) -> None:
    found = pinch(engine, **given)
    assert found.success.tolist() == [held] and (found.reasons == ("held",)) == held


def test_a_firm_squeeze_lifts_the_box_from_a_table_and_none_leaves_it(engine: str) -> None:
    given = {"level": "lift", "pieces": WHOLE, "run": ExecutionContext(threads=1)}
    firm, none = (validate_with_engine(engine, HAND, STANDING, grasp(d), PLACED, **given) for d in (0.05, -0.005))
    assert firm.success.tolist() == [1] and firm.margin[0] < 0.5
    assert none.reasons[0] in ("displaced", "not lifted")


def test_each_engine_says_what_it_holds_and_all_how_far_they_agree() -> None:
    verdicts = [
        EngineVerdicts(name, np.array(held, np.int8), ("held",) * 4, np.zeros(4), 1.0)
        for name, held in (("mujoco", [1, 1, 1, 0]), ("physx", [1, 1, 0, 0]), ("drake", [1, 0, 0, 1]))
    ]
    columns = engine_columns(verdicts)
    assert columns["quality/held_in"].tolist() == [7, 3, 1, 4]
    assert columns["quality/agreement"] == pytest.approx([1, 2 / 3, 2 / 3, 2 / 3])
    found = summarise([verdicts[:2], verdicts[:2]])
    assert found["success"] == {"mujoco": 0.75, "physx": 0.5} and found["core_ms"]["physx"] == 250.0  # 2 s for 8 grasps
    # Of 4 grasps 3 get equal verdicts; chance gives 3/4 * 1/2 + 1/4 * 1/2 = 1/2.
    assert found["pairs"][0]["agreement"] == 0.75 and found["pairs"][0]["kappa"] == 0.5
    assert found["pairs"][0]["only"] == [2, 0]


def test_an_engine_that_is_not_there_is_named_with_its_extra(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "sapien", None)
    monkeypatch.delitem(sys.modules, f"{registry.__package__}.physx", raising=False)
    with pytest.raises(InputError, match=r"engine physx needs sapien; run pip install 'graspd\[physx\]'"):
        check_engines(["physx"])
    with pytest.raises(InputError, match="unknown engine 'havok'"):
        check_engines(["mujoco", "havok"])


def firm_and_loose() -> GraspSet:
    """Grasps 0, 2 and 4 pinch the middle of a box; grasps 1, 3 and 5 do not squeeze it."""
    contact, open_hand, firm, loose = (((0, 0, 0), (at, at)) for at in (0.065, 0.055, 0.115, 0.065))
    return GraspSet(posture(*[contact] * 6), posture(*[open_hand] * 6), posture(*[firm, loose] * 3), np.full(6, np.nan))


@pytest.mark.parametrize("engine", ENGINES[1:], indirect=True)
def test_a_second_engine_validates_a_share_of_the_grasps_that_mujoco_holds(engine: str) -> None:
    request = JobOptions(grasps=6, second_engine=engine, second_engine_share=0.5)
    found = score_grasps(
        PADS, BOX, firm_and_loose(), request, pieces=lambda obj: WHOLE, run=ExecutionContext(threads=1)
    ).columns
    assert found["quality/success"].tolist() == [1, 0] * 3 and found["quality/valid"].tolist() == [1, 0] * 3
    # Half of three valid grasps, rounded up and evenly spaced.
    both = 1 + (1 << ENGINES.index(engine))
    assert found["quality/held_in"].tolist() == [both, 0, both, 0, 1, 0]
    np.testing.assert_array_equal(found["quality/agreement"], [1, np.nan, 1, np.nan, np.nan, np.nan])
    assert second_engine_counts(found) == {"second_tested": 2, "second_held": 2}


def test_robust_grasps_hold_in_all_engines(monkeypatch: pytest.MonkeyPatch) -> None:
    """A stand-in drops every other grasp that it receives: only the others count."""

    def validate_every_other(name: str, hand: HandModel, obj: object, grasps: GraspSet, *_: object, **__: object):
        held = (np.arange(len(grasps)) % 2 == 0).astype(np.int8)
        return EngineVerdicts(name, held, (), np.zeros(len(grasps)), 0.0)

    monkeypatch.setattr(generation, "check_engines", tuple)
    monkeypatch.setattr(generation, "validate_with_engine", validate_every_other)
    request = JobOptions(grasps=6, second_engine="all", robust=0.5, robust_models=1)
    scoring = {"scenes": None, "pieces": lambda obj: WHOLE, "run": ExecutionContext(threads=1)}
    with generation.Scoring(PADS, BOX, request, **scoring) as work:
        made = work.evaluate(firm_and_loose(), ExecutionContext(threads=1))
    assert made.fates.tolist() == ["kept", "turned", "not_robust", "turned", "kept", "turned"]
    assert made.columns["quality/held_in"].tolist() == [7, 7]


def test_the_first_trial_uses_the_scene_that_was_built(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("sapien", reason="extra physx")
    from graspd.worker.validation.engines.physx import PhysxSimulation

    built = list[PhysxSimulation]()
    build = PhysxSimulation._build
    monkeypatch.setattr(PhysxSimulation, "_build", lambda self: (built.append(self), build(self))[1])
    grasps, run = firm_and_loose().take([0, 0, 0]), ExecutionContext(threads=1)
    found = validate_with_engine("physx", PADS, BOX, grasps, pieces=WHOLE, run=run)
    assert len(built) == 3 and len(set(found.margin)) == 1
