"""The optimizers that a simulation knows."""

from __future__ import annotations

from typing import get_args

import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import Fidelity
from graspd.worker.hands.load import hand_from_path
from graspd.worker.simulation.model import LossOptions
from graspd.worker.simulation.record import OPTIMIZERS, record_iteration
from tests.worker.simulation.rigs import ball, rig


@pytest.mark.parametrize("name", ["lbfgs", "Adam", ""])
def test_an_optimizer_that_nobody_knows_is_refused_in_one_line(name: str) -> None:
    model, data = rig(hand_from_path("barrett"), ball(), capacity=1, options=LossOptions())
    with pytest.raises(InputError, match=r"unknown optimizer '.*'; choose one of adam, gd$"):
        record_iteration(model, data, name)


def test_every_optimizer_of_a_fidelity_is_known() -> None:
    assert get_args(Fidelity.model_fields["optimizer"].annotation) == OPTIMIZERS
