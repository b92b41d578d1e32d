"""The record of the maps of failure: what still breaks, and numbers short enough for a small square."""

import math

import pytest

from graspd.service.model import studies
from graspd.service.store.records import publish_record
from graspd.service.store.store import open_store


def a_map(*cells: studies.MapCell) -> studies.StabilityMap:
    return studies.StabilityMap(
        "demo", "A demo", "x", "y", "m", "b", list(cells), "s", "g", "", {"a": [(1.0, 2.0)]}, "r"
    )


_INF, _NAN = math.inf, math.nan
SHORT = {0.0: "0", 0.333: "0.33", 1.05: "1.1", 3.0: "3.0", 43.21: "43", 999.0: "999", 3.4e3: "3k", 5.2e5: "520k"}
SHORT |= {7.4e6: "7e6", 3.3e-5: "3e-5", -0.25: "-0.25", _INF: "∞", _NAN: ""}
TICKS = {1e-5: "1e-5", 3e-4: "3e-4", 0.001: "0.001", 30.0: "30", 1e5: "1e5", 12345.0: "12345", "draft": "draft"}


def test_numbers_on_cells_and_axes_are_short() -> None:
    assert [studies.format_short(value) for value in SHORT] == list(SHORT.values())
    assert max(len(studies.format_short(1.9999 * 10.0**k)) for k in range(-9, 9)) <= 5
    assert [studies.format_tick(value) for value in (*TICKS, 0.0)] == [*TICKS.values(), "0"]


def test_what_still_breaks_are_broken_cells_in_reach_of_a_job() -> None:
    broken = [(1.0, "draft"), (1.0, "fine"), (3.0, "draft"), (3.0, "fine"), (9.0, "fine")]
    one = a_map(
        *(studies.MapCell("a", x, y, 0.0, "broken", reached=True) for x, y in broken),
        studies.MapCell("a", 9.0, "draft", 0.9, "good", reached=True),
        studies.MapCell("b", 1.0, "draft", 0.0, "broken"),
        studies.MapCell("b", 2.0, "draft", 0.0, "refused", reached=True),
    )
    assert one.broken_cell_lines() == ["a 1, 3 (draft, fine); 9 (fine)"]
    assert studies.count_outcomes(one.reached()) == {"good": 1, "weak": 0, "broken": 5, "refused": 1}


def test_a_record_survives_the_store_without_odd_numbers() -> None:
    cells = [
        studies.MapCell("a", 1, 10.0, _INF, "broken", label="×∞"),
        studies.MapCell("a", "inside out", 10.0, _NAN, "refused"),
    ]
    record = studies.Stability("2026-11-21T12:00:00.000Z", "graspd stability", {"graspd": "0"}, [a_map(*cells)])
    assert (
        publish_record(open_store("memory://"), "stability", record.as_json()) == "stability/20261121T120000000Z.json"
    )
    found = studies.parse_stability(record.as_json())
    assert [cell.text for cell in found.maps[0].cells] == ["×∞", ""]
    assert found.maps[0].lines == {"a": [(1.0, 2.0)]}
    assert found.as_json() == record.as_json()
    with pytest.raises(ValueError, match="maps"):
        studies.parse_stability({"created": "now", "command": "c", "versions": {}})
