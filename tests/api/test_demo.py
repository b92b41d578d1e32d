"""`graspd demo` as a user runs it: a service of its own, one real job, files, and nothing left running."""

import json
import os
import sys
from pathlib import Path

from PIL import Image

from graspd.service.store.shards import read_shard
from tests.shell import completed
from tests.worker.commands_run import refused

#: The least that passes all stages; the first run on a machine compiles kernels as well.
SMALL = ("--grasps", "4", "--scenes", "1", "--views", "1", "--fidelity", "draft")


def processes_of(folder: Path) -> list[str]:
    running = []
    for process in Path("/proc").glob("[0-9]*"):
        try:
            environment = (process / "environ").read_bytes()
        except OSError:
            continue
        if os.fsencode(f"GRASPD_DATA_DIR={folder}") in environment:
            running.append(process.name)
    return running


def test_a_demo_leaves_its_files_and_nothing_that_runs(tmp_path: Path) -> None:
    done = completed([sys.executable, "-m", "graspd", "demo", "--out", tmp_path, "--json", *SMALL], timeout=280)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout.splitlines()[-1])
    assert (result["state"], result["grasps"], len(result["job"])) == ("succeeded", 4, 32)
    assert 0 <= result["valid"] <= 4
    assert set(result["stages"]) == {"synthesize", "scene", "render"}
    assert all(stage["tasks"] == 1 and stage["seconds"] > 0 for stage in result["stages"].values())
    assert set(result["mean"]) == {"epsilon", "contact_area_cm2", "intersection_volume_cm3"}
    assert sorted(read_shard(Path(path)).kind for path in result["shards"]) == ["base", "scene", "views"]
    page = Path(result["page"]).read_text()
    assert len(result["pictures"]) == 2
    for path in map(Path, result["pictures"]):
        assert f'src="{path.name}"' in page
        with Image.open(path) as picture:
            assert min(picture.size) > 200
    assert processes_of(tmp_path) == []


def test_a_wrong_number_is_refused_before_anything_starts(tmp_path: Path) -> None:
    assert "--grasps: must be at least 1" in refused("demo --grasps 0 --out", tmp_path / "out")
    assert not (tmp_path / "out").exists()
