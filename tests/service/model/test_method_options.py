"""A method's own options in a job: part of what its grasps follow from."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from service.model.digests import shard_id
from service.model.domain import JobRequest
from service.model.states import Stage
from tests.fakes import request


def shard(stage: Stage, wanted: JobRequest) -> str:
    return shard_id(stage, request=wanted, hand_digest="a", object_digest="b", batch=0, count=32, revision=1)


def test_other_options_make_another_shard_of_grasps_alone() -> None:
    plain, changed = request(method="graspit"), request(method="graspit", options={"steps": 40_000})
    assert shard(Stage.SYNTHESIZE, plain) != shard(Stage.SYNTHESIZE, changed)
    assert shard(Stage.SCENE, plain) == shard(Stage.SCENE, changed)


@pytest.mark.parametrize("options", [{"x": float("nan")}, {"x": [1]}, {"x" * 41: 1}, {f"o{i}": i for i in range(17)}])
def test_options_that_are_no_plain_values_are_refused(options: dict[str, object]) -> None:
    with pytest.raises(ValidationError):
        request(options=options)
