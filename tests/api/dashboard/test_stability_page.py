"""The maps of failure on their page: laid out as pictures are, told in words."""

import math

from starlette.testclient import TestClient

from graspd.api.dashboard.figures import PITCH, draw_map
from graspd.service.model.studies import MapCell, Outcome, Stability, StabilityMap
from graspd.service.pipeline.backends import Services
from graspd.service.store.records import publish_record


def a_map(name: str = "stiffness", **changes: object) -> StabilityMap:
    found: dict[int, tuple[float, Outcome]] = {2: (0.5, "good"), 3: (0.75, "weak"), 4: (math.inf, "broken")}
    cells = [
        MapCell("penalty", 10.0**k, dt, value, outcome, f"note {k}", reached=k < 4)
        for dt in (1e-4, 0.01)
        for k, (value, outcome) in found.items()
    ]
    axes = {"name": name, "title": f"A map of {name}", "x": "stiffness [N/m]", "y": "time step [s]"}
    words = {"measure": "energy", "bounds": "weak: 1.02", "shows": "hands sink in", "reach": "the soft ones"}
    guard = {"guard": "`direct` has none", "guard_test": "tests/test_it.py::test_it"}
    lines = {"penalty": [(100.0, 0.01), (10000.0, 1e-4)]}
    fields = {"cells": cells, "lines": lines, **axes, **words, **guard}
    return StabilityMap(**{**fields, **changes})  # type: ignore[arg-type]


def a_record(created: str = "2026-11-21T12:00:00.000Z", **changes: object) -> dict[str, object]:
    shapes = a_map("shapes", lines={}, cells=[MapCell("mesh", "inside out", "fine", 0.0, "broken", reached=True)])
    return Stability(created, "graspd stability", {"graspd": "0"}, [a_map(**changes), shapes]).as_json()


def test_small_values_are_at_the_left_and_at_the_bottom() -> None:
    """A cell that was not measured is left open; the bound of theory goes through the middles of its cells."""
    (panel,) = draw_map(a_map()).panels
    assert panel.columns == ["100", "1000", "1e4"]
    assert [name for name, _ in panel.rows] == ["0.01", "1e-4"]
    assert [square.outcome for square in panel.rows[0][1] if square] == ["good", "weak", "broken"]
    width, height = PITCH
    first, last = (tuple(map(float, point.split(","))) for point in panel.line.split())
    assert (first, last) == ((width / 2, height / 2), (2.5 * width, 1.5 * height))
    (open_one,) = draw_map(a_map(cells=a_map().cells[:-1])).panels
    assert open_one.rows[0][1][2] is None
    shares = [(share.outcome, share.count, share.x, share.width) for share in draw_map(a_map()).reached]
    assert shares == [("good", 2, 0.0, 50.0), ("weak", 2, 50.0, 50.0)]


def test_words_along_the_bottom_stand_before_rows_instead() -> None:
    pairs = [(name, fidelity) for name in ("open", "inside out") for fidelity in ("draft", "fine")]
    cells = [MapCell("mesh", name, fidelity, 1.0, "good") for name, fidelity in pairs]
    (panel,) = draw_map(a_map(cells=cells, lines={})).panels
    assert (panel.columns, [name for name, _ in panel.rows]) == (["draft", "fine"], ["open", "inside out"])
    assert (panel.x, panel.y) == ("time step [s]", "stiffness [N/m]")


def test_the_page_shows_the_latest_maps_and_what_they_mean(http: TestClient, services: Services) -> None:
    publish_record(services.store, "stability", a_record("2026-11-21T13:00:00.000Z"))
    publish_record(services.store, "stability", a_record(measure="an older measure"))
    page = http.get("/stability").text
    assert "A map of stiffness" in page and "an older measure" not in page
    shown = ("energy", "weak: 1.02", "hands sink in", "direct has none", "tests/test_it.py::test_it", "the soft ones")
    cells = ("mesh inside out (fine)", "time step [s] 0.01: broken; note 4", "graspd stability")
    assert [words for words in shown + cells if words not in page] == []
