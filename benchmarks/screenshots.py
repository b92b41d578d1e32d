"""Pictures of every page of the dashboard for the documentation, from a real service with real grasps.

usage: python -m benchmarks.screenshots [--data-dir DIR] [--out docs/images]

Starts the service, gives it work (some minutes on two cores), publishes the charts of the docs, and photographs each
page at the width of a laptop or a phone, light or dark. With --data-dir the results are kept, and the next call uses
them again.
"""

from __future__ import annotations

import argparse
import io
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import httpx
from PIL import Image

from graspd.service.model.scene_spec import SceneSpec
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.service.store.records import publish_record, scene_chart_kind
from graspd.service.store.store import open_store
from tests.browser.conftest import ARGUMENTS
from tests.waiting import until

REPOSITORY: Final = Path(__file__).resolve().parents[1]
CHARTS: Final = [REPOSITORY / "docs" / "results" / one / "chart.json" for one in ("", "scenes-chart")]
MAPS: Final = REPOSITORY / "docs" / "results" / "stability" / "stability.json"
WORK_S: Final = 3600.0
SHOWN_MS: Final = 60_000
LAPTOP: Final = (1440, 900)
PHONE: Final = (390, 844)
_PAIR: Final = {"hand": "allegro", "object": "mug"}
VIEWED: Final[dict[str, Any]] = _PAIR | {"grasps": 64, "scenes": 2, "views": 2, "stereo": True}
_MATRIX: Final = {"hands": ["allegro", "barrett"], "objects": ["mug", "bottle", "block"]}
DATASET: Final[dict[str, Any]] = _MATRIX | {"name": "kitchen-1", "grasps": 32, "fidelity": "draft"}
LONG: Final[dict[str, Any]] = {"hand": "shadow", "object": "mug", "grasps": 640, "fidelity": "draft"}


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data-dir", type=Path)
    parser.add_argument("--out", type=Path, default=REPOSITORY / "docs" / "images")
    parser.add_argument("--only", default="", help="names of pictures, comma-separated")
    given = parser.parse_args(arguments)
    if missing := [str(file.relative_to(REPOSITORY)) for file in (*CHARTS, MAPS) if not file.is_file()]:
        parser.error(
            f"{', '.join(missing)} missing: python -m benchmarks.results --again --only chart scenes-chart stability"
        )
    with tempfile.TemporaryDirectory() as scratch:
        wanted = Settings(data_dir=given.data_dir or Path(scratch), port=0)
        with Supervisor(wanted, workers=1) as supervisor:
            supervisor.wait_ready()
            with httpx.Client(base_url=supervisor.api_url, trust_env=False, timeout=60) as client:
                places = work(client, supervisor)
                given.out.mkdir(parents=True, exist_ok=True)
                try:
                    photograph(supervisor.api_url, places, given.out, set(filter(None, given.only.split(","))))
                finally:
                    client.post(f"/v1/jobs/{places['running']}/cancel")
    return 0


def work(client: httpx.Client, supervisor: Supervisor) -> dict[str, str]:
    """Submit a dataset and two jobs, and kill a worker once; return the ids of the jobs and a grasp."""
    viewed = client.post("/v1/jobs", json=VIEWED).raise_for_status().json()["id"]
    if not client.get("/v1/datasets/kitchen-1").is_success:
        until(lambda: client.get(f"/v1/jobs/{viewed}").json()["state"] == "running", "a job runs", seconds=WORK_S)
        # Lose a worker: its task runs again, and the lost attempt keeps the reason.
        os.kill(supervisor.pids["worker-0"], 9)
    client.post("/v1/datasets", json=DATASET).raise_for_status()
    until(lambda: client.get("/v1/datasets/kitchen-1").json()["state"] == "succeeded", "the dataset", seconds=WORK_S)
    until(lambda: client.get(f"/v1/jobs/{viewed}").json()["state"] == "succeeded", "the job with views", seconds=WORK_S)
    folder = str(supervisor.settings.data_dir)
    if "card pad trade" not in client.get("/chart").text:
        store = open_store(supervisor.settings.resolved_store_url)
        for chart in (json.loads(file.read_text()) for file in CHARTS):
            place = SceneSpec.model_validate(chart.get("scene", {}))
            publish_record(store, scene_chart_kind(place), chart)
    if "reach-title" not in client.get("/stability").text:
        command = [sys.executable, "-m", "graspd", "stability", "--from", str(MAPS), "--publish", "--data-dir", folder]
        subprocess.run(command, check=True, cwd=REPOSITORY, stdout=subprocess.DEVNULL)
    seed = int(time.time()) % 2**31
    running = client.post("/v1/jobs", json=LONG | {"seed": seed}).raise_for_status().json()["id"]
    until(lambda: client.get(f"/v1/jobs/{running}").json()["progress"] > 0.002, "the long job moves", seconds=WORK_S)
    best = client.get("/v1/grasps", params={"job": viewed, "valid": "true", "limit": 3}).json()["items"][-1]
    return {"viewed": viewed, "running": running, "grasp": f"{best['shard_id']}/{best['row']}"}


def photograph(address: str, places: dict[str, str], folder: Path, only: set[str]) -> None:
    """Photograph each page: its visible part, or the full page where `whole` is true."""
    from playwright.sync_api import sync_playwright

    pictures: list[tuple[str, str, str, tuple[int, int], str, bool]] = [
        ("home", "/", "#jobs tbody tr", LAPTOP, "light", False),
        ("datasets", "/datasets", ".matrix", LAPTOP, "light", False),
        ("dataset", "/datasets/kitchen-1", ".matrix", LAPTOP, "dark", False),
        ("job", f"/jobs/{places['viewed']}", "#best .grasp", LAPTOP, "light", True),
        ("job-running", f"/jobs/{places['running']}", "#stages", LAPTOP, "dark", False),
        ("grasps", "/grasps", "#found canvas[data-state=ready]", LAPTOP, "light", False),
        ("grasp", f"/grasps/{places['grasp']}", ".viewer[data-state=ready]", (1440, 1000), "light", False),
        ("grasp-dark", f"/grasps/{places['grasp']}", ".viewer[data-state=ready]", (1440, 1000), "dark", False),
        ("hand", "/hands/allegro", ".viewer[data-state=ready]", (1440, 1000), "light", False),
        ("workers", "/workers", ".worker", LAPTOP, "light", False),
        ("chart", "/chart", ".trade circle", LAPTOP, "light", True),
        ("stability", "/stability", ".failure", (1440, 1180), "light", False),
        ("submit", "/submit", "[data-thing=object] figure[data-state=ready]", (1440, 1100), "light", False),
        ("phone-home", "/", "#jobs tbody tr", PHONE, "light", False),
        ("phone-grasp", f"/grasps/{places['grasp']}", ".viewer[data-state=ready]", PHONE, "dark", False),
        ("phone-datasets", "/datasets", ".matrix", PHONE, "light", False),
    ]
    program = shutil.which("chromium") or shutil.which("google-chrome")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=list(ARGUMENTS))
        for name, path, ready, (width, height), scheme, whole in pictures:
            if only and name not in only:
                continue
            context: Any = browser.new_context(
                base_url=address,
                viewport={"width": width, "height": height},
                color_scheme=scheme,
                device_scale_factor=2 if width < 500 else 1,
                reduced_motion="reduce",
            )
            page = context.new_page()
            page.goto(path)
            page.wait_for_selector(ready, timeout=SHOWN_MS)
            page.wait_for_timeout(3000)
            if whole:
                # Scroll through the page once, because some parts are drawn when they come into view.
                for share in range(11):
                    page.evaluate(f"scrollTo(0, {share / 10} * document.body.scrollHeight)")
                    page.wait_for_timeout(700)
                page.evaluate("scrollTo(0, 0)")
            if whole:  # sticky bars would cover parts of the page
                page.evaluate("document.querySelectorAll('.act, .reading').forEach(b => b.style.position = 'static')")
            picture = Image.open(io.BytesIO(page.screenshot(full_page=whole))).convert("RGB")
            # 256 colours take a fifth of the bytes; an octree keeps colours with few pixels, as in a legend.
            picture = picture.quantize(256, method=Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE)
            picture.save(folder / f"dashboard-{name}.png", optimize=True)
            context.close()
        browser.close()


if __name__ == "__main__":
    sys.exit(main())
