"""Uploads of hands and objects."""

from __future__ import annotations

import io
import zipfile

import pytest
from starlette.testclient import TestClient

from graspd.api.uploads import files_of_upload, name_of_upload
from graspd.service.model.errors import InputError, LimitError
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.asset_summary import summary
from graspd.service.store.library import load_asset, load_asset_files

STL = b"solid box\nendsolid box\n"


def zipped(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def test_the_built_in_hands_and_objects_are_listed(http: TestClient) -> None:
    assert "allegro" in {asset["name"] for asset in http.get("/v1/hands").json()["items"]}
    assert "mug" in {asset["name"] for asset in http.get("/v1/objects").json()["items"]}


def test_an_upload_is_kept_whole_and_waits_for_its_check(http: TestClient, services: Services) -> None:
    answer = http.post("/v1/objects", files={"file": ("My box (2).stl", STL)})
    assert answer.status_code == 202
    asset = http.get(answer.headers["location"]).json()
    assert (asset["name"], asset["verdict"]) == ("My-box-2", None)
    assert load_asset_files(services.store, AssetKind.OBJECT, asset["digest"])["My box (2).stl"] == STL
    assert [check.name for check in services.index.feed.ready_checks(now=1e12, limit=9)] == ["My-box-2"]


def test_a_self_test_is_asked_for_with_the_hand_and_shown_with_its_facts(http: TestClient, services: Services) -> None:
    asked = {"name": "mine", "self_test": "true"}
    answer = http.post("/v1/hands", files={"file": ("mine.urdf", b"<robot name='mine'/>")}, data=asked)
    assert answer.status_code == 202
    record = load_asset(services.store, AssetKind.HAND, answer.json()["digest"])
    assert record.self_test
    candidates = {"gsr": 0.9, "n": 64, "width_m": 0.04, "by_object": {"box": 0.9}, "says": "ready: 90 % hold"}
    found = {"verdict": "accept", "message": "", "repairs": [], "facts": {"self_test": candidates}}
    services.index.write.add_asset(record, found)
    shown = http.get("/v1/hands/mine").json()
    assert shown["facts"]["self_test"] == candidates
    assert "self-test          ready: 90 % hold" in summary(AssetKind.HAND, shown["facts"])
    assert "ready: 90 % hold" in http.get("/hands").text


def test_only_hands_are_tried(http: TestClient) -> None:
    answer = http.post("/v1/objects", files={"file": ("box.stl", STL)}, data={"self_test": "true"})
    assert answer.status_code == 422
    assert "only a hand" in answer.json()["detail"]


def test_the_same_upload_twice_is_one_object(http: TestClient) -> None:
    first, second = (http.post("/v1/objects", files={"file": ("box.stl", STL)}).json() for _ in range(2))
    assert first == second


def test_a_name_stands_for_one_content(http: TestClient) -> None:
    http.post("/v1/objects", files={"file": ("box.stl", STL)})
    answer = http.post("/v1/objects", files={"file": ("box.stl", STL + b" ")})
    assert answer.status_code == 409
    assert "'box'" in answer.json()["detail"]


def test_a_name_may_be_given(http: TestClient) -> None:
    answer = http.post("/v1/objects", files={"file": ("box.stl", STL)}, data={"name": "crate"})
    assert answer.json()["name"] == "crate"


def test_an_object_that_waits_for_its_check_takes_no_job(http: TestClient) -> None:
    http.post("/v1/objects", files={"file": ("box.stl", STL)})
    answer = http.post("/v1/jobs", json={"hand": "allegro", "object": "box"})
    assert answer.status_code == 409


def test_an_upload_over_the_limit_is_refused_and_leaves_nothing(http: TestClient, settings: Settings) -> None:
    before = http.get("/v1/objects").json()
    answer = http.post("/v1/objects", files={"file": ("box.stl", bytes(settings.max_upload_bytes + 1))})
    assert answer.status_code == 413
    assert http.get("/v1/objects").json() == before


@pytest.mark.parametrize(
    ("filename", "data"),
    [
        ("empty.stl", b""),
        ("notes.txt", b"hello"),
        ("broken.zip", b"PK\x03\x04 not a zip"),
        ("slip.zip", zipped({"../../box.stl": STL})),
        ("two.zip", zipped({"a.stl": STL, "b.stl": STL})),
    ],
)
def test_an_upload_that_cannot_be_used_is_said_so(http: TestClient, filename: str, data: bytes) -> None:
    answer = http.post("/v1/objects", files={"file": (filename, data)})
    assert answer.status_code == 422
    assert answer.json()["detail"]


def test_a_zip_bomb_is_refused_by_what_it_unpacks_to() -> None:
    bomb = zipped({"box.stl": bytes(1 << 20)})
    with pytest.raises(LimitError):
        files_of_upload(AssetKind.OBJECT, "bomb.zip", bomb, limit_bytes=1024)


def test_a_folder_zipped_whole_loses_its_own_name() -> None:
    data = zipped({"hand/hand.urdf": b"<robot/>", "hand/meshes/palm.stl": STL})
    files = files_of_upload(AssetKind.HAND, "hand.zip", data, limit_bytes=1 << 20)
    assert set(files) == {"asset.json", "hand.urdf", "meshes/palm.stl"}


def test_an_asset_json_in_the_zip_stands() -> None:
    data = zipped({"asset.json": b'{"file": "b.stl"}', "a.stl": STL, "b.stl": STL})
    assert files_of_upload(AssetKind.OBJECT, "two.zip", data, limit_bytes=1 << 20)["asset.json"] == b'{"file": "b.stl"}'


def test_a_zip_with_two_meshes_says_the_mend() -> None:
    with pytest.raises(InputError, match=r"asset\.json"):
        files_of_upload(AssetKind.OBJECT, "two.zip", zipped({"a.stl": STL, "b.stl": STL}), limit_bytes=1 << 20)


@pytest.mark.parametrize(
    ("filename", "name"),
    [("My mug (2).stl", "My-mug-2"), ("C:\\meshes\\cup.obj", "cup"), ("../../etc/passwd", "passwd"), ("…", "unnamed")],
)
def test_a_file_name_becomes_a_plain_name(filename: str, name: str) -> None:
    assert name_of_upload(filename) == name
