"""The chart of speed against accuracy: its points, its front, and what stands there before anything is measured."""

from __future__ import annotations

import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from starlette.testclient import TestClient

from api.dashboard.figures.tradeoff import Measured, draw, pareto
from service.pipeline.backends import Parts


def run(fidelity: str, speed: float, gsr: float, **fields: object) -> dict[str, object]:
    known = {"method": "fast_graspd", "hand": "allegro", "object": "mug", "epsilon": 0.4, "pd_mm": 1 - gsr}
    return known | {"fidelity": fidelity, "valid_per_second": speed, "gsr": gsr} | fields


RUNS = [run("draft", 9.0, 0.6), run("standard", 4.0, 0.8), run("fine", 3.0, 0.75)]


@given(st.lists(st.tuples(st.integers(0, 20), st.integers(0, 20)), max_size=20))
def test_the_front_is_what_nothing_beats(points: list[tuple[int, int]]) -> None:
    front = pareto(points)
    beaten = {i for i, p in enumerate(points) if any(q[0] >= p[0] and q[1] >= p[1] and q != p for q in points)}
    assert front == set(range(len(points))) - beaten


def test_a_point_is_the_mean_over_hands_and_objects() -> None:
    runs = [run("draft", 1.0, 0.4), run("draft", 4.0, 0.8, object="block")]
    (point,) = draw(Measured.model_validate({"runs": runs}), axis="gsr").points
    assert point.pairs == 2
    assert point.speed == pytest.approx(math.sqrt(1.0 * 4.0))
    assert point.accuracy == pytest.approx(60.0)


def test_faster_is_further_right_and_better_is_higher() -> None:
    points = {point.fidelity: point for point in draw(Measured.model_validate({"runs": RUNS}), axis="gsr").points}
    assert points["draft"].x > points["standard"].x > points["fine"].x
    assert points["standard"].y < points["fine"].y < points["draft"].y
    assert [name for name, point in points.items() if not point.on_front] == ["fine"]


def test_of_penetration_less_is_better() -> None:
    drawn = draw(Measured.model_validate({"runs": RUNS}), axis="pd_mm")
    assert {point.fidelity for point in drawn.points if point.on_front} == {"draft", "standard"}


def test_the_page_shows_the_chart_that_was_published_last(http: TestClient, parts: Parts) -> None:
    for name, fidelity in (("20260101", "old"), ("20260202", "new")):
        parts.store.put(f"charts/{name}.json", json.dumps({"runs": [run(fidelity, 2.0, 0.5)]}).encode())
    page = http.get("/chart").text
    assert ">new<" in page
    assert ">old<" not in page


@pytest.mark.parametrize("stored", [None, b"{}", b"no json"])
def test_without_a_chart_the_page_says_which_command_makes_one(
    http: TestClient, parts: Parts, stored: bytes | None
) -> None:
    if stored is not None:
        parts.store.put("charts/20260101.json", stored)
    assert "graspd chart" in http.get("/chart").text
