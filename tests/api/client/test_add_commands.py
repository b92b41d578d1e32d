"""Hands and folders of meshes on the command line: what is sent, and that one bad mesh stops nothing."""

import json
from pathlib import Path

import pytest
from starlette.testclient import TestClient
from typer.testing import CliRunner

from graspd.client import reports
from graspd.client.add_commands import add_object, upload_of
from graspd.client.client import Client
from graspd.service.index.views import AssetView
from graspd.service.model.errors import InputError
from graspd.service.model.states import AssetKind
from graspd.service.store.asset_options import parse_sizes
from graspd.service.store.assets import pack, unpack
from graspd.service.store.object_sets import find_set_objects

STL = b"solid box\nendsolid box\n"
MESH = '<mesh filename="{}"/>'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A set as YCB is laid out, with one object whose description is broken."""
    root = tmp_path / "ycb"
    for name in ("003_cracker_box", "025_mug", "broken"):
        (root / name / "google_16k").mkdir(parents=True)
        (root / name / "google_16k" / "nontextured.stl").write_bytes(STL + name.encode())
    (root / "broken" / "google_16k" / "asset.json").write_text("{}")
    return root


def add(monkeypatch: pytest.MonkeyPatch, http: TestClient, *arguments: str) -> tuple[int, dict[str, list[object]]]:
    client = Client("http://127.0.0.1:8000")
    client._http = http
    monkeypatch.setattr(client, "close", lambda: None)
    monkeypatch.setattr(reports, "open_client", lambda url: client)
    app = reports.ClientGroup()
    app.command()(add_object)
    waiting = [] if "--split" in arguments else ["--no-wait"]
    result = CliRunner().invoke(app, [*arguments, *waiting, "--json"])
    return result.exit_code, json.loads(result.stdout.splitlines()[-1])


def test_a_bad_object_stops_no_folder(monkeypatch: pytest.MonkeyPatch, http: TestClient, folder: Path) -> None:
    code, told = add(monkeypatch, http, str(folder), "--units", "mm")
    assert (code, told["refused"]) == (2, ["broken"])
    known = {asset["name"] for asset in http.get(f"/v1/{AssetKind.OBJECT.value}s").json()["items"]}
    assert {"003_cracker_box", "025_mug"} <= known and "broken" not in known
    before = http.get("/v1/objects").json()
    add(monkeypatch, http, str(folder), "--units", "mm")
    assert http.get("/v1/objects").json() == before, "adding it again changes nothing"
    assert add(monkeypatch, http, str(folder), "--name", "ycb")[1]["refused"] == ["ycb-broken"]


def test_a_sweep_makes_a_set_of_all_sizes(monkeypatch: pytest.MonkeyPatch, http: TestClient, folder: Path) -> None:
    mesh = folder / "025_mug" / "google_16k" / "nontextured.stl"
    code, told = add(monkeypatch, http, str(mesh), "--name", "mug", "--scale-to", "0.06,0.08,0.125")
    assert (code, told["set"]) == (0, "mug")
    assert http.get("/v1/object-sets/mug").json()["objects"] == ["mug-125mm", "mug-60mm", "mug-80mm"]
    (folder / "toys").mkdir()
    for name in ("ball", "rod"):
        (folder / "toys" / f"{name}.stl").write_bytes(STL + name.encode())
    code, told = add(monkeypatch, http, str(folder / "toys"), "--scale-to", "0.06,0.08")
    assert (code, told["set"]) == (0, "toys")
    assert http.get("/v1/object-sets/toys").json()["objects"] == ["ball-60mm", "ball-80mm", "rod-60mm", "rod-80mm"]


def test_a_split_makes_a_set_of_each_side(monkeypatch: pytest.MonkeyPatch, http: TestClient, folder: Path) -> None:
    def checked(client: Client, kind: AssetKind, digest: str, timeout_s: float) -> AssetView:
        """As a worker checks it: the box is a train object, the mug a report object."""
        asset = client.asset(kind, digest)
        side = "report" if "mug" in asset.name else "train"
        return asset.model_copy(update={"verdict": "accept", "facts": {"shape": {"split": side}}})

    monkeypatch.setattr(Client, "wait_for_check", checked)
    add(monkeypatch, http, str(folder), "--split")
    sets = {name: http.get(f"/v1/object-sets/{name}").json()["objects"] for name in ("ycb", "ycb-train", "ycb-report")}
    assert sets == {"ycb": ["003_cracker_box", "025_mug"], "ycb-train": ["003_cracker_box"], "ycb-report": ["025_mug"]}
    app = reports.ClientGroup()
    app.command()(add_object)
    refused = CliRunner().invoke(app, [str(folder), "--split", "--no-wait"])
    assert refused.exit_code == 2 and "--split needs the checks" in refused.output


@pytest.mark.parametrize("text", ["0", "-0.1", "small", "0.1,", "inf", "nan"])
def test_a_size_that_is_none_is_a_mistake(text: str) -> None:
    with pytest.raises(InputError, match="must be a size in metres"):
        parse_sizes(text)


def test_a_zip_of_several_meshes_is_a_set(tmp_path: Path) -> None:
    (tmp_path / "many.zip").write_bytes(pack({"egad/A0.obj": b"v", "egad/B1.obj": b"v"}))
    (tmp_path / "one.zip").write_bytes(pack({"A0.obj": b"v"}))
    described = {"asset.json": b'{"file": "a.obj"}', "a.obj": b"v", "b.obj": b"v"}
    (tmp_path / "described.zip").write_bytes(pack(described))
    assert set(find_set_objects(tmp_path / "many.zip") or {}) == {"A0", "B1"}
    assert find_set_objects(tmp_path / "one.zip") is None
    assert find_set_objects(tmp_path / "described.zip") is None


@pytest.fixture
def hand_folder(tmp_path: Path) -> Path:
    """A folder with a URDF, its meshes, other things, and a secret beside it."""
    folder = tmp_path / "claw"
    (folder / "meshes").mkdir(parents=True)
    for name in ("a.stl", "b.stl", "c.stl"):
        (folder / "meshes" / name).write_bytes(name.encode())
    (folder / "README.md").write_text("notes")
    (tmp_path / "secret.stl").write_text("secret")
    (folder / "link.stl").symlink_to(tmp_path / "secret.stl")
    named = ("meshes/a.stl", "package://claw/meshes/b.stl", "../secret.stl", "link.stl", "meshes/missing.stl")
    (folder / "claw.urdf").write_text(f"<robot>{''.join(MESH.format(name) for name in named)}</robot>")
    return folder


def sent(path: Path) -> set[str]:
    with upload_of(path) as (upload, _):
        return set(unpack(upload.read_bytes(), limit_bytes=10_000))


def test_a_urdf_brings_the_meshes_that_it_names_and_a_folder_all(hand_folder: Path) -> None:
    assert sent(hand_folder / "claw.urdf") == {"claw.urdf", "meshes/a.stl", "meshes/b.stl"}
    (hand_folder / "asset.json").write_text("{}")
    assert sent(hand_folder) == {"asset.json", "claw.urdf", "meshes/a.stl", "meshes/b.stl", "meshes/c.stl"}
    with upload_of(hand_folder) as (upload, _):
        assert upload.name == "claw.zip"
    assert not upload.exists()


def test_other_files_are_sent_as_they_are(tmp_path: Path) -> None:
    (tmp_path / "plain.urdf").write_text("<robot/>")
    for path in (tmp_path / "plain.urdf", tmp_path / "hand.zip", tmp_path / "missing.urdf"):
        with upload_of(path) as (upload, _):
            assert upload == path
    (tmp_path / "none").mkdir()
    with pytest.raises(InputError, match="holds no URDF"), upload_of(tmp_path / "none"):
        pass
