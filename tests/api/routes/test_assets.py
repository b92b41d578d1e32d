"""Uploads of hands and objects."""

from __future__ import annotations

import asyncio
import threading
from typing import Any

import httpx
import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from graspd.api.routes import assets
from graspd.api.routes.dependencies import RequestLimiter
from graspd.api.uploads import files_of_upload, name_of_upload
from graspd.service.model.errors import InputError, LimitError, UnavailableError
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.asset_summary import summary
from graspd.service.store.library import load_asset, load_asset_files
from tests.api.factories import zipped
from tests.waiting import PATIENCE_S

STL = b"solid box\nendsolid box\n"


def test_an_upload_is_kept_whole_and_waits_for_its_check(http: TestClient, services: Services) -> None:
    answer = http.post("/v1/objects", files={"file": ("My box (2).stl", STL)})
    assert answer.status_code == 202
    asset = http.get(answer.headers["location"]).json()
    assert (asset["name"], asset["verdict"]) == ("My-box-2", None)
    assert load_asset_files(services.store, AssetKind.OBJECT, asset["digest"])["My box (2).stl"] == STL
    assert [check.name for check in services.index.feed.ready_checks(now=1e12, limit=9)] == ["My-box-2"]
    assert http.post("/v1/jobs", json={"hand": "allegro", "object": "My-box-2"}).status_code == 409


def test_a_self_test_is_asked_for_and_shown_with_its_facts(http: TestClient, services: Services) -> None:
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


def test_the_same_upload_is_one_object_and_a_name_one_content(http: TestClient) -> None:
    def upload(data: bytes, **said: str) -> Any:
        return http.post("/v1/objects", files={"file": ("box.stl", data)}, data=said)

    first, second = upload(STL).json(), upload(STL).json()
    assert first == second
    answer = upload(STL + b" ")
    assert answer.status_code == 409 and "'box'" in answer.json()["detail"]
    assert upload(STL + b" ", name="crate").json()["name"] == "crate"
    refused = upload(STL, self_test="true")
    assert refused.status_code == 422 and "only hands" in refused.json()["detail"]


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
    ],
)
def test_an_upload_that_cannot_be_used_is_said_so(http: TestClient, filename: str, data: bytes) -> None:
    answer = http.post("/v1/objects", files={"file": (filename, data)})
    assert answer.status_code == 422 and answer.json()["detail"]


def test_files_of_a_zip_are_its_folders_or_its_asset_jsons() -> None:
    data = zipped({"hand/hand.urdf": b"<robot/>", "hand/meshes/palm.stl": STL})
    files = files_of_upload(AssetKind.HAND, "hand.zip", data, limit_bytes=1 << 20)
    assert set(files) == {"asset.json", "hand.urdf", "meshes/palm.stl"}
    two = {"a.stl": STL, "b.stl": STL}
    described = zipped({"asset.json": b'{"file": "b.stl"}', **two})
    files = files_of_upload(AssetKind.OBJECT, "two.zip", described, limit_bytes=1 << 20)
    assert files["asset.json"] == b'{"file": "b.stl"}'
    with pytest.raises(InputError, match=r"asset\.json"):
        files_of_upload(AssetKind.OBJECT, "two.zip", zipped(two), limit_bytes=1 << 20)
    with pytest.raises(LimitError):
        files_of_upload(AssetKind.OBJECT, "bomb.zip", zipped({"box.stl": bytes(1 << 20)}), limit_bytes=1024)


@pytest.mark.parametrize(
    ("filename", "name"),
    [("My mug (2).stl", "My-mug-2"), ("C:\\meshes\\cup.obj", "cup"), ("../../etc/passwd", "passwd"), ("…", "unnamed")],
)
def test_a_file_name_becomes_a_plain_name(filename: str, name: str) -> None:
    assert name_of_upload(filename) == name


def test_sixty_long_uploads_keep_no_other_request_waiting(app: FastAPI, monkeypatch: pytest.MonkeyPatch) -> None:
    hold = threading.Event()
    inside = threading.Semaphore(0)

    def takes_long(*_: object, **__: object) -> dict[str, bytes]:
        inside.release()
        hold.wait(PATIENCE_S)
        raise UnavailableError("it took too long")

    monkeypatch.setattr(assets, "files_of_upload", takes_long)

    async def use() -> tuple[list[int], list[httpx.Response]]:
        transport = httpx.ASGITransport(app=app)
        async with httpx.AsyncClient(transport=transport, base_url="http://127.0.0.1:8000", timeout=60) as client:
            files = {"file": ("bomb.zip", b"PK")}
            uploads = [asyncio.create_task(client.post("/v1/objects", files=files)) for _ in range(60)]
            await asyncio.to_thread(inside.acquire)
            try:
                async with asyncio.timeout(PATIENCE_S):
                    # What is over the bound is refused at once; only then is everybody else where they wait.
                    while sum(task.done() for task in uploads) < 24:
                        await asyncio.sleep(0.01)
                    others = [(await client.get(path)).status_code for path in ("/healthz", "/v1/objects")]
            finally:
                hold.set()
            return others, list(await asyncio.gather(*uploads))

    others, answers = asyncio.run(use())
    assert others == [200, 200]
    assert {(answer.status_code, "retry-after" in answer.headers) for answer in answers} == {(503, True)}


def test_a_turn_that_does_not_come_in_time_is_refused() -> None:
    async def use() -> None:
        turns = RequestLimiter(1, patience_s=0.05)
        hold = threading.Event()
        first = asyncio.create_task(turns.run(hold.wait, PATIENCE_S))
        await asyncio.sleep(0)
        try:
            with pytest.raises(UnavailableError):
                await turns.run(int)
        finally:
            hold.set()
        await first
        assert await turns.run(int, "7") == 7

    asyncio.run(use())
