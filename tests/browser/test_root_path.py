"""The dashboard below a path, in a real browser: pages, live updates, forms, models in 3D."""

from collections.abc import Iterator
from typing import Any

import pytest
from fastapi import FastAPI

from graspd.api.app import create_app
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.assets import builtin_files
from tests.api.factories import add_job, finish_all
from tests.browser.conftest import serving

pytestmark = pytest.mark.browser
PREFIX = "/graspd"


@pytest.fixture
def app(settings: Settings, services: Services) -> FastAPI:
    return create_app(settings.model_copy(update={"api_root_path": PREFIX}), services)


@pytest.fixture
def address(app: FastAPI) -> Iterator[str]:
    with serving(app) as outer:
        yield f"{outer}{PREFIX}"


@pytest.mark.slow
def test_every_part_of_the_dashboard_works_below_the_path(page: Any, services: Services, address: str) -> None:
    job = add_job(services, grasps=6, scenes=1, views=1)
    page.goto(f"{address}/")
    page.click(f"a[href='{PREFIX}/jobs/{job.id}'] >> nth=0")
    page.wait_for_selector("#head .queued")
    page.evaluate("window.stayed = true")
    finish_all(services, job)
    page.wait_for_selector("#head .succeeded")
    page.wait_for_selector("#best canvas[data-state=ready]")
    page.wait_for_selector("#views img")
    assert page.evaluate("window.stayed && [...document.querySelectorAll('#views img')].every((one) => one.src)")
    page.click("#best a[href*='/grasps/'] >> nth=0")
    page.wait_for_selector("figure[data-state=ready]")
    page.goto(f"{address}/hands/shadow")
    page.wait_for_selector("figure[data-state=ready]")

    page.goto(f"{address}/submit")
    page.select_option("#hand", "barrett")
    page.select_option("#object", "mug")
    page.wait_for_selector("[data-thing=hand] figure[data-state=ready]")
    with page.expect_response(f"**{PREFIX}/submit?*"):
        page.fill("#grasps", "8")
        page.locator("#grasps").blur()
    page.click("text=Submit the job")
    page.wait_for_url(f"**{PREFIX}/jobs/*")
    page.click("button:has-text('Cancel')")
    page.wait_for_selector("#head .cancelled")

    page.goto(f"{address}/submit")
    block = builtin_files(AssetKind.OBJECT, "block")["block.stl"]
    with page.expect_response(f"**{PREFIX}/v1/objects") as sent:
        page.set_input_files("#file", {"name": "mine.stl", "mimeType": "model/stl", "buffer": block})
    assert sent.value.ok
