"""Headless Chromium on the dashboard: of an application in this process, or of a whole service with the real engine."""

import shutil
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import uvicorn
from fastapi import FastAPI

from graspd.service.run.address import bind_socket
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from tests.api.conftest import app, furnished, services, settings
from tests.waiting import PATIENCE_S, until, until_a_worker_is_idle

__all__ = ["app", "furnished", "services", "settings"]
#: SwiftShader draws WebGL without a GPU; the rest keeps the browser from calling home.
_ARGUMENTS = """
    --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader --disable-quic --no-first-run
    --disable-background-networking --disable-component-update --disable-sync
"""
ARGUMENTS = tuple(_ARGUMENTS.split())
#: Longest wait for something on a page, on a machine that is busy with other things.
SHOWN_MS = 1000 * PATIENCE_S


@contextmanager
def serving(app: Any) -> Iterator[str]:
    with bind_socket("127.0.0.1", 0) as listener:
        server = uvicorn.Server(uvicorn.Config(app, log_level="critical", timeout_graceful_shutdown=1))
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        until(lambda: server.started, "the server listens")
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        server.should_exit = True
        thread.join()


@pytest.fixture
def address(app: FastAPI) -> Iterator[str]:
    with serving(app) as found:
        yield found


@pytest.fixture(scope="module")
def chromium() -> Iterator[Any]:
    """One browser for the tests of a module; each gets a context of its own.

    While Playwright runs, its event loop does: `asyncio.run` fails in every other test of this process.
    """
    playwright = pytest.importorskip("playwright.sync_api", reason="needs the extra: pip install graspd[browser]")
    program = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
    if program is None:
        pytest.skip("no Chromium on this machine: apt-get install chromium")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=list(ARGUMENTS))
        yield browser
        browser.close()


class Watch:
    def __init__(self, address: str) -> None:
        self.address = address
        self.trouble: list[str] = []

    def __call__(self, page: Any) -> Any:
        page.on("console", lambda message: self._say(message.text) if message.type in ("error", "warning") else None)
        page.on("pageerror", lambda error: self._say(str(error)))
        page.on("request", lambda request: None if self._is_own(request.url) else self._say(request.url))
        return page

    def _is_own(self, url: str) -> bool:
        return url.startswith((self.address, "data:", "blob:"))

    def _say(self, text: str) -> None:
        # Drivers talk about speed, which is no fault of the page.
        if "GPU stall" not in text:
            self.trouble.append(text)


@contextmanager
def watched(chromium: Any, address: str) -> Iterator[Any]:
    """A page of a service; the test fails if anything went wrong on it."""
    watch = Watch(address)
    context = chromium.new_context(base_url=address, viewport={"width": 1440, "height": 900}, accept_downloads=True)
    context.set_default_timeout(SHOWN_MS)
    page = watch(context.new_page())
    page.watch = watch
    yield page
    context.close()
    assert watch.trouble == []


@pytest.fixture
def page(address: str, chromium: Any) -> Iterator[Any]:
    with watched(chromium, address) as found:
        yield found


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    """Address of a whole service: Redis, API, controller, and a worker with the real engine on the CPU."""
    wanted = Settings(data_dir=tmp_path_factory.mktemp("service"), port=0, device="cpu", controller_interval_s=0.5)
    with Supervisor(wanted, workers=1, worker_command=(sys.executable, "-m", "graspd", "worker")) as supervisor:
        supervisor.wait_ready(PATIENCE_S)
        until_a_worker_is_idle(supervisor.api_url)
        yield supervisor.api_url


@pytest.fixture
def real_page(service: str, chromium: Any) -> Iterator[Any]:
    with watched(chromium, service) as found:
        yield found
