"""What is said where fewer grasps were found than asked."""

from __future__ import annotations

import math

from graspd.service.model.planning import limit_told, shortfall, totals


def test_all_that_were_asked_for_need_no_reason() -> None:
    assert shortfall(8, 8, "valid", 12, 4, {"slipped": 4}) is None


def test_the_counts_are_told_the_most_frequent_first() -> None:
    lost = totals([{"slipped": 4, "no_place": 1}, {"slipped": 1, "turned": 2, "alike": 0}])
    assert lost == {"no_place": 1, "turned": 2, "slipped": 5}
    assert shortfall(0, 2, "valid", 8, 4, lost) == (
        "found 0 of 2 valid grasps in 8 candidates: 5 slipped, 2 turned in the hand, 1 without a clear place or way in "
        "the scene; the budget of 4 candidates for each ended first"
    )


def test_repeated_attempts_are_tries_of_the_budget() -> None:
    said = str(shortfall(1, 4, "valid", 7, 4, {"not_lifted": 6, "repeated": 9}))
    assert said.startswith(
        "found 1 of 4 valid grasps in 16 candidates: 9 repeated attempts, 6 not lifted; the budget of 4"
    )


def test_a_limit_of_the_hand_stands_where_the_budget_would() -> None:
    limit = limit_told("barrett", 0.6, 16, 5.66, math.inf, 100.0)
    assert limit == "barrett lifts 5.7 kg at friction 0.6 in the best of 16 grasps; 100 kg are wanted"
    assert str(shortfall(0, 4, "valid", 4, 4, {}, limit)) == f"found 0 of 4 valid grasps in 4 candidates; {limit}"


def test_an_outcome_of_a_newer_version_is_told_by_its_name() -> None:
    assert "3 fell apart" in str(shortfall(0, 2, "valid", 8, 4, totals([{"fell_apart": 3}])))
