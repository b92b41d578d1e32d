"""A grasp that was planned in a scene, on its page: the scene is drawn, and one slider leads from standoff to lift."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from graspd.commands.synth import app as synth
from graspd.service.pipeline.backends import Services
from tests.api.factories import finish_with
from tests.waiting import until

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]

STOPS = ["standoff", "pregrasp", "grasp", "squeeze", "lift"]


@pytest.fixture(scope="module")
def bin_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two feasible grasps in a bin; the page shows them whether they lift or not."""
    path = tmp_path_factory.mktemp("scene") / "bin.h5"
    arguments = "--hand allegro --object mug --scene bin --scenes 1 -n 2 --want candidates --fidelity draft"
    result = CliRunner().invoke(synth, [*arguments.split(), "--device", "cpu", "-o", str(path), "--json"])
    assert result.exit_code == 0, result.output
    return path


def test_one_slider_leads_from_the_standoff_to_the_lift(page: Any, services: Services, bin_file: Path) -> None:
    shard = finish_with(services, bin_file).shard_id
    # A small canvas is drawn quickly without a GPU.
    page.set_viewport_size({"width": 700, "height": 700})
    page.goto(f"/grasps/{shard}/0")
    page.wait_for_selector(".viewer[data-state=ready]")
    assert page.locator("[data-posture]").all_inner_texts() == STOPS
    assert page.inner_text("[data-stage]") == "grasp"
    canvas = page.locator(".viewer canvas")
    seen = {}
    for place, stop in enumerate(STOPS):
        page.click(f"[data-posture='{place}']")
        assert page.get_attribute("input[type=range]", "aria-valuetext") == stop
        # What changed is drawn in the next frame.
        page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        seen[stop] = canvas.screenshot()
    # Pregrasp and grasp may differ by less than a pixel.
    assert len({seen[stop] for stop in ("standoff", "grasp", "lift")}) == 3
    page.click("[data-posture='0']")
    assert re.match("0 surface points within 1 mm", page.inner_text("[data-say]"))
    page.locator("input[type=range]").fill("3.5")
    assert "50 % of the way from squeeze to lift" in page.inner_text("[data-stage]")
    # The object goes along: what touches it while it is lifted is what touched it when it was squeezed.
    lifting = page.inner_text("[data-say]")
    page.click("[data-posture='3']")
    assert page.inner_text("[data-say]") == lifting

    page.click("[data-posture='0']")
    page.uncheck("[data-toggle=scenery]")
    until(lambda: canvas.screenshot() != seen["standoff"], "the scenery goes")
    page.click("[data-play]")
    page.wait_for_selector("[data-posture='4'][aria-current=true]")
