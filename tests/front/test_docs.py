"""Tutorials, docs/reference/python.md, the notebook and what needs a service, run as printed."""

from __future__ import annotations

import html
import json
import os
import re
import shlex
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest

import graspd
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from tests.conftest import REPOSITORY
from tests.docs_commands import run_page
from tests.shell import completed
from tests.waiting import PATIENCE_S, until_a_worker_is_idle
from tests.worker.hands.my_hand import write_my_hand


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[str, str]]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("service"), port=0)
    with Supervisor(settings, workers=1) as supervisor:
        supervisor.wait_ready(PATIENCE_S)
        until_a_worker_is_idle(supervisor.api_url)
        kept = {name: value for name, value in os.environ.items() if not name.startswith("GRASPD_")}
        yield kept | {"GRASPD_API_URL": supervisor.api_url, "GRASPD_DATA_DIR": str(settings.data_dir)}


def run(code: str, environment: dict[str, str], folder: Path) -> str:
    done = completed([sys.executable, "-c", code], env=environment, cwd=folder)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


def test_the_page_runs_as_it_is_printed(environment: dict[str, str], tmp_path: Path) -> None:
    blocks = re.findall(
        r"```python\n(.*?)```", (REPOSITORY / "docs" / "reference" / "python.md").read_text(), re.DOTALL
    )
    said = run("\n".join(blocks), environment, tmp_path)
    assert "<8 grasps of allegro on mug, 8 valid>" in said
    assert "<8 grasps of barrett on mug, 8 valid>" in said
    assert "no_such_file.stl" in said


def test_the_code_on_the_pages_of_the_dashboard_runs(environment: dict[str, str], tmp_path: Path) -> None:
    url = environment["GRASPD_API_URL"]
    with graspd.Client(url) as client, httpx.Client(base_url=url, trust_env=False, timeout=60) as http:
        job = client.submit("barrett", "mug", grasps=8, fidelity="draft").wait()
        shard = http.get(f"/v1/jobs/{job.id}").json()["shards"][0]["id"]
        pages = [http.get(page).text for page in (f"/jobs/{job.id}", f"/grasps/{shard}/3")]
    codes = [html.unescape(re.findall(r'<pre id="loader"[^>]*>(.*?)</pre>', page, re.DOTALL)[0]) for page in pages]
    assert "<8 grasps of barrett on mug, 8 valid>" in run(codes[0], environment, tmp_path)
    assert "<grasp at " in run(codes[1] + "\nprint(grasp)", environment, tmp_path)


def test_the_notebook_is_stored_with_its_outputs() -> None:
    notebook = json.loads((REPOSITORY / "examples" / "first_grasps.ipynb").read_text())
    cells = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    assert all(cell["outputs"] for cell in cells)
    assert "data:image/png" in json.dumps(cells[0]["outputs"]) and '"error"' not in json.dumps(cells)


@pytest.mark.slow
def test_the_notebook_runs(environment: dict[str, str], tmp_path: Path) -> None:
    notebook = json.loads((REPOSITORY / "examples" / "first_grasps.ipynb").read_text())
    cells = ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == "code"]
    run("\n".join(["import matplotlib; matplotlib.use('Agg')", *cells]), environment, tmp_path)
    assert (tmp_path / "grasps.h5").is_file()


@pytest.mark.slow
def test_a_hand_is_added_corrected_and_used_as_the_page_says(environment: dict[str, str], tmp_path: Path) -> None:
    write_my_hand(tmp_path)
    page = (REPOSITORY / "docs" / "how-to" / "hands.md").read_text()
    lines = "".join(re.findall(r"```sh\n(.*?)```", page, re.DOTALL)).replace("\\\n", " ").splitlines()
    for line in lines:
        program, *arguments = shlex.split(line, comments=True) or ["", ""]
        if program != "graspd" or arguments[:2] == ["hands", "check"]:
            continue
        done = completed([sys.executable, "-m", "graspd", *arguments], env=environment, cwd=tmp_path)
        assert done.returncode == 0, done.stderr[-2000:]
    (curl,) = [shlex.split(line) for line in lines if line.startswith("curl ")]
    url = next(part for part in curl if part.startswith("http"))
    body = json.loads(curl[curl.index("-d") + 1])
    with httpx.Client(base_url=environment["GRASPD_API_URL"], trust_env=False, timeout=60) as http:
        answer = http.post(httpx.URL(url).path, json=body)
        assert answer.status_code == 202, answer.text
        assert http.get("/v1/jobs", params={"hand": "my_hand"}).json()["items"][0]["state"] == "succeeded"


TUTORIALS = sorted((REPOSITORY / "docs" / "tutorials").glob("*.md"))


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_the_commands_of_a_tutorial_run(page: Path, tmp_path: Path) -> None:
    assert run_page(page, "", tmp_path) == []


def test_the_lines_that_read_the_first_grasps_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    graspd.synthesize("allegro", "mug", count=4, fidelity="draft", seed=1).save("mug.h5")
    (block,) = re.findall(r"```python\n(.*?)```", (TUTORIALS[0]).read_text(), re.DOTALL)
    said: dict[str, Any] = {}
    exec(block, said)
    best = said["best"]
    assert (len(best), best.joint_positions.shape) == (3, (3, 16)) and (best.metric("epsilon") > 0).all()
