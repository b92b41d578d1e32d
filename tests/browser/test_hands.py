"""A hand in the browser: what was guessed of it is seen, corrected, kept as a hand of its own, and used."""

import json
import re
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner

from graspd.commands.synth import app as synth
from graspd.service.model.messages import IngestMessage
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.store import library
from graspd.worker.hands.load import load_hand
from graspd.worker.stages import ingest
from graspd.worker.stages.context import TaskContext
from tests.api.factories import finish_with
from tests.browser.test_flows import colours
from tests.waiting import until
from tests.worker.hands.urdfs import joint, link, robot

pytestmark = [pytest.mark.browser, pytest.mark.timeout(300)]
BAR = '<collision><origin xyz="0 0 0.03"/><geometry><box size="0.016 0.02 0.06"/></geometry></collision>'
SEEN = (
    '<visual><origin xyz="0 0 0.03"/><geometry><cylinder radius="0.009" length="0.06"/></geometry>'
    '<material name="m"><color rgba="0.8 0.5 0.1 1"/></material></visual>'
)
BASE = (
    '<collision><geometry><box size="0.1 0.04 0.03"/></geometry></collision>'
    '<visual><geometry><box size="0.1 0.04 0.03"/></geometry>'
    '<material name="g"><color rgba="0.2 0.3 0.7 1"/></material></visual>'
)
#: A claw whose fingers stand to one side of its palm: graspd guesses that it faces along them, and is told otherwise.
CLAW = robot(
    link("palm", BASE),
    link("a", BAR + SEEN),
    link("b", BAR + SEEN),
    link("c", BAR + SEEN),
    joint("ja", "palm", "a", origin="0.04 0 0.015", limit='<limit lower="-0.4" upper="1.4" effort="1" velocity="2"/>'),
    joint("jb", "palm", "b", origin="-0.04 0 0.015"),
    joint("jc", "palm", "c", origin="-0.04 0.03 0.015"),
)


def checked(services: Services, name: str) -> None:
    asset = services.index.assets.get(AssetKind.HAND, name)
    message = IngestMessage(schema_=1, task_id="i", kind=AssetKind.HAND, name=asset.name, digest=asset.digest)
    ingest.run(message, TaskContext(services.store))
    found = library.load_check(services.store, AssetKind.HAND, asset.digest)
    services.index.write.add_asset(library.load_asset(services.store, AssetKind.HAND, asset.digest), found)


def drawn(page: Any) -> bytes:
    page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return bytes(page.locator(".viewer canvas").screenshot())


def test_a_wrong_guess_is_corrected_and_kept_as_a_hand(page: Any, services: Services, address: str) -> None:
    file = ("claw.urdf", CLAW)
    httpx.post(f"{address}/v1/hands", files={"file": file}, trust_env=False, timeout=60).raise_for_status()
    # A small canvas is drawn quickly without a GPU.
    page.set_viewport_size({"width": 700, "height": 700})
    page.goto("/hands")
    page.click("text=claw")
    assert page.inner_text("#shown") == "A worker checks the hand; its findings appear here."
    checked(services, "claw")
    page.wait_for_selector(".viewer[data-state=ready]")
    assert colours(page.locator(".viewer canvas")) > 50
    assert page.is_checked("[name='closing.0'][value='-1']"), "towards the other fingers, whatever its limits"

    # The joints move, the housing becomes glass, collision shapes take the place of what the hand looks like.
    seen = [drawn(page)]
    page.locator("[data-joint='0']").fill("-0.3")
    assert page.inner_text("[data-joint='0'] + output") == "-17°"
    seen.append(drawn(page))
    page.check("[data-toggle=housing]")
    seen.append(drawn(page))
    page.check("[data-toggle=collision]")
    seen.append(drawn(page))
    page.uncheck("[data-toggle=marks]")
    seen.append(drawn(page))
    page.click("[data-posture=closed]")
    assert len(set(seen)) == len(seen)
    assert float(page.input_value("[data-close]")) == pytest.approx(1, abs=0.02)

    # Another way to close opens at the other end; another link says the same palm in its own numbers.
    page.locator("[name='closing.0'][value='1']").check()
    assert float(page.input_value("[name='preshape.0']")) == pytest.approx(-0.4 + 0.25 * 1.8)
    page.click("[data-approach='0,0,1']")
    for axis, value in zip("xyz", ("0", "0", "15"), strict=True):
        page.fill(f"[name=centre_{axis}]", value)
    page.select_option("[name=palm_link]", "b")
    assert [float(page.input_value(f"[name=centre_{axis}]")) for axis in "xyz"] != pytest.approx([0, 0, 15], abs=1)
    page.select_option("[name=palm_link]", "palm")
    assert float(page.input_value("[name=centre_z]")) == pytest.approx(15, abs=0.01)
    page.locator("[data-joint='1']").fill("0.5")
    page.click("[data-take]")
    page.uncheck("[name=fingertip][value=c]")
    page.fill("[name=name]", "claw-right")
    page.click("text=Save as a new hand")
    page.wait_for_url(lambda url: "/hands/" in url and not url.endswith("claw"))
    assert page.inner_text("h1") == "claw-right"
    checked(services, "claw-right")
    page.wait_for_selector(".viewer[data-state=ready]")

    asset = services.index.assets.get(AssetKind.HAND, "claw-right")
    files = library.load_asset_files(services.store, AssetKind.HAND, asset.digest)
    hand = load_hand(files, name="claw-right", digest="")
    assert hand.closing.tolist() == [1, 1, 1] and hand.preshape.tolist() == pytest.approx([0.05, 0.5, 1.5], abs=0.01)
    assert [hand.body_names[tip] for tip in hand.fingertips] == ["a", "b"]
    assert hand.palm.centre.tolist() == pytest.approx([0, 0, 0.015], abs=1e-4)
    assert hand.palm.approach.tolist() == pytest.approx([0, 0, 1])
    assert json.loads(files["asset.json"])["closing"]["ja"] == 1 and asset.facts["guessed"] in ([], ["effort"])
    assert not page.is_visible("text=guessed")

    assert page.is_visible("text=Collision shapes")
    page.click("text=Use it in a job")
    page.wait_for_selector("[data-thing=hand] figure[data-state=ready]")
    assert page.input_value("#hand") == "claw-right"
    job = httpx.post(f"{address}/v1/jobs", json={"hand": "claw-right", "object": "mug"}, trust_env=False, timeout=60)
    assert job.status_code == 202


STOPS = ["standoff", "pregrasp", "grasp", "squeeze", "lift"]


@pytest.fixture(scope="module")
def bin_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
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
