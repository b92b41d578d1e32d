"""What every installed engine must say of two pads and a box: the physics are known in closed form."""

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.validation.engines.registry import ENGINES, EngineVerdicts, check_engines, validate_with_engine
from tests.worker.quality.helpers import BOX, PADS, WHOLE, posture

GRAVITY = 10.0  # [m/s^2], of the protocol
FORCE = 1.0  # of each pad [N]: so small that pushes along the pads' normals move their soft drives by 1 cm
FRICTION = 0.6


@pytest.fixture(params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    try:
        check_engines([request.param])
    except InputError as missing:
        pytest.skip(str(missing))
    return str(request.param)


def pinch(engine: str, *, mass: float = 0.05, friction: float = FRICTION, force: float = FORCE) -> EngineVerdicts:
    """Two opposite pads on the middle of a box, each with a normal force [N]."""
    contact, open_hand = posture(((0, 0, 0), (0.065, 0.065))), posture(((0, 0, 0), (0.055, 0.055)))
    pressed = posture(((0, 0, 0), (0.065 + force / PADS.stiffness[0],) * 2))
    grasps = GraspSet(contact, open_hand, pressed, np.full(1, np.nan))
    obj, run = BOX.with_mass(mass=mass, friction=friction), ExecutionContext(threads=1)
    return validate_with_engine(engine, PADS, obj, grasps, level="dexgraspbench", pieces=WHOLE, run=run)


def test_a_pinch_holds_95_percent_of_its_weight_and_drops_105_percent(engine: str) -> None:
    limit = 2 * FRICTION * FORCE / GRAVITY
    assert pinch(engine, mass=0.95 * limit).reasons == ("held",)
    # At 1.05 of its weight the box accelerates by 0.48 m/s^2: 95 cm within a push, of which 5 cm are a loss.
    assert pinch(engine, mass=1.05 * limit).success.tolist() == [0]


def test_without_squeeze_the_box_drops(engine: str) -> None:
    assert pinch(engine, force=0.0).success.tolist() == [0]


def test_without_friction_the_box_drops_and_glue_holds_it(engine: str) -> None:
    assert pinch(engine, friction=1e-6).success.tolist() == [0]
    # A third more than the pinch holds at friction 0.6, and too little to push the box off a pad.
    assert pinch(engine, mass=0.16).success.tolist() == [0]
    assert pinch(engine, mass=0.16, friction=50.0).reasons == ("held",)
