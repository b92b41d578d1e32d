"""A user's own files through the whole service: command line, API, controller, worker with the real engine."""

import json
import os
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import trimesh

from graspd.service.index.index import Index
from graspd.service.index.rebuild import differences
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.shell import completed
from tests.waiting import PATIENCE_S, until_a_worker_is_idle
from tests.worker.hands.urdfs import gripper_urdf

#: Runs `graspd` as a user does; gives its exit code, the JSON object on the last line, and standard error.
Shell = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A hand without meshes, a box in millimetres, and a folder of two objects."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "pincer.urdf").write_bytes(gripper_urdf(coupled=False))
    trimesh.creation.box((60.0, 40.0, 30.0)).export(folder / "brick.stl")
    (folder / "toys").mkdir()
    trimesh.creation.icosphere(subdivisions=2, radius=0.02).export(folder / "toys" / "ball.ply")
    trimesh.creation.cylinder(radius=0.015, height=0.06).export(folder / "toys" / "rod.obj")
    (folder / "toys" / "torn.off").write_text("OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n")
    return folder


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Supervisor]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("service"), port=0, device="cpu")
    with Supervisor(settings, workers=1) as supervisor:
        supervisor.wait_ready(PATIENCE_S)
        until_a_worker_is_idle(supervisor.api_url)
        yield supervisor


@pytest.fixture(scope="module")
def graspd(service: Supervisor, files: Path) -> Shell:
    names = {"GRASPD_API_URL": service.api_url, "GRASPD_DATA_DIR": str(service.settings.data_dir)}
    kept = {name: value for name, value in os.environ.items() if not name.startswith("GRASPD_")}
    # The tests' own folder of modules, not what lies in the user's.
    path = os.pathsep.join(filter(None, (str(Path(__file__).parents[2]), kept.get("PYTHONPATH"))))

    def run(*arguments: str) -> tuple[int, dict[str, Any], str]:
        command, own = [sys.executable, "-m", "graspd", *arguments, "--json"], kept | names | {"PYTHONPATH": path}
        done = completed(command, env=own, cwd=files, timeout=280)
        lines = done.stdout.strip().splitlines()
        return done.returncode, json.loads(lines[-1]) if lines else {}, done.stderr

    return run


def test_a_refused_object_gets_in_with_the_named_fix(graspd: Shell) -> None:
    code, _, said = graspd("objects", "add", "brick.stl")
    assert code == 2 and "--units mm" in said
    code, brick, _ = graspd("objects", "add", "brick.stl", "--units", "mm", "--density", "500")
    assert (code, brick["verdict"]) == (0, "accept")
    assert brick["facts"]["mass_kg"] == pytest.approx(60e-3 * 40e-3 * 30e-3 * 500, rel=1e-3)


def test_a_folder_of_objects_becomes_a_dataset_and_files(graspd: Shell, service: Supervisor, tmp_path: Path) -> None:
    code, hand, _ = graspd("hands", "add", "pincer.urdf", "--no-self-test")
    assert (code, hand["name"], hand["verdict"]) == (0, "pincer", "accept")
    assert hand["facts"]["palm_approach"] == [0.0, 0.0, 1.0]
    wanted = ("datasets", "create", "play", "--hands", "pincer", "--objects", "toys", "--grasps", "4")
    cheap = ("--fidelity", "draft", "--want", "candidates", "--validation", "none")
    code, seen, _ = graspd(*wanted, *cheap, "--dry-run")
    assert code == 0 and seen["estimate"]["cells"] == 3 and "dataset" not in seen
    code, made, said = graspd(*wanted, *cheap, "--yes", "--wait")
    assert code == 0, said
    assert (made["dataset"]["state"], made["dataset"]["grasps"]) == ("succeeded", 8)
    assert made["refused"] == ["torn"]
    code, status, _ = graspd("datasets", "status", "play")
    states = {cell["object"]: cell["state"] for cell in status["matrix"]}
    assert states == {"ball": "succeeded", "rod": "succeeded"}
    code, export, _ = graspd("datasets", "export", "play", "-o", str(tmp_path / "play"))
    assert code == 0 and export["complete"]
    assert len(list((tmp_path / "play").rglob("*.h5"))) == export["files"] == 2
    settings = service.settings
    index = Index(settings.resolved_index_url)
    assert differences(index, open_store(settings.resolved_store_url)) == []
    index.close()
