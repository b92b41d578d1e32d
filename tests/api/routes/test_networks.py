"""Networks over HTTP: checked as they come, listed, named by jobs, taken away."""

from __future__ import annotations

import io
import json
from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from graspd.api.uploads import files_of_upload
from graspd.service.model import names
from graspd.service.model.errors import LimitError
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.store import network_file
from graspd.service.store.library import load_asset_files
from graspd.service.store.network_file import NETWORK_FILE, to_bytes
from tests.networks import random_network
from tests.service.store.test_network_file import HOSTILE

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
        ({"hand": "allegro"}, 422, "proposes grasps of barrett"),
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


def test_the_page_of_hands_shows_networks_while_there_are_any(http: TestClient) -> None:
    assert "Networks" not in http.get("/hands").text
    digest = upload(http, of_hand(http)).json()["digest"]
    page = http.get("/hands").text
    barrett = http.get("/v1/hands/barrett").json()["digest"]
    assert digest[:12] in page and f"barrett ({barrett[:12]})" in page and "drawn by chance" in page
    assert http.get("/v1/networks/net/model").status_code == 404
    assert http.delete("/v1/networks/net").status_code == 204
    assert http.get("/v1/networks/net").status_code == 404
