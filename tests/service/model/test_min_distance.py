"""The least distance of two grasps as a wish of a job: what it moves, and what it leaves as it was."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from graspd.service.model.digests import job_id, shard_id
from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.metrics import MIN_DISTANCE_M
from graspd.service.model.states import Stage

HAND, OBJECT = "a" * 32, "b" * 32


def wish(**fields: Any) -> JobRequest:
    return JobRequest(hand="allegro", object="mug", grasps=32, **fields)


def base(request: JobRequest) -> str:
    return shard_id(
        Stage.SYNTHESIZE, request=request, hand_digest=HAND, object_digest=OBJECT, batch=0, count=32, revision=11
    )


def test_its_default_stays_out_of_documents_and_ids() -> None:
    assert "min_distance" not in JobOptions(min_distance=MIN_DISTANCE_M).model_dump(mode="json")
    assert wish().model_dump_json() == wish(min_distance=MIN_DISTANCE_M).model_dump_json()
    assert job_id(wish(), HAND, OBJECT) == job_id(wish(min_distance=MIN_DISTANCE_M), HAND, OBJECT)


def test_another_distance_is_another_job_and_another_shard() -> None:
    far = wish(min_distance=0.02)
    assert JobRequest.model_validate_json(far.model_dump_json()).min_distance == 0.02
    assert job_id(far, HAND, OBJECT) != job_id(wish(), HAND, OBJECT) and base(far) != base(wish())


def test_candidate_grasps_do_not_depend_on_it() -> None:
    assert base(wish(want="candidates", min_distance=0.02)) == base(wish(want="candidates"))


@pytest.mark.parametrize("least", [-0.001, 0.2, float("nan"), float("inf")])
def test_what_is_no_such_distance_is_refused(least: float) -> None:
    with pytest.raises(ValidationError):
        wish(min_distance=least)
