"""A few real grasps for the formats to carry."""

from __future__ import annotations

import pytest

from service.model.domain import FIDELITIES
from worker.engines import backend
from worker.grasps import GraspSet
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.objects.prepare import object_from_path
from worker.planners import synthesize
from worker.planners.port import Wanted


@pytest.fixture(scope="session")
def hand() -> HandModel:
    backend.start()
    return hand_from_path("barrett")


@pytest.fixture(scope="session")
def block() -> ObjectModel:
    return object_from_path("block")


@pytest.fixture(scope="session")
def grasps(hand: HandModel, block: ObjectModel) -> GraspSet:
    return synthesize(hand, block, Wanted(count=4, fidelity=FIDELITIES["draft"], seed=5))
