"""What is said where fewer grasps were found than asked."""

from __future__ import annotations

from service.model.outcomes import shortfall, totals


def test_all_that_were_asked_for_need_no_reason() -> None:
    assert shortfall(8, 8, "valid", 12, 4, {"slipped": 4}) is None


def test_the_counts_are_told_the_most_frequent_first() -> None:
    lost = totals([{"slipped": 4, "no_place": 1}, {"slipped": 1, "turned": 2, "alike": 0}])
    assert lost == {"no_place": 1, "turned": 2, "slipped": 5}
    assert shortfall(0, 2, "valid", 8, 4, lost) == (
        "found 0 of 2 valid grasps in 8 tries: 5 slipped, 2 turned in the hand, 1 without a clear place or way in the "
        "scene; the budget of 4 tries for each ended first"
    )


def test_an_outcome_of_a_newer_version_is_told_by_its_name() -> None:
    assert "3 fell apart" in str(shortfall(0, 2, "valid", 8, 4, totals([{"fell_apart": 3}])))
