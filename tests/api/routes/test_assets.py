"""Uploads of hands, objects and networks, what a user says about them, and corrections of a hand."""

import asyncio
import io
import json
import os
import threading
import tracemalloc
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import httpx
import numpy as np
import pytest
from fastapi import FastAPI
from starlette.testclient import TestClient

from graspd.api.access.keys import Scope
from graspd.api.app import create_app
from graspd.api.routes import assets, dependencies
from graspd.api.routes.dependencies import RequestLimiter
from graspd.api.uploads import files_of_upload, name_of_upload
from graspd.service.model import names
from graspd.service.model.digests import digest_files
from graspd.service.model.errors import InputError, LimitError, UnavailableError
from graspd.service.model.messages import IngestMessage
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store import descriptions, network_file
from graspd.service.store.asset_options import hand_options
from graspd.service.store.asset_summary import summary
from graspd.service.store.assets import builtin_files, pack
from graspd.service.store.library import load_asset, load_asset_files, load_check, publish_asset
from graspd.service.store.network_file import NETWORK_FILE, to_bytes
from graspd.worker.stages import ingest
from graspd.worker.stages.context import TaskContext
from tests.api.conftest import BASE_URL
from tests.api.factories import people_of, zipped
from tests.damage import overwrite
from tests.networks import random_network
from tests.service.store.test_asset_files import HOSTILE
from tests.waiting import PATIENCE_S

STL = b"solid box\nendsolid box\n"
LONG_FACTS = b'{"file": "box.stl", "facts": {"x": "%s"}}' % (b"x" * 9000)


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
    ("filename", "data", "words"),
    [
        ("empty.stl", b"", "is empty"),
        ("broken.zip", b"PK\x03\x04 not a zip", "not a readable ZIP"),
        ("main.zip", zipped({"asset.json": b'{"file": "main.stl"}', "box.stl": STL}), "not among its files"),
        ("facts.zip", zipped({"asset.json": LONG_FACTS, "box.stl": STL}), "leave some out"),
    ],
)
def test_an_upload_that_cannot_be_used_is_said_so(http: TestClient, filename: str, data: bytes, words: str) -> None:
    answer = http.post("/v1/objects", files={"file": (filename, data)})
    assert answer.status_code == 422 and words in answer.json()["detail"]


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


def test_more_uploads_at_once_than_fit_are_refused(http: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(assets, "_AT_ONCE", threading.Semaphore(0))
    monkeypatch.setattr(assets, "_TURN_S", 0.0)
    answer = http.post("/v1/objects", files={"file": ("box.stl", STL)})
    assert answer.status_code == 429 and "too many uploads at once; try again" in answer.json()["detail"]


@pytest.mark.parametrize(("most", "patience_s"), [(32, 0.05), (0, 2 * PATIENCE_S)], ids=["late", "too many wait"])
def test_a_turn_that_does_not_come_is_refused(monkeypatch: pytest.MonkeyPatch, most: int, patience_s: float) -> None:
    monkeypatch.setattr(dependencies, "_MOST_WAITING", most)

    async def use() -> None:
        turns = RequestLimiter(1, patience_s=patience_s)
        hold = threading.Event()
        first = asyncio.create_task(turns.run(hold.wait, PATIENCE_S))
        await asyncio.sleep(0)
        try:
            with pytest.raises(UnavailableError):
                async with asyncio.timeout(PATIENCE_S):
                    await turns.run(int)
        finally:
            hold.set()
        await first
        assert await turns.run(int, "7") == 7

    asyncio.run(use())


JOB = {"hand": "barrett", "object": "mug", "scene": "table", "method": "learned", "options": {"network": "net"}}


def of_hand(http: TestClient, hand: str = "barrett", seed: int = 0) -> bytes:
    return to_bytes(random_network(hand=hand, digest=http.get(f"/v1/hands/{hand}").json()["digest"], seed=seed))


def upload(http: TestClient, data: bytes, filename: str = "net.npz", **said: str) -> Any:
    return http.post("/v1/networks", files={"file": (filename, data)}, data=said)


def test_an_uploaded_network_can_be_used_at_once(http: TestClient, services: Services) -> None:
    data = of_hand(http)
    answer = upload(http, data)
    assert answer.status_code == 201, answer.text
    shown = http.get(answer.headers["location"]).json()
    assert (shown["name"], shown["verdict"], shown["kind"]) == ("net", "accept", "network")
    barrett = http.get("/v1/hands/barrett").json()["digest"]
    assert (shown["facts"]["hand"], shown["facts"]["hand_digest"]) == ("barrett", barrett)
    assert shown["facts"]["about"] == "drawn by chance" and shown["created"] and shown["size_bytes"] > len(data)
    assert load_asset_files(services.store, AssetKind.NETWORK, shown["digest"])[NETWORK_FILE] == data
    assert [one["name"] for one in http.get("/v1/networks").json()["items"]] == ["net"]
    assert list(services.index.feed.ready_checks(now=1e12, limit=9)) == [], "no worker is asked"


def test_the_same_file_is_the_same_network(http: TestClient) -> None:
    data = of_hand(http)
    first, second = (upload(http, data, filename, name="net").json() for filename in ("a.npz", "b.npz"))
    assert first["digest"] == second["digest"]
    assert upload(http, data, name="other").status_code == 409
    assert upload(http, of_hand(http, seed=1)).status_code == 409, "the name stands for another one"


def test_what_is_no_network_is_refused_in_a_line_and_not_kept(http: TestClient, services: Services) -> None:
    with np.load(io.BytesIO(to_bytes(random_network()))) as stored:
        arrays = {name: stored[name] for name in stored.files}
    for what in ("no zip", "pickled text", "double"):
        answer = upload(http, HOSTILE[what][0](arrays))
        assert answer.status_code == 422 and "\n" not in answer.json()["detail"], (what, answer.text)
    assert http.get("/v1/networks").json()["items"] == []
    assert list(services.store.list(f"{names.ASSETS}/network")) == []


def test_an_upload_that_says_what_no_network_has_is_refused(http: TestClient) -> None:
    data = of_hand(http)
    for filename, said, words in (
        ("net.zip", {}, "net.zip is no network"),
        ("net.npz", {"options": '{"units": "mm"}'}, "a network has no 'units'"),
        ("net.npz", {"options": '{"file": "../up.npz"}'}, "not among its files"),
        ("net.npz", {"self_test": "true"}, "only hands have a self-test"),
        ("net.npz", {"name": "../up"}, "name"),
    ):
        answer = upload(http, data, filename, **said)
        assert answer.status_code == 422 and words in answer.text


def test_a_file_larger_than_any_network_is_not_read(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(network_file, "MAX_BYTES", 10)
    file = io.BytesIO(b"x" * 11)
    with pytest.raises(LimitError, match="a proposal network is smaller"):
        files_of_upload(AssetKind.NETWORK, "net.npz", file, limit_bytes=100)
    assert file.tell() == 0


def test_a_job_that_the_network_does_not_fit_is_refused(http: TestClient) -> None:
    upload(http, of_hand(http))
    for changes, status, words in (
        ({"hand": "allegro"}, 422, "network 'net' proposes grasps of barrett ("),
        ({"scene": "free"}, 422, "objects on a table"),
        ({"scene": {"supports": [{"kind": "half_space", "normal": [0, 0.1, 1]}]}}, 422, "objects on a table"),
        ({"options": {"network": "none"}}, 404, "there is no network 'none'; there are: net"),
        ({"options": {"network": "/etc/passwd"}}, 404, "there is no network"),
    ):
        job = JOB | changes
        options = {name: value for name, value in job.items() if name not in ("hand", "object")}
        dataset = {"name": "d", "hands": [job["hand"]], "objects": [job["object"]], **options}
        for path, body in (("/v1/jobs", job), ("/v1/datasets", dataset)):
            answer = http.post(path, json=body)
            assert answer.status_code == status and words in json.dumps(answer.json(), ensure_ascii=False), answer.text
    assert http.get("/v1/jobs").json()["items"] == http.get("/v1/datasets").json()["items"] == []


def test_the_page_of_hands_shows_networks_while_there_are_any(http: TestClient) -> None:
    assert "Networks" not in http.get("/hands").text
    digest = upload(http, of_hand(http)).json()["digest"]
    page = http.get("/hands").text
    barrett = http.get("/v1/hands/barrett").json()["digest"]
    assert digest[:12] in page and f"barrett ({barrett[:12]})" in page and "drawn by chance" in page
    assert http.get("/v1/networks/net/model").status_code == 404
    assert http.delete("/v1/networks/net").status_code == 204
    assert http.get("/v1/networks/net").status_code == 404


MIB = 1 << 20


def test_the_options_of_a_hand_decide_its_check(http: TestClient, services: Services) -> None:
    urdf = builtin_files(AssetKind.HAND, "allegro")["allegro.urdf"]
    joints = {"pre_shape": ["index_proximal=0.5,middle_proximal=0.6"], "fix": ["thumb_rotation=1.0"]}
    options = hand_options(palm="palm", approach="0,0,1", drop=["ring_proximal_link"], **joints)
    file, said = {"file": ("mine.urdf", urdf)}, {"options": json.dumps(options)}
    digest = http.post("/v1/hands", files=file, data=said).json()["digest"]
    message = IngestMessage(schema_=1, task_id="i", kind=AssetKind.HAND, name="mine", digest=digest)
    ingest.run(message, TaskContext(services.store))
    facts = (load_check(services.store, AssetKind.HAND, digest) or {})["facts"]
    assert facts["palm_approach"] == [0.0, 0.0, 1.0]
    assert facts["preshape"]["index_proximal"] == 0.5 and facts["preshape"]["middle_proximal"] == 0.6
    assert "thumb_rotation" not in facts["dofs"]
    assert not [name for name in facts["dofs"] if name.startswith("ring_m")]
    assert "palm" not in facts["guessed"] and "closing" in facts["guessed"]


def folder_of(count: int, size: int) -> bytes:
    """ZIP of a folder with a mesh and textures that do not compress."""
    textures = {f"thing/texture-{number}.png": os.urandom(size) for number in range(count)}
    return zipped({"thing/mesh.stl": b"solid x\nendsolid x\n", **textures})


def test_a_zip_is_kept_without_ever_being_whole_in_memory(services: Services, tmp_path: Path) -> None:
    with (tmp_path / "upload.zip").open("w+b") as file:
        file.write(folder_of(3, 4 * MIB))
        tracemalloc.start()
        files = files_of_upload(AssetKind.OBJECT, "thing.zip", file, limit_bytes=32 * MIB)
        asset = publish_asset(services.store, AssetKind.OBJECT, "thing", files)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    # Two pieces of 1 MiB on their way into the store, of 12 MiB.
    assert peak < 3 * MIB
    assert len(load_asset_files(services.store, AssetKind.OBJECT, asset.digest)) == 5


def test_a_zip_on_disk_and_in_memory_are_the_same_asset() -> None:
    data = folder_of(2, 100_000)
    streamed = files_of_upload(AssetKind.OBJECT, "thing.zip", data, limit_bytes=MIB)
    held = dict(streamed)
    assert digest_files(AssetKind.OBJECT, streamed) == digest_files(AssetKind.OBJECT, held)
    assert pack(streamed) == pack(held)


def test_a_zip_whose_header_understates_its_files_is_refused() -> None:
    data = zipped({"mesh.stl": b"0" * 5000})
    true, false = (5000).to_bytes(4, "little"), (10).to_bytes(4, "little")
    assert data.count(true) == 2
    with pytest.raises(InputError, match="damaged"):
        files_of_upload(AssetKind.OBJECT, "thing.zip", data.replace(true, false), limit_bytes=1000)


FILES = builtin_files(AssetKind.HAND, "barrett")
SAID = {"closing": {"finger_1_spread": 1}, "preshape": {"finger_2_medial": -0.3}}
WRONG = {"approach_x=far": "no number", "closing.0=7": "-1, 0 or 1", "palm_link=<b>": "&lt;b&gt;", "name=a b": "name"}


def corrected(http: TestClient, body: dict[str, Any], hand: str = "barrett") -> Any:
    return http.post(f"/v1/hands/{hand}/corrections", json=body)


def test_a_corrected_hand_is_another_one_of_the_same_files(http: TestClient, services: Services) -> None:
    answer = corrected(http, {"closing": {"finger_1_spread": 1}, "preshape": {"finger_2_medial": -0.3}})
    assert answer.status_code == 202, answer.text
    made = http.get(answer.headers["location"]).json()
    assert (made["name"], made["verdict"]) == ("barrett-2", None)
    kept = load_asset_files(services.store, AssetKind.HAND, made["digest"])
    said = json.loads(kept.pop("asset.json"))
    assert kept == {name: data for name, data in FILES.items() if name != "asset.json"}
    assert said["closing"]["finger_1_spread"] == 1 and said["closing"]["finger_2_medial"] == -1
    # The joint that closes another way has its pre-shape guessed anew.
    assert "finger_1_spread" not in said["preshape"] and said["preshape"]["finger_2_medial"] == -0.3
    assert said["root"] == said["palm"]["link"] == "palm" and len(said["fingertips"]) == 3
    assert [check.name for check in services.index.feed.ready_checks(now=1e12, limit=9)] == ["barrett-2"]


def test_the_same_corrections_are_the_same_hand(http: TestClient) -> None:
    first = corrected(http, {"closing": {"finger_1_spread": 1}}).json()
    assert corrected(http, {"closing": {"finger_1_spread": 1}}).json()["digest"] == first["digest"]
    assert corrected(http, {"closing": {"finger_1_spread": -1}}).json()["name"] == "barrett-3"
    assert corrected(http, {"name": "mine", "closing": {"finger_2_medial": 1}}).json()["name"] == "mine"
    answer = corrected(http, {"name": "mine", "closing": {"finger_1_medial": -1}})
    assert answer.status_code == 409 and "'mine'" in answer.json()["detail"]


def test_what_a_hand_does_not_have_is_refused_and_leaves_nothing(http: TestClient) -> None:
    before = http.get("/v1/hands").json()
    refused: tuple[tuple[dict[str, Any], str], ...] = (
        ({"closing": {"elbow": 1}}, "no joint 'elbow'"),
        ({"preshape": {"finger_1_medial": 3}}, "outside its limits"),
        ({"fingertips": ["elbow"]}, "'elbow' is no link that a joint moves"),
        ({"fingertips": []}, "fingertips"),
        ({"palm": {"link": "elbow"}}, "no link 'elbow'"),
        ({"palm": {"link": "palm", "approach": [0, 0, 0]}}, "no direction"),
        ({"closing": {"finger_1_medial": 2}}, "closing"),
        ({"closing": {str(n): 1 for n in range(descriptions.MAX_ENTRIES + 1)}}, "closing"),
        ({"closing": {"x" * 300: 1}}, "closing"),
        ({"name": "../up", "closing": {}}, "name"),
        ({"root": "palm"}, "root"),
    )
    for body, says in refused:
        answer = corrected(http, body)
        assert answer.status_code == 422 and says in answer.text, answer.text
    for number in ("NaN", "Infinity", "1e999"):
        text = f'{{"preshape": {{"finger_1_medial": {number}}}}}'
        answer = http.post("/v1/hands/barrett/corrections", content=text, headers={"content-type": "application/json"})
        assert answer.status_code == 422
    assert http.get("/v1/hands").json() == before


def test_an_unknown_hand_or_one_without_a_model_is_not_found(http: TestClient) -> None:
    assert corrected(http, SAID, hand="nobody").status_code == 404
    http.post("/v1/hands", files={"file": ("new.urdf", b"<robot/>")})
    assert corrected(http, SAID, hand="new").status_code == 404


def test_a_model_of_an_older_version_says_the_mend(http: TestClient, services: Services) -> None:
    made = http.post("/v1/hands", files={"file": ("old.urdf", b"<robot/>")}).json()
    mug = http.get("/v1/objects/mug").json()["digest"]
    for model in (
        b"glTF",
        b"glTF" + bytes(40),
        services.store.get(names.asset_key(AssetKind.OBJECT, mug, "model.glb")),
    ):
        key = names.asset_key(AssetKind.HAND, made["digest"], "model.glb")
        services.store.delete(key)
        services.store.put(key, model)
        answer = corrected(http, SAID, hand="old")
        assert answer.status_code == 409 and "graspd hands check --write" in answer.json()["detail"]
        assert "older version" in http.get("/hands/old").text


def test_damaged_files_or_a_long_description_are_refused(http: TestClient, services: Services, monkeypatch) -> None:
    monkeypatch.setattr("graspd.api.catalog.assets.descriptions", Mock(wraps=descriptions, MAX_BYTES=100))
    answer = corrected(http, SAID)
    assert answer.status_code == 413 and "give fewer corrections" in answer.json()["detail"]
    key = names.asset_key(AssetKind.HAND, http.get("/v1/hands/barrett").json()["digest"], "files.zip")
    overwrite(services.store, key, zipped({"other.urdf": b"<robot/>"}))
    answer = corrected(http, SAID)
    assert answer.status_code == 500 and "upload it again" in answer.json()["detail"]


def test_a_reader_corrects_nothing_and_a_writer_owns_the_hand(settings: Settings, services: Services) -> None:
    people = people_of(settings, reader=(Scope.READ, ""), writer=(Scope.SUBMIT, ""))
    with TestClient(create_app(settings, services), base_url=BASE_URL) as http:
        body, path = {"closing": {"finger_1_spread": 1}}, "/v1/hands/barrett/corrections"
        assert http.post(path, json=body).status_code == 401
        assert http.post(path, json=body, headers=people["reader"]).status_code == 403
        assert http.post("/hands/barrett", data={"closing.0": "1"}, headers=people["reader"]).status_code == 403
        assert "Save as a new hand" not in http.get("/hands/barrett", headers=people["reader"]).text
        made = http.post(path, json=body, headers=people["writer"]).json()
        assert load_asset(services.store, AssetKind.HAND, made["digest"]).owner == made["owner"] != ""


def test_the_page_has_a_field_for_each_guess_without_scripts(http: TestClient) -> None:
    page = http.get("/hands/barrett").text
    assert page.count('type="radio" name="closing.') == 3 * page.count('name="preshape.')
    assert 'name="palm_link"' in page and 'name="fingertip"' in page and "asset.json" in page
    form = {"palm_link": "palm", "approach_x": "1", "closing.0": "1", "fingertip": "finger_1_distal_link"}
    answer = http.post("/hands/barrett", data=form, follow_redirects=False)
    assert answer.status_code == 303
    made = http.get("/v1/hands/barrett-2").json()
    assert answer.headers["location"] == f"/hands/{made['digest']}"
    shown = http.get(answer.headers["location"]).text
    assert "A worker checks the hand" in shown and 'data-poll="2"' in shown


@pytest.mark.parametrize(("typed", "says"), WRONG.items())
def test_a_wrong_form_is_shown_again_with_what_is_wrong(http: TestClient, typed: str, says: str) -> None:
    form = {"palm_link": "palm", "fingertip": "finger_1_distal_link"} | dict([typed.split("=")])
    answer = http.post("/hands/barrett", data=form)
    assert answer.status_code == 422 and says in answer.text and "cannot be saved" in answer.text


def test_hands_are_listed_with_their_own_words_as_text(http: TestClient) -> None:
    options = {"facts": {"dofs": 7, "fingertips": "<b>", "guessed": 3}}
    http.post("/v1/hands", files={"file": ("odd.urdf", b"<robot/>")}, data={"options": json.dumps(options)})
    page = http.get("/hands")
    assert page.status_code == 200
    assert "odd" in page.text and "being checked" in page.text and "<b>" not in page.text
    assert http.get("/hands/odd").status_code == 200
