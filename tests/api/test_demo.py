"""`graspd demo` as a user runs it: a service of its own, one real job, files, and nothing left running."""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any

import pytest
from PIL import Image

from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.service.store.shards import read_shard
from tests.shell import completed

#: The least that passes all stages; the first run on a machine compiles kernels as well.
SMALL = ("--grasps", "4", "--scenes", "1", "--views", "1", "--fidelity", "draft")
STATISTICS = {"epsilon", "contact_area_cm2", "intersection_volume_cm3"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo")


@pytest.fixture(scope="module")
def result(folder: Path) -> dict[str, Any]:
    command = [sys.executable, "-m", "graspd", "demo", "--out", str(folder), "--json", *SMALL]
    done = completed(command, timeout=280)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout.splitlines()[-1])


def test_the_answer_has_the_keys_that_scripts_rely_on(result: dict[str, Any]) -> None:
    assert (result["state"], result["grasps"]) == ("succeeded", 4)
    assert 0 <= result["valid"] <= 4
    assert set(result["stages"]) == {"synthesize", "scene", "render"}
    assert all(stage["tasks"] == 1 and stage["seconds"] > 0 for stage in result["stages"].values())
    assert set(result["mean"]) == STATISTICS
    assert len(result["job"]) == 32


def test_the_shards_it_names_open(result: dict[str, Any]) -> None:
    kinds = [read_shard(Path(path)).kind for path in result["shards"]]
    assert sorted(kinds) == ["base", "scene", "views"]


def test_the_page_shows_the_pictures_it_made(result: dict[str, Any], folder: Path) -> None:
    page = Path(result["page"]).read_text()
    for path in map(Path, result["pictures"]):
        assert f'src="{path.name}"' in page
        with Image.open(path) as picture:
            assert min(picture.size) > 200
    assert len(result["pictures"]) == 2


def test_nothing_of_it_still_runs(result: dict[str, Any], folder: Path) -> None:
    running = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            environment = (process / "environ").read_bytes()
        except OSError:
            continue
        if os.fsencode(f"GRASPD_DATA_DIR={folder}") in environment:
            running.append(process.name)
    assert running == []


def test_a_demo_on_a_folder_in_use_is_refused(folder: Path) -> None:
    with Supervisor(Settings(data_dir=folder / "service", port=0), workers=0, api=False):
        command = [sys.executable, "-m", "graspd", "demo", "--out", str(folder), *SMALL]
        done = completed(command, timeout=60)
    assert done.returncode == 1
    assert "owns" in done.stderr or "in use" in done.stderr or "another graspd" in done.stderr


def test_a_wrong_number_is_refused_before_anything_starts(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "graspd", "demo", "--out", str(tmp_path / "out"), "--grasps", "0"]
    done = completed(command, timeout=60)
    assert done.returncode == 2
    assert not (tmp_path / "out").exists()
