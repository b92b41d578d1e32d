"""Seeds of batches: what may look alike, and what may not."""

from __future__ import annotations

from typing import Any

import pytest

from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import Stage
from graspd.worker.stages.context import batch_seed
from tests.fakes import request


def message(**changes: Any) -> TaskMessage:
    fields = {
        "schema_": 1,
        "task_id": "t",
        "job_id": "j",
        "stage": Stage.RENDER,
        "batch": 0,
        "count": 32,
        "request": request(),
        "hand_digest": "a" * 32,
        "object_digest": "b" * 32,
        "output": "c" * 32,
    }
    return TaskMessage(**fields | changes)


@pytest.mark.parametrize(
    "changes",
    [
        {"batch": 1},
        {"stage": Stage.SCENE},
        {"hand_digest": "d" * 32},
        {"object_digest": "d" * 32},
        {"request": request(seed=7)},
    ],
)
def test_batches_stages_hands_objects_and_seeds_draw_anew(changes: dict[str, Any]) -> None:
    assert batch_seed(message(**changes)) != batch_seed(message())


def test_two_methods_show_their_grasps_in_the_same_pictures() -> None:
    assert batch_seed(message(request=request(method="graspit"), output="e" * 32)) == batch_seed(message())
