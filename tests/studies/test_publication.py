"""Published folders: whole or absent, opened by the libraries of the hub, uploaded to a stub of it on loopback."""

import base64
import json
import os
import re
import sys
import tarfile
import threading
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import yaml

from graspd.exchange import webdataset
from graspd.service.model.errors import ConflictError, InputError
from graspd.service.pipeline.datasets import actions
from graspd.service.store.store import open_store
from graspd.studies.cards.contents import contents_of_store
from graspd.studies.publication import PublicationOptions, publish
from tests.shell import completed
from tests.studies.test_cards import NAME, dataset
from tests.worker.commands_run import graspd, refused

pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed; pip install 'graspd[parquet]'")
LICENCE = "--licence CC-BY-4.0"
GRASPS, PICTURES = 160, 16


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a dataset of two hands and two objects, and its snapshot."""
    folder = tmp_path_factory.mktemp("data")
    services = dataset(folder)
    actions.take_snapshot(services, NAME)
    services.close()
    return folder


@pytest.fixture(scope="module")
def hub(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("published") / "kitchen-hub"
    graspd(f"datasets publish {NAME} {LICENCE} --data-dir", data, "--to", folder)
    return folder


def contents_of(data: Path):
    return contents_of_store(open_store(f"file://{data / 'store'}", make=False), NAME, cache=data / "cache")


def no_progress(done: float, total: float, step: str) -> None:
    pass


def sums(folder: Path) -> dict[str, str]:
    return dict(line.split(maxsplit=1)[::-1] for line in (folder / "checksums.sha256").read_text().splitlines())


def test_a_published_folder_has_all_files_and_their_checksums(hub: Path, data: Path) -> None:
    files = {str(file.relative_to(hub)) for file in hub.rglob("*") if file.is_file()}
    assert set(sums(hub)) == files - {"checksums.sha256"} and not list(hub.parent.glob(".*.part"))
    assert completed(("sha256sum", "-c", "--strict", "--quiet", "checksums.sha256"), cwd=hub).returncode == 0
    assert {"card.json", "croissant.json", "licences.json", "snapshot.json", "samples.jpg"} < files
    head = yaml.safe_load((hub / "README.md").read_text().split("---")[1])
    assert head["license"] == "cc-by-4.0" and [one["config_name"] for one in head["configs"]] == ["grasps", "pictures"]
    for table, count in (("grasps", GRASPS), ("pictures", PICTURES)):
        sides = [pq.read_table(hub / table / f"{split}-00000.parquet").to_pylist() for split in ("train", "test")]
        assert sum(map(len, sides)) == count
        assert {row["object"] for row in sides[0]}.isdisjoint({row["object"] for row in sides[1]})
    samples = 0
    for tar in sorted((hub / "webdataset").iterdir()):
        with tarfile.open(tar) as opened:
            records = [json.load(opened.extractfile(m)) for m in opened if m.name.endswith(".json")]  # type: ignore[arg-type]
        assert all(record["grasps"]["base_row"] for record in records), "types of lists are inferred from the first"
        samples += len(records)
    assert 0 < samples <= PICTURES
    licences = json.loads((hub / "licences.json").read_text())
    assert licences["dataset"] == "CC-BY-4.0" and licences["objects"]["mug"]["licence"] == "Apache-2.0"
    before = {file: (hub / file).stat().st_mtime_ns for file in files}
    graspd(f"datasets publish {NAME} {LICENCE} --data-dir", data, "--to", hub)
    assert {file: (hub / file).stat().st_mtime_ns for file in files} == before, "a second call has nothing to do"
    assert "another licence" in refused(f"datasets publish {NAME} --licence MIT --data-dir", data, "--to", hub)


def test_an_interrupted_publication_is_absent_and_then_continued(hub, data, tmp_path, monkeypatch) -> None:
    contents, options, folder = contents_of(data), PublicationOptions("CC-BY-4.0"), tmp_path / "kitchen-hub"

    def stop(pictures: Any, indices: Any, path: Path) -> None:
        path.write_bytes(b"half of it")
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(webdataset, "write_tar", stop)
        with pytest.raises(KeyboardInterrupt):
            publish(contents, folder, options, no_progress)
    draft = tmp_path / ".kitchen-hub.part"
    assert not folder.exists() and not list(draft.rglob("*.tar.*")) and (draft / "grasps/train-00000.parquet").is_file()
    whole = {file: file.stat().st_ino for file in (draft / "grasps").iterdir()}
    with pytest.raises(ConflictError, match="another licence"):
        publish(contents, folder, replace(options, licence="MIT"), no_progress)
    publish(contents, folder, options, no_progress)
    assert {file.name: (folder / "grasps" / file.name).stat().st_ino for file in whole} == {
        file.name: number for file, number in whole.items()
    }, "finished files are not written again"
    data_files = [name for name in sums(hub) if name.endswith((".parquet", ".tar"))]
    assert [sums(folder)[name] for name in data_files] == [sums(hub)[name] for name in data_files]


def test_unknown_licences_are_named_and_must_be_accepted(data: Path, tmp_path: Path) -> None:
    contents = contents_of(data)
    contents = replace(contents, objects={n: replace(o, licence="") for n, o in contents.objects.items()})
    options = PublicationOptions(held_out=0.0, webdataset=False)
    with pytest.raises(InputError, match="unknown of the dataset itself, object block, object mug; state it by"):
        publish(contents, tmp_path / "x", options, no_progress)
    publish(contents, tmp_path / "x", replace(options, accept_unknown_licences=True), no_progress)
    page = (tmp_path / "x" / "README.md").read_text()
    assert "**The licence is unknown of the dataset itself, object block, object mug.**" in page
    assert yaml.safe_load(page.split("---")[1])["license"] == "unknown"
    assert sorted(file.name for file in (tmp_path / "x" / "grasps").iterdir()) == ["train-00000.parquet"]


def run_offline(code: str, folder: Path, home: Path) -> str:
    """Run Python code beside a published folder, without network; return its output."""
    env = os.environ | {"HF_HOME": str(home), "HF_DATASETS_OFFLINE": "1", "HF_HUB_OFFLINE": "1"}
    done = completed([sys.executable, "-c", code], cwd=folder.parent, env=env)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.skipif(not find_spec("datasets"), reason="`pip install datasets` runs this test")
def test_what_the_card_says_of_loading_it_works(hub: Path, tmp_path: Path) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", (hub / "README.md").read_text(), re.DOTALL)
    code += """
whole = load_dataset("webdataset", data_files=files, split="train")
print(len(grasps), len(pictures), pictures[0]["rgb"].size, len(list(samples)) == len(whole) > 0)
print(set(load_dataset("kitchen-hub")), grasps.features["grasp_pose"].length)
"""
    lines = run_offline(code, hub, tmp_path).splitlines()
    assert lines[-2] == f"{GRASPS // 2} {PICTURES // 2} (24, 16) True"
    assert lines[-1] in ("{'train', 'test'} 7", "{'test', 'train'} 7")


@pytest.mark.skipif(not find_spec("mlcroissant"), reason="`pip install mlcroissant` runs this test")
def test_croissants_own_library_finds_no_fault_and_reads_the_tables(hub: Path, tmp_path: Path) -> None:
    code = """
import json, mlcroissant
found = mlcroissant.Dataset("kitchen-hub/croissant.json")
issues = found.metadata.ctx.issues
rows = {name: list(found.records(name)) for name in ("grasps", "pictures")}
print(json.dumps([sorted(issues.errors), sorted(issues.warnings), {name: len(of) for name, of in rows.items()},
    rows["grasps"][0]["grasps/grasp_pose"], rows["pictures"][0]["pictures/rgb"].size]))
"""
    errors, warnings, counts, pose, size = json.loads(run_offline(code, hub, tmp_path).splitlines()[-1])
    assert not errors and not warnings and counts == {"grasps": GRASPS, "pictures": PICTURES}
    stored = pq.read_table(hub / "grasps" / "test-00000.parquet").to_pylist()[0]
    assert pose == stored["grasp_pose"] and size == [24, 16]
    files = {
        one["name"]: one["sha256"]
        for one in json.loads((hub / "croissant.json").read_text())["distribution"]
        if "sha256" in one
    }
    assert files == {name: digest for name, digest in sums(hub).items() if name in files} and len(files) == 6


@dataclass
class StubHub:
    """Hub's API as huggingface_hub calls it; `files` has the content of the repository."""

    url: str = ""
    repository: dict[str, Any] = field(default_factory=dict)
    objects: dict[str, bytes] = field(default_factory=dict)
    files: dict[str, bytes] = field(default_factory=dict)
    commits: int = 0

    def answer(self, method: str, path: str, body: bytes) -> tuple[int, Any]:
        if path == "/api/whoami-v2":
            return 200, {"name": "lab", "type": "user"}
        if path == "/api/validate-yaml":
            return 200, {"errors": [], "warnings": []}
        if path == "/api/repos/create":
            self.repository = self.repository or json.loads(body)
            return 200, {"url": f"{self.url}/datasets/lab/kitchen"}
        if path.startswith("/api/datasets/lab/kitchen/tree/main"):
            return 200, [{"type": "file", "path": name, "oid": "0", "size": len(of)} for name, of in self.files.items()]
        if path == "/api/datasets/lab/kitchen/preupload/main":
            names = [one["path"] for one in json.loads(body)["files"]]
            modes = {True: "lfs", False: "regular"}
            return 200, {"files": [{"path": n, "uploadMode": modes[n.endswith((".parquet", ".tar", ".png"))],
                                    "shouldIgnore": False, "oid": None} for n in names]}  # fmt: skip
        if path.endswith("/info/lfs/objects/batch"):
            asked = json.loads(body)["objects"]
            link = {o["oid"]: {"actions": {"upload": {"href": f"{self.url}/put/{o['oid']}"}}} for o in asked}
            answers = [one | ({} if one["oid"] in self.objects else link[one["oid"]]) for one in asked]
            return 200, {"transfer": "basic", "objects": answers}
        if method == "PUT":
            self.objects[path.rsplit("/", 1)[1]] = body
            return 200, {}
        if path == "/api/datasets/lab/kitchen/commit/main":
            for line in map(json.loads, body.splitlines()):
                value = line["value"]
                if line["key"] == "file":
                    self.files[value["path"]] = base64.b64decode(value["content"])
                elif line["key"] == "lfsFile":
                    self.files[value["path"]] = self.objects[value["oid"]]
                elif line["key"] == "deletedFile":
                    del self.files[value["path"]]
            self.commits += 1
            return 200, {"commitUrl": f"{self.url}/datasets/lab/kitchen/commit/1", "commitOid": "1", "hookOutput": ""}
        if path == "/api/datasets/lab/kitchen" or path.startswith("/api/datasets/lab/kitchen/revision"):
            return 200, {"id": "lab/kitchen", "siblings": [{"rfilename": name} for name in self.files]}
        return 404, {"error": f"{method} {path}"}


@pytest.fixture
def stub() -> Iterator[StubHub]:
    hub = StubHub()

    class Handler(BaseHTTPRequestHandler):
        def handle_request(self) -> None:
            body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
            known = self.path.startswith("/put/") or self.headers.get("Authorization") == "Bearer hf_secret"
            code, answer = hub.answer(self.command, self.path, body) if known else (401, {"error": "no such token"})
            data = json.dumps(answer).encode()
            self.send_response(code)
            self.send_header("Content-Type", "application/json")
            self.send_header("Content-Length", str(len(data)))
            self.end_headers()
            self.wfile.write(data)

        do_GET = do_POST = do_PUT = handle_request  # noqa: N815

        def log_message(self, *args: Any) -> None:
            pass

    server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    hub.url = f"http://127.0.0.1:{server.server_port}"
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield hub
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.skipif(not find_spec("huggingface_hub"), reason="needs the extra: pip install graspd[hub]")
def test_an_upload_is_one_commit_with_the_whole_folder(stub: StubHub, data: Path, tmp_path: Path) -> None:
    stub.files = {"grasps/train-00007.parquet": b"of an earlier publication", "NOTES.md": b"by hand"}
    command = f"datasets publish {NAME} --to hf://lab/kitchen {LICENCE} --data-dir"

    def call(token: str, url: str = stub.url) -> Any:
        env = os.environ | {"HF_ENDPOINT": url, "HF_TOKEN": token, "HF_HUB_DISABLE_XET": "1"}
        env |= {"HF_HOME": str(tmp_path / "home")}
        return completed([sys.executable, "-m", "graspd", *command.split(), str(data)], cwd=tmp_path, env=env)

    for answer in (call("hf_wrong"), call("hf_secret", "http://127.0.0.1:9")):
        assert answer.returncode == 1 and "lab/kitchen cannot be published: " in answer.stderr
        assert answer.stderr.count("\n") == 1 and not (tmp_path / "kitchen").exists(), "checked before any work"
    done = call("hf_secret")
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].endswith(f"uploaded: {stub.url}/datasets/lab/kitchen/commit/1")
    folder = tmp_path / "kitchen"
    local = {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    assert stub.files == local | {"NOTES.md": b"by hand"}
    assert stub.commits == 1 and stub.repository["type"] == "dataset"
    assert stub.repository.get("visibility") == "private" or stub.repository.get("private") is True
    assert 'load_dataset("lab/kitchen", "grasps"' in local["README.md"].decode()
    uploaded = len(stub.objects)
    assert call("hf_secret").returncode == 0 and len(stub.objects) == uploaded
