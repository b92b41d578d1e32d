"""How many grasps of a job are rechecked: what the letter costs is bounded, and no dataset goes without."""

from __future__ import annotations

import pytest

from graspd.service.model.domain import BATCH_SIZE, RECHECKS
from tests.fakes import request

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


def test_half_of_many_short_jobs_are_audited() -> None:
    first = [request(seed=seed).rechecks_of(0) for seed in range(200)]
    assert 70 < sum(first) < 130
    assert {first[k] + request(seed=k).rechecks_of(1) for k in range(200)} == {1}


def test_a_long_job_has_all_of_them() -> None:
    for seed in range(6):
        assert sum(request(seed=seed).rechecks_of(batch) for batch in range(100)) == RECHECKS


def test_any_other_number_is_of_the_first_grasps() -> None:
    assert [request(rechecks=40).rechecks_of(batch) for batch in range(3)] == [32, 8, 0]
    assert [request(rechecks=3).rechecks_of(batch) for batch in range(2)] == [3, 0]
    assert request(rechecks=40, validation="dexgraspbench").rechecks_of(0) == 0
