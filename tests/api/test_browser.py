"""The pages in a real browser: they move by themselves, their forms work, and nothing comes from elsewhere."""

from __future__ import annotations

import shutil
import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest
import uvicorn
from fastapi import FastAPI

from service.parts import Parts
from service.planning import plan
from tests.api.factories import add_job, fail, finish, finish_all

pytestmark = pytest.mark.browser

#: A live page looks again within a second of an event; the rest is a slow machine.
LIVE_MS = 15_000
ARGUMENTS = (
    "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip


@pytest.fixture
def address(app: FastAPI) -> Iterator[str]:
    listener = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    while not server.started:
        time.sleep(0.01)
    yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    server.should_exit = True
    thread.join()
    listener.close()


@pytest.fixture
def page(address: str) -> Iterator[Any]:
    playwright = pytest.importorskip("playwright.sync_api", reason="needs the extra: pip install graspd[browser]")
    chromium = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=chromium, args=list(ARGUMENTS))
        opened = browser.new_page(base_url=address)
        trouble: list[str] = []
        opened.on("console", lambda message: trouble.append(message.text) if message.type == "error" else None)
        opened.on("pageerror", lambda error: trouble.append(str(error)))
        opened.on("request", lambda request: None if request.url.startswith(address) else trouble.append(request.url))
        yield opened
        browser.close()
    assert trouble == []


def test_a_job_page_follows_its_job_without_a_reload(page: Any, parts: Parts) -> None:
    record = add_job(parts, scenes=1, views=1)
    tasks = list(plan(record))
    page.goto(f"/jobs/{record.id}")
    page.evaluate("window.stayed = true")
    page.wait_for_selector("#head .queued")
    finish(parts, record, tasks[0])
    page.wait_for_selector("#best tbody tr", timeout=LIVE_MS)
    for task in tasks[1:]:
        finish(parts, record, task)
    page.wait_for_selector("#head .succeeded", timeout=LIVE_MS)
    page.wait_for_selector("#views img", timeout=LIVE_MS)
    assert page.evaluate("window.stayed") is True


def test_the_home_page_shows_a_job_that_comes_later(page: Any, parts: Parts) -> None:
    page.goto("/")
    page.wait_for_selector("text=No job yet")
    record = add_job(parts)
    page.wait_for_selector(f'a[href="/jobs/{record.id}"]', timeout=LIVE_MS)


def test_a_user_submits_watches_cancels_and_retries(page: Any) -> None:
    page.goto("/submit")
    page.select_option("#hand", "shadow")
    page.fill("#grasps", "64")
    page.click("text=Submit >> nth=-1")
    page.wait_for_url("**/jobs/*")
    assert page.inner_text("h1").split() == ["shadow", "×", "mug"]
    page.click("button:has-text('Cancel')")
    page.wait_for_selector("#head .cancelled")
    page.click("button:has-text('Retry')")
    page.wait_for_selector("#head .queued")


def test_a_user_filters_and_sorts_grasps(page: Any, parts: Parts) -> None:
    finish_all(parts, add_job(parts, grasps=96))
    page.goto("/grasps")
    page.select_option("#valid", "true")
    page.click("button:has-text('Filter')")
    page.wait_for_url("**valid=true**")
    page.click("th a:has-text('Penetration')")
    page.wait_for_selector("th[aria-sort=ascending]:has-text('Penetration')")
    column = [float(cell.replace("< ", "")) for cell in page.locator("tbody tr td:last-child").all_inner_texts()]
    assert column == sorted(column)


@pytest.mark.parametrize("width", [360, 768, 1440])
def test_no_page_scrolls_sideways(page: Any, parts: Parts, width: int) -> None:
    record = add_job(parts, scenes=1, views=2)
    finish_all(parts, record)
    fail(parts, add_job(parts, seed=9), "a reason " * 30)
    page.set_viewport_size({"width": width, "height": 800})
    for path in ("/", f"/jobs/{record.id}", "/grasps", "/submit", "/problems"):
        page.goto(path)
        assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), path


def test_a_page_reads_the_same_without_javascript(address: str, page: Any, parts: Parts) -> None:
    record = add_job(parts)
    finish_all(parts, record)
    context = page.context.browser.new_context(java_script_enabled=False, base_url=address)
    plain = context.new_page()
    plain.goto(f"/jobs/{record.id}")
    assert plain.locator("#files tbody tr").count() == 1
    context.close()
