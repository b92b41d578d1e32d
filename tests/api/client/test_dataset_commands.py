"""`graspd datasets` against the real service: Redis, controller, API. No worker, so cells wait."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd.client.client import Client
from graspd.service.model.states import State
from graspd.service.run.supervisor import Supervisor
from tests import waiting
from tests.api.client.test_commands import Shell, graspd, said, service

__all__ = ["graspd", "service"]  # fixtures
CREATE = ("datasets", "create", "kitchen", "--hands", "allegro,barrett", "--objects", "mug,block", "--grasps", "64")


def until(service: Supervisor, name: str, state: State) -> None:
    with Client(service.api_url) as client:
        cells = client.cells
        waiting.until(
            lambda: all(cell.planned and cell.state is state for cell in cells(name)), f"all of {name} is {state}"
        )


def test_a_dataset_is_created_listed_cancelled_and_retried(graspd: Shell, service: Supervisor) -> None:
    made = graspd.json(*CREATE, "--yes")
    assert made["estimate"]["cells"] == made["dataset"]["cells"] == 4
    assert "kitchen" in {dataset["name"] for dataset in graspd.json("datasets", "list")["datasets"]}
    until(service, "kitchen", State.QUEUED)
    graspd.json("datasets", "cancel", "kitchen")
    until(service, "kitchen", State.CANCELLED)
    assert graspd.json("datasets", "status", "kitchen")["state"] == "cancelled"
    graspd.json("datasets", "retry", "kitchen")
    until(service, "kitchen", State.QUEUED)


def test_the_matrix_is_a_table_of_objects_and_hands(graspd: Shell) -> None:
    graspd.json("datasets", "create", "table", *CREATE[3:], "--seed", "7", "--yes")
    lines = [line.split() for line in graspd("datasets", "status", "table").stdout.splitlines()]
    head = lines.index(["allegro", "barrett"])
    assert lines[head + 1 : head + 3] == [["mug", "queued", "queued"], ["block", "queued", "queued"]]


def test_a_dataset_takes_options_of_its_method(graspd: Shell) -> None:
    method = ("--method", "graspit", "--option", "keep=20", "--option", "steps=40000")
    made = graspd.json("datasets", "create", "annealed", *CREATE[3:], *method, "--yes")
    assert made["dataset"]["options"]["options"] == {"keep": 20, "steps": 40000}
    done = graspd("datasets", "create", "odd", *CREATE[3:], "--option", "keep")
    assert done.returncode == 2 and "write it as name=value" in said(done)


def test_nobody_at_the_terminal_or_no_name_means_nothing_starts(graspd: Shell) -> None:
    done = graspd("datasets", "create", "silent", *CREATE[3:])
    assert done.returncode == 2 and "--yes" in said(done)
    assert "256 grasps" in done.stdout
    assert graspd("datasets", "status", "silent").returncode == 2
    done = graspd("datasets", "create", "--hands", "allegro", "--objects", "mug")
    assert done.returncode == 2 and "give a name" in said(done)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ("--hands foot", "there is no hand or object 'foot'"),
        ("--objects no/such/folder", "there is no folder no/such/folder"),
        ("--grasps 0", "--grasps: "),
        ("--views 2", "views need scenes"),
        ("--fidelity superb", "unknown fidelity"),
        ("--fidelity auto --target gsr>=0.5", "graspd chart --publish"),
    ],
)
def test_a_mistake_is_one_line_that_says_what(graspd: Shell, changes: str, words: str) -> None:
    done = graspd(*CREATE, *changes.split(), "--yes")
    assert done.returncode == 2 and words in said(done)


def test_a_set_goes_by_its_name_beside_its_folder(
    graspd: Shell, service: Supervisor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Client(service.api_url) as client:
        client.add_object_set("kit", ["mug", "block"])
    (tmp_path / "kit").mkdir()
    (tmp_path / "kit" / "cup.stl").write_bytes(b"solid cup\nendsolid cup\n")
    monkeypatch.chdir(tmp_path)
    cells = {
        place: graspd.json("datasets", "estimate", "--hands", "allegro", "--objects", place)["cells"]
        for place in ("kit", "./kit")
    }
    assert cells == {"kit": 2, "./kit": 1}


def test_a_snapshot_of_nothing_is_refused(graspd: Shell, tmp_path: Path) -> None:
    graspd.json("datasets", "create", "empty", *CREATE[3:], "--seed", "9", "--yes")
    export = ("datasets", "export", "empty", "-o", str(tmp_path))
    assert "no shard yet" in said(graspd("datasets", "snapshot", "empty"))
    assert "no shard yet" in said(graspd(*export))
    assert "there is no format 'zip'" in said(graspd(*export, "--format", "zip"))


def test_a_spec_in_a_file_is_what_the_options_would_say(graspd: Shell, tmp_path: Path) -> None:
    spec = tmp_path / "kitchen.toml"
    spec.write_text('name = "spec"\nhands = ["allegro", "barrett"]\nobjects = ["mug", "block"]\ntotal_grasps = 250\n')
    dry = graspd.json("datasets", "create", "--spec", str(spec), "--dry-run")["estimate"]
    assert (dry["cells"], dry["asked"]) == (4, 252)  # 63 each: a quarter of 250, rounded up
    found = graspd.json("datasets", "estimate", "--spec", str(spec), "--objects", "mug", "--grasps", "10")
    assert (found["cells"], found["asked"]) == (2, 20)
    made = graspd.json("datasets", "create", "--spec", str(spec), "--yes")["dataset"]
    assert (made["name"], made["asked"]) == ("spec", 252)
