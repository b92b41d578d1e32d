"""What a job says of other models: options, ids, words."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from graspd.service.model.digests import job_id
from graspd.service.model.domain import JobRequest
from graspd.service.model.metrics import AXIS_MEANINGS, ROBUST_MODELS, Axis, axis_word


def request(**options: object) -> JobRequest:
    return JobRequest.model_validate({"hand": "allegro", "object": "mug", **options})


def test_a_wanted_share_is_of_eight_models_unless_told() -> None:
    assert (request().models, request(robust=0.9).models) == (0, ROBUST_MODELS)
    assert request(robust=0.9, scene="table").models == ROBUST_MODELS, "in scenes as around free objects"
    assert request(robust=0.9, robust_models=16).models == request(robust_models=16).models == 16


def test_jobs_without_it_keep_their_documents_and_ids() -> None:
    assert {"robust", "robust_models"}.isdisjoint(request().model_dump(mode="json"))
    ids = {job_id(one, "h" * 32, "o" * 32) for one in (request(), request(robust=0.5), request(robust_models=8))}
    assert len(ids) == 3
    again = JobRequest.model_validate(request(robust=0.9).model_dump(mode="json"))
    assert again == request(robust=0.9)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"robust": 0.5, "validation": "none"}, "choose a validator"),
        ({"robust": 1.5}, "less than or equal to 1"),
        ({"robust": float("nan")}, "finite"),
        ({"robust_models": 65}, "less than or equal to 64"),
    ],
)
def test_what_cannot_be_validated_is_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        request(**options)


def test_every_axis_has_its_words_and_no_other_number_has() -> None:
    assert set(AXIS_MEANINGS) == set(Axis) - {Axis.NONE}
    assert [axis_word(number) for number in (0, 1, 9, 10, 255)] == [None, "shapes", "order", None, None]
