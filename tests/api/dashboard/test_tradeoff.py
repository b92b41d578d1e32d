"""Charts of speed against accuracy and maps of failure on their pages: points, front, layout, words."""

import itertools
import json
import math
import re
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.testclient import TestClient

from graspd.api.dashboard.figures import PITCH, draw_panel
from graspd.api.dashboard.tradeoff import HEIGHT, WIDTH, PublishedChart, draw_chart
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.studies import FILTERED, IN_SCENE, MapCell, Outcome, Stability, StabilityMap, pareto_front
from graspd.service.pipeline.backends import Services
from graspd.service.store.records import publish_record


def run(fidelity: str, speed: float, gsr: float, **fields: object) -> dict[str, object]:
    known = {"method": "fast_graspd", "hand": "allegro", "object": "mug", "epsilon": 0.4, "pd_mm": 1 - gsr}
    return known | {"fidelity": fidelity, "valid_per_second": speed, "gsr": gsr} | fields


RUNS = [run("draft", 9.0, 0.6), run("standard", 4.0, 0.8), run("fine", 3.0, 0.75)]


@given(st.lists(st.tuples(st.integers(0, 20), st.integers(0, 20)), max_size=20))
def test_the_front_is_what_nothing_beats(points: list[tuple[int, int]]) -> None:
    front = pareto_front(points)
    beaten = {i for i, p in enumerate(points) if any(q[0] >= p[0] and q[1] >= p[1] and q != p for q in points)}
    assert front == set(range(len(points))) - beaten


def test_a_point_is_the_mean_of_end_to_end_seconds_before_the_planners_own() -> None:
    runs = [run("draft", 1.0, 0.4), run("draft", 4.0, 0.8, object="block")]
    (point,) = draw_chart(PublishedChart.model_validate({"runs": runs}), axis="gsr").points
    assert point.pairs == 2 and point.speed == pytest.approx(math.sqrt(1.0 * 4.0))
    assert point.accuracy == pytest.approx(60.0)
    runs = [run("draft", 90.0, 0.6, kept=10, end_seconds=[2.0, 3.0]), run("fine", 95.0, 0.9, kept=0, end_seconds=[1.0])]
    drawn = draw_chart(PublishedChart.model_validate({"runs": runs}), axis="gsr")
    assert [(point.fidelity, point.speed) for point in drawn.points] == [("draft", 2.0)]
    assert drawn.nothing == ["fast_graspd fine"]


def test_faster_is_further_right_and_better_is_higher() -> None:
    points = {
        point.fidelity: point for point in draw_chart(PublishedChart.model_validate({"runs": RUNS}), axis="gsr").points
    }
    assert points["draft"].x > points["standard"].x > points["fine"].x
    assert points["standard"].y < points["fine"].y < points["draft"].y
    assert [name for name, point in points.items() if not point.on_front] == ["fine"]
    less_is_better = draw_chart(PublishedChart.model_validate({"runs": RUNS}), axis="pd_mm").points
    assert {point.fidelity for point in less_is_better if point.on_front} == {"draft", "standard"}


def lifted(fidelity: str, count: int, *, way: str = IN_SCENE, **fields: object) -> dict[str, object]:
    """A run in a scene: of 20 candidates so many were lifted, in 4 s."""
    known = {"method": "fast_graspd", "way": way, "hand": "allegro", "object": "mug", "end_seconds": 4.0}
    shares = dict.fromkeys(("lift", "lift_dexgraspbench"), count / 20) | {"lift_hard": count / 40}
    return known | {"fidelity": fidelity, "lift_count": count, "valid_per_second": 99.0, **shares} | fields


def scenes_of(kind: str, *runs: dict[str, object]) -> dict[str, object]:
    return {"created": "2026-11-21T10:00:00.000Z", "scene": SceneSpec(kind=kind).model_dump(mode="json"), "runs": runs}


def test_speeds_in_scenes_are_lifted_grasps_over_seconds() -> None:
    runs = [lifted("draft", 16), lifted("draft", 0, object="block"), lifted("draft", 4, way=FILTERED)]
    drawn = draw_chart(PublishedChart.model_validate(scenes_of("table", *runs)), axis="lift")
    assert [(point.method, point.speed, point.accuracy) for point in drawn.points] == [
        ("fast_graspd, filtered", 1.0, pytest.approx(20.0)),
        ("fast_graspd", 2.0, pytest.approx(40.0)),
    ]
    assert drawn.nothing == []


@pytest.mark.parametrize("shares", [(3, 3, 4), (20, 20, 20), (0, 1, 1)])
def test_no_label_lies_on_another_or_leaves_the_chart(shares: tuple[int, ...]) -> None:
    """Slow ones beside each other, and a fast one that makes the axis long."""
    runs = [lifted(f"fidelity {n}", 19, end_seconds=400.0 + 40 * n, lift=s / 20) for n, s in enumerate(shares)]
    drawn = draw_chart(PublishedChart.model_validate(scenes_of("table", lifted("fast", 9), *runs)), axis="lift")
    boxes = [point.label_box(point.label_y - 4 - point.y, is_left=point.is_left) for point in drawn.points]
    assert len(boxes) == 4
    for one, other in itertools.combinations(boxes, 2):
        assert one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]
    for left, top, right, bottom in boxes:
        assert left >= 0 and right <= WIDTH and top >= 0 and bottom <= HEIGHT


def test_the_page_draws_free_charts_and_those_in_scenes_apart(http: TestClient, services: Services) -> None:
    publish_record(services.store, "scene_charts/table", scenes_of("table", lifted("draft", 18)))
    page = http.get("/chart", params={"lifts": "magic"}).text
    assert "Free objects" not in page and "Lifted share of candidates [%]</text>" in page
    publish_record(services.store, "charts", {"created": "2026-11-21T10:00:00.000Z", "runs": RUNS})
    for kind in ("table", "bin"):
        publish_record(
            services.store, f"scene_charts/{kind}", scenes_of(kind, lifted("standard", 18), lifted("fine", 19))
        )
    page = http.get("/chart", params={"lifts": "lift_hard"}).text
    titles = ["Free objects", "In a bin", "On a table"]
    assert [page.index(title) for title in titles] == sorted(page.index(title) for title in titles)
    assert page.count("lifted grasps per second</text>") == 2 and page.count("valid grasps per second</text>") == 1
    assert page.count("Lifted at half the friction [%]</text>") == 2


def test_the_page_shows_the_chart_that_was_published_last(http: TestClient, services: Services) -> None:
    for name, fidelity in (("20260101", "old"), ("20260202", "new")):
        services.store.put(f"charts/{name}.json", json.dumps({"runs": [run(fidelity, 2.0, 0.5)]}).encode())
    page = http.get("/chart").text
    assert ">new<" in page and ">old<" not in page


@pytest.mark.parametrize("stored", [None, b"{}", b"no json"])
def test_with_nothing_to_show_a_page_names_the_command(http: TestClient, services: Services, stored: Any) -> None:
    for kind, page in (("charts", "chart"), ("stability", "stability")):
        if stored is not None:
            services.store.put(f"{kind}/20260101.json", stored)
        assert f"graspd {page} --quick --publish" in http.get(f"/{page}").text


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
    panel = draw_panel(a_map(), "penalty")
    assert panel.columns == ["100", "1000", "1e4"]
    assert [name for name, _ in panel.rows] == ["0.01", "1e-4"]
    assert [square.outcome for square in panel.rows[0][1] if square] == ["good", "weak", "broken"]
    width, height = PITCH
    first, last = (tuple(map(float, point.split(","))) for point in panel.line.split())
    assert (first, last) == ((width / 2, height / 2), (2.5 * width, 1.5 * height))
    open_one = draw_panel(a_map(cells=a_map().cells[:-1]), "penalty")
    assert open_one.rows[0][1][2] is None


def test_words_along_the_bottom_stand_before_rows_instead() -> None:
    pairs = [(name, fidelity) for name in ("open", "inside out") for fidelity in ("draft", "fine")]
    cells = [MapCell("mesh", name, fidelity, 1.0, "good") for name, fidelity in pairs]
    panel = draw_panel(a_map(cells=cells, lines={}), "mesh")
    assert (panel.columns, [name for name, _ in panel.rows]) == (["draft", "fine"], ["open", "inside out"])
    assert (panel.x, panel.y) == ("time step [s]", "stiffness [N/m]")


def test_the_page_shows_the_latest_maps_and_what_they_mean(http: TestClient, services: Services) -> None:
    publish_record(services.store, "stability", a_record("2026-11-21T13:00:00.000Z"))
    publish_record(services.store, "stability", a_record(measure="an older measure"))
    page = http.get("/stability").text
    assert "A map of stiffness" in page and "an older measure" not in page
    shown = ("energy", "weak: 1.02", "hands sink in", "direct has none", "tests/test_it.py::test_it", "the soft ones")
    shares = re.findall(r'<rect class="(good|weak)" x="([0-9])" width="([0-9])"', page)
    assert shares == [("good", "0", "2"), ("weak", "2", "2")]
    cells = ("mesh inside out (fine)", "time step [s] 0.01: broken; note 4", "graspd stability")
    assert [words for words in shown + cells if words not in page] == []
