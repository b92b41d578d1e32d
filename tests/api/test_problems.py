"""Every error is a problem document that names what is wrong."""

from operator import attrgetter
from typing import Any
from unittest.mock import Mock

import pytest
from fastapi import FastAPI
from starlette.responses import StreamingResponse
from starlette.testclient import TestClient

from graspd.service.model.errors import IndexUnavailable, QueueUnavailable, StoreUnavailable
from graspd.service.pipeline.backends import Services
from tests.api.conftest import BASE_URL

JOB = {"hand": "allegro", "object": "mug", "grasps": 32}
PLANE = {"kind": "half_space"}
FLAT = {"supports": [PLANE, {"kind": "box", "size": [0, 1, 1]}]}
PLACED = {"supports": [PLANE], "target": [0, 0, 0, 1, 0, 0, 0], "neighbours": [{"object": "a"}]}


def problem(answer: Any, status: int, slug: str) -> dict[str, Any]:
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    document = answer.json()
    assert document["type"] == f"/problems/{slug}" and document["status"] == status
    assert document["request_id"] == answer.headers["x-request-id"] and "\n" not in document["detail"]
    return document


def test_a_field_in_error_is_pointed_at(http: TestClient) -> None:
    for change, pointer, words in (
        ({"grasps": 0}, "#/grasps", "must be at least 1"),
        ({"fidelity": "perfect"}, "#/fidelity", "draft, standard, fine"),
        ({"seed": "x"}, "#/seed", "whole number"),
        ({"colour": "red"}, "#/colour", "is not known"),
        ({"views": 3}, "#", "scenes >= 1"),
        ({"hand": "../etc"}, "#/hand", "at most 64 letters, digits, dots, dashes and underscores"),
        ({"scene": "tabel"}, "#/scene", "did you mean table?"),  # codespell:ignore tabel
        ({"scene": FLAT}, "#/scene", "must be more than 0.0001"),
        ({"scene": "bin", "method": "graspit"}, "#", "plans around free objects only"),
        ({"scene": "bin", "neighbours": ["../block"]}, "#/neighbours", "must begin with a letter"),
        ({"scene": PLACED}, "#", "give all"),
    ):
        first = problem(http.post("/v1/jobs", json=JOB | change), 422, "invalid-input")["errors"][0]
        assert first["pointer"].startswith(pointer) and words in first["detail"], change
    assert http.get("/v1/jobs").json()["items"] == []
    for limit in (0, 201):
        problem(http.get("/v1/jobs", params={"limit": limit}), 422, "invalid-input")


def test_a_body_that_is_no_json_is_said_so(http: TestClient) -> None:
    answer = http.post("/v1/jobs", content=b"{hand: allegro", headers={"Content-Type": "application/json"})
    assert "not JSON" in problem(answer, 400, "bad-request")["detail"]


def test_what_is_unknown_is_named(http: TestClient) -> None:
    for kind, name in (("hand", "claw"), ("object", "teapot")):
        assert name in problem(http.post("/v1/jobs", json=JOB | {kind: name}), 404, "not-found")["detail"]
    for path in ("/v1/jobs/none", "/v1/shards/none", "/v1/shards/none/file", "/v1/hands/none"):
        assert "none" in problem(http.get(path), 404, "not-found")["detail"]
    answer = http.get("/v1/nowhere")
    problem(answer, 404, "not-found")
    assert "default-src 'none'" in answer.headers["content-security-policy"]
    assert "unsafe" not in answer.headers["content-security-policy"]
    assert answer.headers["x-content-type-options"] == "nosniff"


def test_a_body_over_the_limit_is_refused_by_length_or_arrival(http: TestClient) -> None:
    for content in (b" " * (2 << 20), (b" " * 65536 for _ in range(32))):
        problem(http.post("/v1/jobs", content=content), 413, "too-large")


@pytest.mark.parametrize(
    ("part", "method", "error", "slug"),
    [
        ("queue", "ping", QueueUnavailable("Redis does not answer"), "queue-unavailable"),
        ("store", "put", StoreUnavailable("the store cannot be written"), "store-unavailable"),
        ("index.write", "enter_job", IndexUnavailable("the index does not answer"), "index-unavailable"),
    ],
)
def test_a_part_that_is_away_is_503_and_worth_another_try(
    http: TestClient, services: Services, monkeypatch: pytest.MonkeyPatch, part: str, method: str, error: Any, slug: str
) -> None:
    monkeypatch.setattr(type(attrgetter(part)(services)), method, Mock(side_effect=error))
    answer = http.post("/v1/jobs", json=JOB)
    assert problem(answer, 503, slug)["detail"] == str(error)
    assert int(answer.headers["retry-after"]) > 0


def test_an_answer_that_breaks_off_gets_no_second_one(app: FastAPI) -> None:
    app.add_api_route("/v1/half", lambda: StreamingResponse(bytes(1 // left) for left in (1, 0)))
    with TestClient(app, base_url=BASE_URL) as http, pytest.raises(ZeroDivisionError):
        http.get("/v1/half")


def test_an_unforeseen_error_tells_no_detail(app: FastAPI, http: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(app.state.overview, "stats", Mock(side_effect=RuntimeError("secret: /home/someone")))
    assert "secret" not in str(problem(http.get("/v1/stats"), 500, "internal"))
    page = http.get("/", headers={"Accept": "text/html"})
    assert (page.status_code, page.headers["content-type"]) == (500, "text/html; charset=utf-8")
    assert "secret" not in page.text and page.headers["x-request-id"] in page.text
