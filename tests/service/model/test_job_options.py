"""Options of a job that move some of its shards: a method's own, least distance, share of models, rechecks."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from graspd.service.model.digests import job_id
from graspd.service.model.domain import BATCH_SIZE, RECHECKS, JobRequest
from graspd.service.model.metrics import AXIS_MEANINGS, MIN_DISTANCE_M, ROBUST_MODELS, Axis, axis_word
from graspd.service.model.states import Stage
from tests.fakes import request
from tests.service.model.jobs import HAND, OBJECT, shard

BASE = Stage.SYNTHESIZE


def test_other_options_make_another_shard_of_grasps_alone() -> None:
    plain, changed = request(method="graspit"), request(method="graspit", options={"steps": 40_000})
    assert shard(BASE, plain) != shard(BASE, changed)
    assert shard(Stage.SCENE, plain) == shard(Stage.SCENE, changed)


def test_a_default_stays_out_of_documents_and_ids_and_another_value_moves_the_grasps() -> None:
    plain, document = request(), request().model_dump(mode="json")
    assert {"min_distance", "robust", "robust_models"}.isdisjoint(document)
    assert document == request(min_distance=MIN_DISTANCE_M).model_dump(mode="json")
    others = [request(min_distance=0.02), request(robust=0.5), request(robust_models=8)]
    assert len({job_id(one, HAND, OBJECT) for one in (plain, *others)}) == 4
    assert shard(BASE, others[0]) != shard(BASE, plain)
    assert [JobRequest.model_validate_json(one.model_dump_json()) for one in others] == others


def test_candidate_grasps_do_not_depend_on_the_distance() -> None:
    raw = request(want="candidates")
    assert shard(BASE, request(want="candidates", min_distance=0.02)) == shard(BASE, raw)


def test_a_wanted_share_is_of_eight_models_unless_told() -> None:
    assert (request().models, request(robust=0.9).models) == (0, ROBUST_MODELS)
    assert request(robust=0.9, scene="table").models == ROBUST_MODELS, "in scenes as around free objects"
    assert request(robust=0.9, robust_models=16).models == request(robust_models=16).models == 16


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"robust": 0.5, "validation": "none"}, "choose a validator"),
        ({"robust": 1.5}, "less than or equal to 1"),
        ({"robust": float("nan")}, "finite"),
        ({"robust_models": 65}, "less than or equal to 64"),
        *[({"min_distance": least}, "min_distance") for least in (-0.001, 0.2, float("nan"), float("inf"))],
        *[({"options": {name: value}}, "options") for name, value in (("x", float("nan")), ("x", [1]), ("x" * 41, 1))],
        ({"options": {f"o{i}": i for i in range(17)}}, "options"),
    ],
)
def test_what_is_no_such_option_is_refused(options: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        request(**options)


def test_every_axis_has_its_words_and_no_other_number_has() -> None:
    assert set(AXIS_MEANINGS) == set(Axis) - {Axis.NONE}
    assert [axis_word(number) for number in (0, 1, 9, 10, 255)] == [None, "shapes", "order", None, None]


#: The DexGraspBench protocol takes 6 pushes of 2 s and 0.8 s of closing, 3,200 steps of MuJoCo; a valid grasp has cost
#: some 450 steps at level standard, which are a third of its time (docs/explanation/performance.md).
STEPS_OF_A_RECHECK, STEPS_OF_A_GRASP = 3200, 3 * 450


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("batches", [2, 3, 4, 9, 16, 40])
def test_audits_of_the_default_take_a_twentieth_of_a_jobs_time(seed: int, batches: int) -> None:
    job = request(seed=seed)
    rechecks = [job.rechecks_of(batch) for batch in range(batches)]
    assert sum(rechecks) <= RECHECKS and max(rechecks) <= 1
    # A job of an odd number of batches may be one ahead.
    even = batches - batches % 2
    price = sum(rechecks[:even]) * STEPS_OF_A_RECHECK / (even * BATCH_SIZE * STEPS_OF_A_GRASP)
    assert price <= 0.05


def test_half_of_many_short_jobs_are_audited_and_a_long_one_has_all() -> None:
    first = [request(seed=seed).rechecks_of(0) for seed in range(200)]
    assert 70 < sum(first) < 130
    assert {first[k] + request(seed=k).rechecks_of(1) for k in range(200)} == {1}
    for seed in range(6):
        assert sum(request(seed=seed).rechecks_of(batch) for batch in range(100)) == RECHECKS


def test_any_other_number_is_of_the_first_grasps() -> None:
    assert [request(rechecks=40).rechecks_of(batch) for batch in range(3)] == [32, 8, 0]
    assert request(rechecks=40, validation="dexgraspbench").rechecks_of(0) == 0
