"""Server time of each page of the dashboard, and time to the first paint in a browser.

usage: python -m benchmarks.large_index --data-dir DIR
       python -m benchmarks.dashboard_pages --data-dir DIR [--repeats 20] [--paint]

Times are in milliseconds, for sequential requests to a warm server with the index in DIR. `cpu` is the processor time
of a request including the client; it depends little on other load. With --paint the table also has the time from
opening a page in headless Chromium to its first contentful paint, over loopback."""

from __future__ import annotations

import argparse
import shutil
import statistics
import sys
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import uvicorn

from graspd.api.app import create_app
from graspd.service.index.index import Index
from graspd.service.pipeline.backends import Services
from graspd.service.run.address import bind_socket
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.memory_queue import MemoryQueue

_CHROMIUM = ("--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--disable-quic")


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data-dir", type=Path, required=True)
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--paint", action="store_true")
    given = parser.parse_args(arguments)
    settings = Settings(data_dir=given.data_dir)
    index = Index(settings.resolved_index_url)
    services = Services(settings, open_store(settings.resolved_store_url), index, MemoryQueue())
    stats = index.overview.stats()
    say(f"{stats.grasps:,} grasps, {sum(stats.jobs.values()):,} jobs, {stats.shards:,} shards")
    paths = pages(services)
    with serving(settings, services) as address:
        rows = server_times(address, paths, given.repeats)
        paints = first_paints(address, paths) if given.paint else {}
    say(f"{'page':<34} {'median':>8} {'slowest':>8} {'cpu':>8}" + (f" {'paint':>8}" if paints else "") + "  [ms]")
    for path, (median, slowest, cpu) in rows.items():
        say(f"{path[:34]:<34} {median:8.1f} {slowest:8.1f} {cpu:8.1f}" + (f" {paints[path]:8.0f}" if paints else ""))
    services.close()
    return 0


def say(line: str) -> None:
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def pages(services: Services) -> list[str]:
    """Return addresses of pages of every kind that the index can show."""
    jobs = [job.id for job in services.index.jobs.page(limit=3).items]
    pairs = services.index.overview.matrix()[:1]
    found = ["/", "/jobs", "/jobs?state=failed&sort=duration", "/jobs?q=allegro+mug", "/jobs?q=none", "/search?q=mug"]
    found += ["/objects", "/hands", "/datasets", *(f"/jobs/{job}" for job in jobs), "/grasps", "/grasps?view=table"]
    found += [f"/grasps?hand={pair.hand}&object={pair.object}&sort=penetration_depth_mm&order=asc" for pair in pairs]
    found += [f"/grasps?object={pair.object}&valid=true&order=asc" for pair in pairs]
    found += ["/grasps?valid=true&min_epsilon=0.3&max_penetration_depth_mm=0.5", "/workers", "/chart", "/submit"]
    return found


def server_times(address: str, paths: Sequence[str], repeats: int) -> dict[str, tuple[float, float, float]]:
    """Return median and slowest time of each page and its CPU time [ms], after an untimed request."""
    rows = {}
    with httpx.Client(base_url=address, trust_env=False, timeout=60) as client:
        for path in paths:
            client.get(path).raise_for_status()
            times, busy = [], time.process_time()
            for _ in range(repeats):
                start = time.perf_counter()
                client.get(path).raise_for_status()
                times.append(1000 * (time.perf_counter() - start))
            rows[path] = (statistics.median(times), max(times), 1000 * (time.process_time() - busy) / repeats)
    return rows


def first_paints(address: str, paths: Sequence[str]) -> dict[str, float]:
    """Return the time to the first contentful paint of each page [ms], with cached fonts and styles."""
    from playwright.sync_api import sync_playwright

    program = shutil.which("chromium") or shutil.which("google-chrome")
    paint = "performance.getEntriesByName('first-contentful-paint')[0]?.startTime ?? null"
    found = {}
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=list(_CHROMIUM))
        page: Any = browser.new_page(base_url=address)
        for path in paths:
            page.goto(path)
            values = []
            for _ in range(3):
                page.goto(path)
                page.wait_for_timeout(300)
                values.append(page.evaluate(paint))
            found[path] = statistics.median(value for value in values if value is not None)
        browser.close()
    return found


@contextmanager
def serving(settings: Settings, services: Services) -> Iterator[str]:
    listener = bind_socket("127.0.0.1", 0)
    app = create_app(settings, services)
    server = uvicorn.Server(uvicorn.Config(app, log_level="warning", timeout_graceful_shutdown=1))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
    thread.start()
    while not server.started:
        time.sleep(0.01)
    try:
        yield f"http://127.0.0.1:{listener.getsockname()[1]}"
    finally:
        server.should_exit = True
        thread.join()
        listener.close()


if __name__ == "__main__":
    sys.exit(main())
