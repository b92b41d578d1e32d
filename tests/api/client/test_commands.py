"""The commands against the real service: embedded Redis, file store, SQLite, controller, API. No worker: jobs wait."""

import json
import os
import socket
import subprocess
import sys
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import pytest
from typer.testing import CliRunner

from graspd import GraspdError, demo, remote
from graspd.cli import build_app
from graspd.client.client import Client
from graspd.service.cli import plain_console
from graspd.service.model.states import AssetKind, State
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.service.store.library import load_asset_files
from graspd.service.store.network_file import to_bytes
from graspd.service.store.records import publish_record
from graspd.service.store.store import open_store
from tests import waiting
from tests.networks import random_network
from tests.service.pipeline.test_fidelity_choice import scene_chart
from tests.shell import completed
from tests.waiting import PATIENCE_S

STL = b"solid box\nendsolid box\n"
CREATE = ("datasets", "create", "kitchen", "--hands", "allegro,barrett", "--objects", "mug,block", "--grasps", "64")
_PAIR = "submit --hand allegro --object mug"


@dataclass(frozen=True)
class Shell:
    environment: dict[str, str]
    in_process: bool = True

    @property
    def apart(self) -> Self:
        return replace(self, in_process=False)

    def __call__(self, *arguments: str, typed: str = "") -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "graspd", *arguments]
        if not self.in_process:
            return completed(command, env=self.environment, timeout=60)
        ours = {name: None for name in os.environ if name.startswith("GRASPD_")}
        done = CliRunner().invoke(build_app(), arguments, env={**ours, **self.environment}, input=typed)
        return subprocess.CompletedProcess(command, done.exit_code, done.stdout, done.stderr)

    def json(self, *arguments: str) -> dict[str, Any]:
        done = self(*arguments, "--json")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1])


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Supervisor]:
    settings = Settings(data_dir=tmp_path_factory.mktemp("service"), port=0)
    with Supervisor(settings, workers=0) as supervisor:
        supervisor.wait_ready(PATIENCE_S)
        yield supervisor


@pytest.fixture(scope="module")
def graspd(service: Supervisor) -> Shell:
    names = {"GRASPD_API_URL": service.api_url, "GRASPD_DATA_DIR": str(service.settings.data_dir)}
    return Shell({name: value for name, value in os.environ.items() if not name.startswith("GRASPD_")} | names)


def said(done: subprocess.CompletedProcess[str]) -> str:
    lines = done.stderr.strip().splitlines()
    assert len(lines) == 1, done.stderr
    return lines[0]


def test_a_submitted_job_is_listed_shown_cancelled_and_retried(graspd: Shell) -> None:
    job = graspd.json("submit", "--hand", "allegro", "--object", "mug", "--seed", "1", "--scenes", "1")
    assert job["state"] == "queued"
    assert job["job"] in {entry["id"] for entry in graspd.json("jobs")["jobs"]}
    assert graspd.json("status", job["job"][:10])["stages"]["scene"]["tasks"] == 1
    assert graspd.json("cancel", job["job"])["state"] == "cancelled"
    assert graspd.json("retry", job["job"])["state"] == "queued"
    assert graspd.json("logs", job["job"])["attempts"] == []


def test_a_cancelled_job_is_a_failure_to_whoever_waits(graspd: Shell, service: Supervisor, tmp_path: Path) -> None:
    submit = (*_PAIR.split(), "--seed", "2")
    job = graspd.json(*submit)["job"]
    graspd("cancel", job)
    done = graspd(*submit)
    assert done.returncode == 1 and f"`graspd retry {job[:12]}` runs it again" in said(done)
    with Client(service.api_url) as client, remote.Client(service.api_url) as user:
        one, again = user.job(job), client.job(job).request
        show = lambda: demo.run_job(client, again, tmp_path, plain_console())  # noqa: E731
        for call, words in ((one.wait, "ended cancelled"), (one.grasps, "no grasps yet"), (show, "the job cancelled")):
            with pytest.raises(GraspdError, match=words):
                call()


def test_a_job_asks_for_pictures_and_neighbours(graspd: Shell, tmp_path: Path) -> None:
    pair = ("--hand", "allegro", "--object", "mug")
    (tmp_path / "s.yaml").write_text("supports: [{kind: half_space}]\nneighbours: [{object: block}]\n")
    asked = (
        "--scenes 1 --views 1",
        "--scenes 1 --views 1 --channels normals --width 640 --height 480",
        "--scene bin --with block",
        "--scene bin --with block --with bottle",
        f"--scene {tmp_path / 's.yaml'}",
    )
    assert len({graspd.json("submit", *pair, *words.split())["job"] for words in asked}) == len(asked)
    assert "give more characters" in said(graspd("status", "")), "their ids have the empty prefix in common"


def test_the_built_in_hands_and_objects_are_there(graspd: Shell) -> None:
    assert "allegro" in {hand["name"] for hand in graspd.apart.json("hands", "list")["hands"]}
    assert graspd.json("objects", "show", "mug")["verdict"] == "accept"


def test_a_network_is_added_named_by_a_job_and_deleted(graspd: Shell, tmp_path: Path) -> None:
    digest = graspd.json("hands", "show", "barrett")["digest"]
    for seed, name in enumerate(("net", "other")):
        (tmp_path / f"{name}.npz").write_bytes(to_bytes(random_network(hand="barrett", digest=digest, seed=seed)))
    made = graspd.json("networks", "add", str(tmp_path / "net.npz"), "--licence", "MIT")
    assert (made["name"], made["verdict"]) == ("net", "accept")
    listed = graspd("networks", "list").stdout
    assert "net" in listed and f"barrett ({digest[:12]})" in listed
    assert f"{digest}, 2 joints" in graspd("networks", "show", "net").stdout
    pair = ("--hand", "barrett", "--object", "mug", "--scene", "table", "--method", "learned")
    job = graspd.json("submit", *pair, "--option", "network=net", "--option", "starts=2")
    assert graspd.json("submit", *pair, "--option", f"network={made['digest']}", "--option", "starts=2") == job
    assert f"needed by job {job['job']}" in said(graspd("networks", "delete", "net", "--yes"))
    assert graspd.json("submit", *pair, "--option", f"network={tmp_path / 'other.npz'}")["job"] != job["job"]
    assert {one["name"] for one in graspd.json("networks", "list")["networks"]} == {"net", "other"}
    few = ("--hands", "barrett", "--objects", "mug", "--grasps", "64", "--yes")
    rest = ("--scene", "table", "--method", "learned", "--option", "network=other")
    made = graspd.json("datasets", "create", "proposed", *few, *rest)["dataset"]
    assert made["options"]["options"]["network"] != "other", "the record names its digest"
    for command in (("cancel",), ("delete", "--yes")):
        assert graspd(*command, job["job"]).returncode == 0
    assert graspd("networks", "delete", "net", "--yes").stdout == "network net is deleted\n"


@pytest.mark.parametrize("kind", ["delete", "objects delete", "datasets delete"])
def test_what_is_deleted_by_a_word_is_restored(graspd: Shell, kind: str) -> None:
    """Without a terminal to ask at it takes a word."""
    name, _ = _deletable(graspd, kind)
    command, group = kind.split(), kind.split()[:-1]
    done = graspd(*command, name)
    assert (done.returncode, done.stdout) == (2, "")
    assert "--yes deletes without it" in said(done)
    gone = graspd(*command, name, "--yes")
    assert gone.returncode == 0, gone.stderr
    done = graspd(*group, "restore", name)
    assert done.returncode == 0 and f"{name[:8]}" in done.stdout and "is restored" in done.stdout
    assert graspd(*group, "restore", name).returncode == 2, "it is not deleted any more"


def test_at_a_terminal_the_question_is_answered(graspd: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.client.reports.sys", SimpleNamespace(stdin=SimpleNamespace(isatty=lambda: True)))
    name, words = _deletable(graspd, "datasets delete")
    for answer, code in (("n", 2), ("y", 0)):
        done = graspd("datasets", "delete", name, typed=answer)
        assert done.returncode == code, done.stderr
        assert words in done.stdout
        assert graspd("datasets", "status", name).returncode == 2 - code


def _deletable(graspd: Shell, kind: str) -> tuple[str, str]:
    pair = ("--hand", "allegro", "--object", "mug", "--seed", str(zlib.crc32(os.urandom(8)) >> 2))
    thing = f"t{os.urandom(4).hex()}"
    if kind == "delete":
        job = graspd.json("submit", *pair)["job"]
        graspd("cancel", job)
        return job, "allegro on mug"
    if kind == "datasets delete":
        few = ("--hands", "allegro", "--objects", "mug", "--grasps", "32", "--yes")
        graspd.json("datasets", "create", thing, *few)
        graspd("datasets", "cancel", thing)
        return thing, f"Delete dataset {thing} with 1 cell,"
    path = Path(graspd.environment["GRASPD_DATA_DIR"]) / f"{thing}.stl"
    path.write_bytes(STL + thing.encode())
    graspd("objects", "add", str(path), "--no-wait")
    return thing, thing


def test_an_object_is_added_from_a_file_and_its_licence_kept(graspd: Shell, tmp_path: Path) -> None:
    (tmp_path / "crate.stl").write_bytes(STL + b" ")
    said = ("--licence", "CC-BY-4.0", "--source", "https://example.org/crate")
    made = graspd.json("objects", "add", str(tmp_path / "crate.stl"), *said, "--no-wait")
    assert made["name"] == "crate"
    store = open_store((Path(graspd.environment["GRASPD_DATA_DIR"]) / "store").as_uri())
    kept = json.loads(load_asset_files(store, AssetKind.OBJECT, made["digest"])["asset.json"])
    assert (kept["licence"], kept["source"]) == ("CC-BY-4.0", "https://example.org/crate")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("submit --hand alegro --object mug", "did you mean allegro?"),
        (f"{_PAIR} --fidelity perfect", "standard"),
        ("datasets estimate --hands alegro --objects mug", "did you mean allegro?"),
        *((f"{command} 0123456789", "0123456789") for command in ("status", "cancel", "retry", "logs")),
        ("datasets create --hands allegro --objects mug", "give a name"),
        (f"{' '.join(CREATE)} --yes --hands foot", "there is no hand or object 'foot'"),
        (f"{' '.join(CREATE)} --yes --objects no/such/folder", "there is no folder no/such/folder"),
        (f"{' '.join(CREATE)} --yes --objects {','.join(['foot'] * 99)}", "there is no hand or object 'foot'"),
        (f"{' '.join(CREATE)} --yes --grasps 0", "--grasps: "),
        (f"{' '.join(CREATE)} --yes --views 2", "views need scenes"),
        (f"{' '.join(CREATE)} --yes --fidelity auto --target gsr>=0.5", "graspd chart --publish"),
        (f"{' '.join(CREATE)} --yes --objects {__file__}", f"run `graspd objects add {__file__}`"),
        ("keys limit lab", "give at least one limit, such as --jobs-per-day"),
        ("projects limit vision", "give at least one limit, such as --grasps-per-day"),
        ("projects limit a/b --grasps-per-day 5", "'a/b' is no name of a project"),
    ],
)
def test_a_mistake_is_one_line_and_exit_2(graspd: Shell, arguments: str, words: str) -> None:
    done = graspd(*arguments.split())
    assert done.returncode == 2
    assert words in (done.stderr if arguments.startswith("datasets estimate") else said(done))


def test_no_service_and_an_address_that_is_no_graspd_are_told(graspd: Shell) -> None:
    done = Shell(graspd.environment | {"GRASPD_API_URL": "http://127.0.0.1:9"}).apart("jobs")
    assert done.returncode == 1 and "graspd up" in said(done)
    done = graspd("jobs", "--url", f"{graspd.environment['GRASPD_API_URL']}/static/")
    assert done.returncode == 2 and "static" in said(done)


def test_an_api_that_cannot_start_says_why_in_one_line(graspd: Shell, tmp_path: Path) -> None:
    (tmp_path / "file").write_bytes(b"")
    no_store = Shell(graspd.environment | {"GRASPD_STORE_URL": (tmp_path / "file" / "store").as_uri()})
    with socket.create_server(("127.0.0.1", 0)) as taken:
        for shell, arguments, code, words in (
            (graspd, ("--port", str(taken.getsockname()[1])), 1, "in use"),
            (graspd, ("--host", "0.0.0.0", "--port", "0"), 2, "graspd keys add"),
            (no_store, ("--port", "0"), 1, str(tmp_path / "file")),
        ):
            done = shell.apart("api", *arguments)
            assert done.returncode == code
            assert words in said(done)


def test_keys_are_made_listed_and_revoked(graspd: Shell, tmp_path: Path) -> None:
    shell = Shell(graspd.environment | {"GRASPD_DATA_DIR": str(tmp_path)})
    assert shell.json("keys", "add", "lab", "--scope", "read")["key"].startswith("gd_")
    assert [(key["name"], key["revoked"]) for key in shell.json("keys", "list")["keys"]] == [("lab", None)]
    shell.json("keys", "revoke", "lab")
    assert shell.json("keys", "list")["keys"][0]["revoked"] is not None


def test_a_job_with_a_target_says_how_its_fidelity_was_chosen(graspd: Shell, service: Supervisor) -> None:
    asked = ("submit", "--hand", "allegro", "--object", "mug", "--scene", "shelf", "--fidelity", "auto", "--target")
    key = publish_record(open_store(service.settings.resolved_store_url), "scene_charts/shelf", scene_chart("shelf"))
    done = graspd(*asked, "lift>=0.8")
    assert done.returncode == 0, done.stderr
    told = f"fidelity: standard, chosen for lift>=0.8, reached 0.85 with the same hand and object in {key}"
    assert told in done.stdout
    assert graspd.json(*asked, "lift>=0.9")["choice"]["reached"] == 0.95


def until(service: Supervisor, name: str, state: State) -> None:
    with Client(service.api_url) as client:
        are = lambda: {(cell.planned, cell.state) for cell in client.cells(name)}  # noqa: E731
        waiting.until(lambda: are() == {(True, state)}, f"all of {name} is {state}")


def test_a_dataset_is_created_listed_cancelled_and_retried(graspd: Shell, service: Supervisor) -> None:
    made = graspd.json(*CREATE, "--yes")
    assert made["estimate"]["cells"] == made["dataset"]["cells"] == 4
    assert "kitchen" in {dataset["name"] for dataset in graspd.json("datasets", "list")["datasets"]}
    until(service, "kitchen", State.QUEUED)
    graspd.json("datasets", "cancel", "kitchen")
    until(service, "kitchen", State.CANCELLED)
    assert graspd.json("datasets", "status", "kitchen")["state"] == "cancelled"
    waited = graspd(*CREATE, "--yes", "--wait")
    assert waited.returncode == 1 and "`graspd datasets retry kitchen` runs it again" in waited.stderr
    graspd.json("datasets", "retry", "kitchen")
    until(service, "kitchen", State.QUEUED)


def test_a_dataset_is_a_table_and_without_shards_no_snapshot(graspd: Shell, tmp_path: Path) -> None:
    graspd.json("datasets", "create", "table", *CREATE[3:], "--seed", "7", "--yes")
    lines = [line.split() for line in graspd("datasets", "status", "table").stdout.splitlines()]
    head = lines.index(["allegro", "barrett"])
    assert lines[head + 1 : head + 3] == [["mug", "queued", "queued"], ["block", "queued", "queued"]]
    for command in (("snapshot", "table"), ("export", "table", "-o", str(tmp_path))):
        assert "no shard yet" in said(graspd("datasets", *command))


def test_nobody_at_the_terminal_means_nothing_starts(graspd: Shell) -> None:
    done = graspd("datasets", "create", "silent", *CREATE[3:])
    assert done.returncode == 2 and "--yes" in said(done)
    assert "256 grasps" in done.stdout
    assert graspd("datasets", "status", "silent").returncode == 2


def test_a_set_goes_by_its_name_beside_its_folder(graspd: Shell, tmp_path: Path, monkeypatch: Any) -> None:
    with Client(graspd.environment["GRASPD_API_URL"]) as client:
        client.add_object_set("kit", ["mug", "block"])
    (tmp_path / "kit").mkdir()
    (tmp_path / "kit" / "cup.stl").write_bytes(b"solid cup\nendsolid cup\n")
    monkeypatch.chdir(tmp_path)
    for place, cells in (("kit", 2), ("./kit", 1)):
        assert graspd.json("datasets", "estimate", "--hands", "allegro", "--objects", place)["cells"] == cells


def test_a_folder_of_unusable_objects_makes_no_dataset(graspd: Shell, tmp_path: Path) -> None:
    (tmp_path / "box.stl").write_bytes(STL)
    (tmp_path / "asset.json").write_text("{}")
    done = graspd("datasets", "create", "none", "--hands", "allegro", "--objects", str(tmp_path), "--yes")
    assert "none of the 1 objects can be used" in said(done)


def test_a_spec_in_a_file_is_what_the_options_would_say(graspd: Shell, tmp_path: Path) -> None:
    spec = tmp_path / "kitchen.toml"
    spec.write_text('name = "spec"\nhands = ["allegro", "barrett"]\nobjects = ["mug", "block"]\ntotal_grasps = 250\n')
    dry = graspd.json("datasets", "create", "--spec", str(spec), "--dry-run")["estimate"]
    assert (dry["cells"], dry["asked"]) == (4, 252)  # 63 each: a quarter of 250, rounded up
    found = graspd.json("datasets", "estimate", "--spec", str(spec), "--objects", "mug", "--grasps", "10")
    assert (found["cells"], found["asked"]) == (2, 20)
