"""The maps of failure on their page: laid out as pictures are, told in words, and what stands there before any."""

from __future__ import annotations

import math

import pytest
from starlette.testclient import TestClient

from graspd.api.dashboard.figures import PITCH, draw
from graspd.service.model.studies import MapCell, Outcome, Stability, StabilityMap
from graspd.service.pipeline.backends import Services
from graspd.service.store.records import publish


def a_map(name: str = "stiffness", **changes: object) -> StabilityMap:
    """Two steps by three stiffnesses, the stiffest broken; the soft ones within reach of a job."""
    outcomes: tuple[Outcome, ...] = ("good", "weak", "broken")
    cells = [
        MapCell(
            "penalty", 10.0**k, dt, math.inf if outcome == "broken" else 0.25 * k, outcome, f"note {k}", reached=k < 4
        )
        for dt in (1e-4, 0.01)
        for k, outcome in zip((2, 3, 4), outcomes, strict=True)
    ]
    fields = {
        "name": name,
        "title": f"A map of {name}",
        "x": "stiffness [N/m]",
        "y": "time step [s]",
        "measure": "energy",
        "bounds": "weak: 1.02",
        "cells": cells,
        "shows": "hands sink in",
        "guard": "`direct` has none",
        "guard_test": "tests/test_it.py::test_it",
        "lines": {"penalty": [(100.0, 0.01), (10000.0, 1e-4)]},
        "reach": "the soft ones",
    }
    return StabilityMap(**{**fields, **changes})  # type: ignore[arg-type]


def a_record(created: str = "2026-11-21T12:00:00.000Z", **changes: object) -> dict[str, object]:
    shapes = a_map("shapes", lines={}, cells=[MapCell("mesh", "inside out", "fine", 0.0, "broken", reached=True)])
    return Stability(created, "graspd stability", {"graspd": "0"}, [a_map(**changes), shapes]).as_json()


def test_small_values_are_at_the_left_and_at_the_bottom() -> None:
    (panel,) = draw(a_map()).panels
    assert panel.columns == ["100", "1000", "1e4"]
    assert [name for name, _ in panel.rows] == ["0.01", "1e-4"]
    assert [square.outcome for square in panel.rows[0][1] if square] == ["good", "weak", "broken"]


def test_the_bound_of_theory_goes_through_the_middles_of_its_cells() -> None:
    (panel,) = draw(a_map()).panels
    width, height = PITCH
    first, last = (tuple(map(float, point.split(","))) for point in panel.line.split())
    assert first == (width / 2, height / 2)
    assert last == (2.5 * width, 1.5 * height)


def test_words_along_the_bottom_stand_before_rows_instead() -> None:
    cells = [
        MapCell("mesh", name, fidelity, 1.0, "good")
        for name in ("open", "inside out")
        for fidelity in ("draft", "fine")
    ]
    (panel,) = draw(a_map(cells=cells, lines={})).panels
    assert (panel.columns, [name for name, _ in panel.rows]) == (["draft", "fine"], ["open", "inside out"])
    assert (panel.x, panel.y) == ("time step [s]", "stiffness [N/m]")


def test_a_cell_that_was_not_measured_is_left_open() -> None:
    (panel,) = draw(a_map(cells=a_map().cells[:-1])).panels
    assert panel.rows[0][1][2] is None


def test_the_bar_of_what_is_within_reach_is_whole() -> None:
    shares = draw(a_map()).reached
    assert [(share.outcome, share.count, share.x, share.width) for share in shares] == [
        ("good", 2, 0.0, 50.0),
        ("weak", 2, 50.0, 50.0),
    ]


def test_the_page_shows_the_maps_that_were_published_last(http: TestClient, services: Services) -> None:
    publish(services.store, "stability", a_record("2026-11-21T13:00:00.000Z"))
    publish(services.store, "stability", a_record(measure="an older measure"))
    page = http.get("/stability").text
    assert "A map of stiffness" in page
    assert "an older measure" not in page


@pytest.mark.parametrize(
    "words",
    [
        "energy",
        "weak: 1.02",
        "hands sink in",
        "direct has none",
        "tests/test_it.py::test_it",
        "the soft ones",
        "mesh inside out (fine)",
        "time step [s] 0.01: broken; note 4",
        "graspd stability",
    ],
)
def test_beneath_a_map_stands_what_it_means(http: TestClient, services: Services, words: str) -> None:
    publish(services.store, "stability", a_record())
    assert words in http.get("/stability").text


@pytest.mark.parametrize("stored", [None, b"{}", b"no json"])
def test_without_maps_the_page_says_which_command_makes_them(
    http: TestClient, services: Services, stored: bytes | None
) -> None:
    if stored is not None:
        services.store.put("stability/20260101.json", stored)
    assert "graspd stability --quick --publish" in http.get("/stability").text
