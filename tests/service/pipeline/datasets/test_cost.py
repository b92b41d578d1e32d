"""What a dataset will cost: measured rates where there are any, stored ones with their origin where there are none."""

from typing import Any

import pytest

from graspd.service.index.queries import rates
from graspd.service.index.queries.overview import BatchCost
from graspd.service.model.domain import JobOptions, JobRequest
from graspd.service.model.errors import NotFoundError
from graspd.service.model.states import Stage
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets.cost import estimate
from graspd.service.pipeline.datasets.spec import Estimate
from tests.service.pipeline.datasets.makers import done, wanted

#: Seconds that a stage of the fakes says it took.
FAKE_SECONDS = 0.5


def run(services: Services, **changes: object) -> Estimate:
    """A dataset of one batch a cell, done; the estimate of the same."""
    done(services, **changes)
    return estimate(services.index, wanted(**changes))


def test_what_was_measured_is_what_it_costs(either: Services) -> None:
    found = run(either, want="candidates")
    assert found.seconds == pytest.approx(4 * FAKE_SECONDS)
    assert (found.cells, found.tasks, found.asked, found.candidates) == (4, 4, 128, 128)
    assert found.storage_bytes == either.index.datasets.get("grasps").size_bytes
    assert found.valid == either.index.datasets.get("grasps").valid
    assert found.measured_share == 1 and found.unknown == []
    assert (found.counted, estimate(either.index, wanted(validation="none")).counted) == ("valid", "feasible")
    assert {rate.origin for rate in found.rates} == {
        f"measured here: {hand} on {obj}, cpu" for hand in ("gripper", "claw") for obj in ("ball", "cube")
    }


def test_scenes_cost_their_share(services: Services) -> None:
    found = run(services, want="candidates", scenes=2)
    assert found.seconds_by_stage == pytest.approx({"synthesize": 4 * FAKE_SECONDS, "scene": 4 * FAKE_SECONDS})
    assert found.storage_bytes == services.index.datasets.get("grasps").size_bytes
    longer = estimate(services.index, wanted(want="candidates", scenes=4))
    assert longer.seconds_by_stage["scene"] == pytest.approx(8 * FAKE_SECONDS)


def test_valid_grasps_cost_the_tries_that_fail(services: Services) -> None:
    run(services)
    one = estimate(services.index, wanted(hands=("claw",), objects=("cube",), grasps=3200, budget=100))
    (rate,) = one.rates
    assert one.valid == 3200 and one.candidates == round(3200 / rate.valid_yield)
    assert one.seconds == pytest.approx(3200 * rate.seconds_per_valid)
    scarce = estimate(services.index, wanted(hands=("claw",), objects=("cube",), grasps=3200, budget=1))
    assert scarce.candidates == 3200 and scarce.valid == round(3200 * rate.valid_yield)


def test_another_object_takes_the_hand_another_hand_takes_all(services: Services) -> None:
    run(services, hands=("claw",), objects=("cube",))
    for hand, obj, words in (
        ("claw", "cube", "measured here: claw on cube, cpu"),
        ("claw", "cone", "measured here: claw on other objects, cpu"),
        ("gripper", "cone", "measured here: other hands and objects, cpu"),
    ):
        found = estimate(services.index, wanted(hands=(hand,), objects=(obj,)))
        assert [rate.origin for rate in found.rates] == [words]


def test_a_small_batch_says_less_than_a_whole_one(services: Services) -> None:
    few = {"hands": ("claw",), "objects": ("cube",), "want": "candidates"}
    done(services, "few", grasps=2, **few)
    (small,) = estimate(services.index, wanted(**few)).rates
    assert small.seconds_per_try == pytest.approx(FAKE_SECONDS / 2)
    (whole,) = run(services, **few).rates
    assert whole.seconds_per_try == pytest.approx(FAKE_SECONDS / 32)


def test_another_recipe_is_not_measured_by_this_one(services: Services) -> None:
    annealed = {"method": "graspit", "options": {"keep": 20, "steps": 40000}}
    assert run(services, **annealed).measured_share == 1
    others = ({"method": "graspit"}, annealed | {"fidelity": "draft"}, annealed | {"validation": "fast"})
    for changes in (*others, annealed | {"want": "candidates"}):
        found = estimate(services.index, wanted(**changes))
        assert all(rate.origin.startswith(rates.ORIGIN) for rate in found.rates) and found.measured_share == 0


def test_one_measured_fidelity_scales_the_stored_rates_of_all(services: Services) -> None:
    """So fidelities stand in the order of their cost; and so do scenes and pictures."""
    fresh = estimate(services.index, wanted(scenes=2, views=2)).seconds_by_stage
    done = run(services)
    factor = done.rates[0].seconds_per_try / rates.STORED["standard"][0]
    assert done.machine_factor == pytest.approx(factor)
    for changes, stored in (
        ({"fidelity": "draft"}, rates.STORED["draft"]),
        ({"fidelity": "fine"}, rates.STORED["fine"]),
        ({"method": "graspit"}, rates.STORED_OTHER["graspit"]),
    ):
        (rate,) = {rate.seconds_per_try for rate in estimate(services.index, wanted(**changes)).rates}
        assert rate == pytest.approx(factor * stored[0])
    names = ("draft", "standard", "fine")
    draft, standard, fine = (estimate(services.index, wanted(fidelity=name)).seconds for name in names)
    assert draft < standard < fine
    scaled = estimate(services.index, wanted(scenes=2, views=2)).seconds_by_stage
    for stage in ("scene", "render"):
        assert scaled[stage] == pytest.approx(factor * fresh[stage])  # type: ignore[index]


def test_an_interval_holds_the_estimate_and_shrinks(services: Services) -> None:
    unknown = estimate(services.index, wanted(fidelity="fine"))
    assert unknown.machine_factor is None
    run(services)
    scaled, measured = estimate(services.index, wanted(fidelity="fine")), estimate(services.index, wanted())
    widths = []
    for found in (unknown, scaled, measured):
        for one in (found, *found.plans):
            assert one.seconds_low < one.seconds < one.seconds_high
        widths.append(found.seconds_high / found.seconds_low)
    assert widths == sorted(widths, reverse=True) and len(set(widths)) == 3


def test_batches_that_differ_widen_the_interval() -> None:
    of, sizes = ("claw", "cube", "cpu", JobRequest(hand="claw", object="cube")), (32, 32, 32, 1000)
    both = ([BatchCost(*of, one, *sizes) for one in times] for times in ((5.0, 5.0, 5.0), (1.0, 5.0, 25.0)))
    even, uneven = map(rates.measure_machine, both)
    assert even.factor == uneven.factor
    assert uneven.stored_spread[0] < even.stored_spread[0] < even.stored_spread[1] < uneven.stored_spread[1]


@pytest.mark.parametrize(
    ("changes", "words", "stored"),
    [
        ({"fidelity": {"starts": 3}}, "value of standard (none for custom)", rates.STORED["standard"]),
        ({"method": "mine"}, "value of fast_graspd (none for mine)", rates.STORED["standard"]),
        ({"method": "graspit"}, "graspit", rates.STORED_OTHER["graspit"]),
    ],
)
def test_what_nobody_measured_says_what_stands_in(services: Services, changes: Any, words: str, stored: Any) -> None:
    found = estimate(services.index, wanted(**changes))
    assert {(rate.origin, rate.seconds_per_try) for rate in found.rates} == {(f"{rates.ORIGIN}, {words}", stored[0])}


def test_a_million_grasps_on_one_eight_and_sixty_four_workers(services: Services) -> None:
    found = estimate(services.index, wanted(hands=("claw",), objects=("cube",), grasps=1_000_000, scenes=2, views=3))
    assert found.tasks == 3 * 31_250 and found.asked == 1_000_000
    one, eight, many = found.plans
    assert (one.workers, eight.workers, many.workers) == (1, 8, 64)
    # Rounds of whole batches: at most one of 489 more than an even split.
    assert one.seconds / eight.seconds == pytest.approx(8, rel=1e-3)
    assert one.seconds / many.seconds == pytest.approx(64, rel=1 / 489)
    assert set(found.storage_by_kind) == {"base", "scene", "views"}
    assert one.network_bytes > found.storage_bytes


def test_what_is_not_known_yet_is_named_and_estimated(services: Services) -> None:
    found = estimate(services.index, wanted(hands=("claw", "foot"), objects=("moon",)))
    assert found.unknown == ["foot", "moon"] and found.seconds > 0
    _, eight, many = found.plans
    assert eight.seconds == many.seconds, "more workers than batches do not help"
    with pytest.raises(NotFoundError, match="no set of objects"):
        estimate(services.index, wanted(sets=("none",)))


def test_grasps_in_scenes_have_a_price_of_their_own(services: Services) -> None:
    """Neither are free grasps measured for them, nor do they tell what free ones cost."""
    run(services, scenes=2)
    stored = estimate(services.index, wanted(scene="table", scenes=2))
    assert {rate.batches for rate in stored.rates} == {0} and all("in a scene" in rate.origin for rate in stored.rates)
    assert stored.candidates > estimate(services.index, wanted(scenes=2)).candidates
    assert stored.storage_by_kind["scene"] == 4 * 2 * rates.STORED_PLACE.size_bytes
    done(services, "placed", scene="table", scenes=2)
    placed = estimate(services.index, wanted(scene="table", scenes=2))
    assert placed.measured_share == 1 and placed.seconds_by_stage["scene"] == pytest.approx(4 * FAKE_SECONDS)


def test_an_episode_costs_as_stored_then_as_one_of_the_same_robot_and_cameras() -> None:
    made = JobRequest(hand="h", object="o", scene="table", episodes="flying")
    batches = [
        BatchCost("h", "o", "cpu", made, seconds, count, count, count, size)
        for seconds, count, size in ((8.0, 4, 40_000), (0.1, 0, 9))
    ]
    found = {
        robot: rates.episode_rate(
            batches, JobOptions(scene="table", episodes=robot, film=film), rates.Machine(factor=2.0)
        )
        for robot, film in (("flying", ()), ("franka", ("scene", "wrist")))
    }
    assert (found["flying"].seconds, found["flying"].size_bytes, found["flying"].batches) == (2.0, 10_000, 1)
    stored = [one + 2 * film for one, film in zip(rates.STORED_EPISODE, rates.STORED_FILM, strict=True)]
    assert [found["franka"].seconds / 2, found["franka"].size_bytes] == stored


def test_an_estimate_has_the_stage_of_episodes(services: Services) -> None:
    plain, filmed = (estimate(services.index, wanted(scene="table", **more)) for more in ({}, {"episodes": "flying"}))
    assert filmed.tasks - plain.tasks == plain.cells
    assert filmed.seconds - plain.seconds == pytest.approx(filmed.seconds_by_stage[Stage.EPISODE])
    assert filmed.seconds_by_stage[Stage.EPISODE] == pytest.approx(plain.valid * rates.STORED_EPISODE[0], rel=0.01)
    assert filmed.storage_by_kind["episodes"] > 0


def test_other_models_cost_what_they_take_of_each_valid_grasp(services: Services) -> None:
    told = [estimate(services.index, wanted(**models)) for models in ({}, {"robust": 0.9}, {"robust_models": 16})]
    none, eight, sixteen = (one.seconds_by_stage["synthesize"] for one in told)
    assert eight - none == pytest.approx(8 * rates.STORED_MODEL_S * told[0].valid, rel=0.01)
    assert sixteen - none == pytest.approx(2 * (eight - none), rel=0.01)
    assert all("16 models" in rate.origin for rate in told[2].rates)
