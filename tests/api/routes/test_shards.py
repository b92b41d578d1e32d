"""Shards and grasps that are read; conditional requests and HEAD (RFC 9110), methods of an address, encoded bodies."""

import io
from collections.abc import Callable
from itertools import product

import h5py
import pytest
from fastapi import FastAPI
from httpx import Response
from starlette.testclient import TestClient

from graspd.api.dashboard.job_pages import ShardPictures
from graspd.api.routes.jobs import parse_range
from graspd.service.pipeline.backends import Services
from graspd.service.store.store import Store
from tests.api.factories import add_job, finish_all
from tests.damage import cut, flip, remove

MODEL = "/v1/hands/allegro/model"


@pytest.fixture
def shard(services: Services) -> str:
    return finish_all(services, add_job(services))[0].shard_id


@pytest.fixture
def file(shard: str) -> str:
    return f"/v1/shards/{shard}/file"


def test_what_a_client_has_is_not_sent_again(http: TestClient, file: str) -> None:
    for address in (file, MODEL):
        etag = http.get(address).headers["etag"]
        for form, method in product(("{}", "W/{}", '"other", {}', "*", '"other"'), ("GET", "HEAD")):
            answer = http.request(method, address, headers={"If-None-Match": form.format(etag), "Range": "bytes=0-9"})
            if form == '"other"':
                assert answer.is_success
                continue
            assert (answer.status_code, answer.content, answer.headers["etag"]) == (304, b"", etag)
            assert "cache-control" in answer.headers


def test_half_a_file_is_completed_only_where_it_is_the_same(http: TestClient, file: str) -> None:
    whole = http.get(file)
    for validator in ("{}", '"other"', "W/{}", "Sat, 21 Nov 2026 00:00:00 GMT"):
        answer = http.get(file, headers={"Range": "bytes=100-", "If-Range": validator.format(whole.headers["etag"])})
        wanted = (206, whole.content[100:]) if validator == "{}" else (200, whole.content)
        assert (answer.status_code, answer.content) == wanted


def test_head_says_what_get_would_sends_nothing_and_is_counted(http: TestClient, file: str, app: FastAPI) -> None:
    same = ("content-length", "content-type", "etag", "cache-control", "accept-ranges")
    for address in (file, MODEL):
        whole, head = http.get(address), http.head(address, headers={"Range": "bytes=0-9"})
        assert (head.status_code, head.content) == (200, b"")
        assert {name: head.headers.get(name) for name in same} == {name: whole.headers.get(name) for name in same}
    http.head("/healthz")
    assert 'method="HEAD",route="/healthz"' in app.state.metrics.render(app.state.overview.metrics_snapshot()).decode()


def _kind(answer: Response) -> tuple[int, str | None]:
    return answer.status_code, answer.headers.get("content-type")


def test_head_is_answered_wherever_get_is(app: FastAPI, http: TestClient) -> None:
    paths = {getattr(route, "path", "{") for route in app.routes if "GET" in (getattr(route, "methods", None) or ())}
    endless = {path for path in paths if path.endswith(("/events", "/stream"))} - {"/v1/events"}
    asked = sorted(path for path in paths - endless if "{" not in path)
    assert {"/", "/healthz", "/readyz", "/metrics", "/v1/jobs", "/openapi.json"} <= set(asked)
    answers = {path: (http.get(path), http.head(path)) for path in asked}
    differing = [path for path, (get, head) in answers.items() if head.content or _kind(head) != _kind(get)]
    assert not differing


def test_an_encoded_body_is_refused_by_its_encoding(http: TestClient) -> None:
    places = (("POST", "/v1/jobs"), ("POST", "/submit"), ("DELETE", "/v1/jobs/x"))
    for encoding, (method, path) in product(("gzip", "zstd", "gzip, br"), places):
        answer = http.request(method, path, content=b"x", headers={"Content-Encoding": encoding})
        assert (answer.status_code, answer.headers["accept-encoding"]) == (415, "identity")
        assert encoding in answer.text
    assert http.post("/v1/jobs", json={}, headers={"Content-Encoding": "identity"}).status_code == 422


def test_a_day_is_a_full_date_and_nothing_else(http: TestClient) -> None:
    odd = ("0", "86400", "2026-01-31T00:00:00", "20260131", "2026-1-31", "2026-02-30")
    for path in ("/v1/usage", "/v1/usage.csv", "/usage"):
        assert http.get(path, params={"since": "2026-01-30", "until": "2026-01-31"}).status_code == 200
        for day, name in product(odd, ("since", "until")):
            assert http.get(path, params={name: day}).status_code == 422, (name, day)
        assert "at most 366 days" in http.get(path, params={"since": "2025-01-30", "until": "2026-01-31"}).text


def test_a_method_that_an_address_lacks_is_told_the_others(http: TestClient) -> None:
    asked = [(method, "/v1/datasets/estimate", "POST") for method in ("GET", "HEAD", "PUT", "OPTIONS", "PROPFIND")]
    for method, path, others in (*asked, ("PUT", "/v1/jobs", "GET, HEAD, POST")):
        answer = http.request(method, path)
        assert (answer.status_code, answer.headers["allow"]) == (405, others)
    assert answer.json()["type"] == "/problems/method-not-allowed"
    matrix = {"name": "estimate", "hands": ["allegro"], "objects": ["mug"]}
    assert http.post("/v1/datasets", json=matrix).status_code == 422, "no dataset takes its name"


def test_a_downloaded_shard_is_hdf5_with_its_sum_as_etag(http: TestClient, shard: str) -> None:
    answer = http.get(f"/v1/shards/{shard}/file")
    assert answer.headers["content-type"] == "application/x-hdf5"
    assert answer.headers["etag"] == f'"{http.get(f"/v1/shards/{shard}").json()["sha256"]}"'
    with h5py.File(io.BytesIO(answer.content)) as file:
        assert file["grasp/hand_pose"].shape == (32, 7)


def test_a_range_gives_just_its_bytes_and_what_is_none_the_whole(http: TestClient, file: str) -> None:
    whole = http.get(file).content
    for header, wanted in (("bytes=0-99", whole[:100]), ("bytes=100-", whole[100:]), ("bytes=-7", whole[-7:])):
        part = http.get(file, headers={"Range": header})
        assert (part.status_code, part.content) == (206, wanted)
        assert part.headers["content-range"].endswith(f"/{len(whole)}")
    answer = http.get(file, headers={"Range": "bytes=99999999-"})
    assert (answer.status_code, answer.headers["content-range"]) == (416, f"bytes */{len(whole)}")
    digits = "9" * 4400
    odd = ("bytes=-", "items=0-3", "bytes=0-1,4-5", f"bytes=-{digits}", f"bytes={digits}-", f"bytes=0-{digits}")
    assert {parse_range(header, 100) for header in (None, *odd)} == {None}


def test_a_signed_file_is_handed_out_by_the_store(http: TestClient, file: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Store, "sign", lambda *_, **__: "https://bucket.example/signed")
    answer = http.get(file, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (307, "https://bucket.example/signed")


def test_grasps_come_in_the_order_and_by_the_filters_asked_for(http: TestClient, shard: str) -> None:
    grasps = http.get("/v1/grasps", params={"sort": "penetration_depth_mm", "order": "asc"}).json()["items"]
    depths = [grasp["penetration_depth_mm"] for grasp in grasps]
    assert depths == sorted(depths)
    query = {"hand": "allegro", "valid": "true", "min_epsilon": 0.1, "max_intersection_volume_cm3": 0.3}
    grasps = http.get("/v1/grasps", params=query).json()["items"]
    assert grasps and all(g["valid"] and g["epsilon"] >= 0.1 and g["intersection_volume_cm3"] <= 0.3 for g in grasps)
    for other in ({"hand": "shadow"}, {"scene": "any"}, {"min_clearance_m": 0.001}, {"lift_hard": "true"}):
        assert http.get("/v1/grasps", params=query | other).json()["items"] == []
    assert http.get("/v1/grasps", params=query | {"scene": "free"}).json()["items"] == grasps
    for unknown in ({"colour": "red"}, {"scene": "moon"}):
        assert http.get("/v1/grasps", params=unknown).status_code == 422


@pytest.mark.parametrize("harm", [flip, cut, remove])
@pytest.mark.parametrize("path", ["/v1/shards/{}/file", "/v1/grasps/{}/0"])
def test_a_damaged_shard_is_refused_with_its_name(
    http: TestClient, services: Services, shard: str, harm: Callable[[Store, str], None], path: str
) -> None:
    harm(services.store, f"shards/base/{shard}.h5")
    answer = http.get(path.format(shard), headers={"Range": "bytes=0-9"})
    assert (answer.status_code, answer.json()["type"]) == (500, "/problems/damaged-shard")
    assert shard in answer.json()["detail"]
    assert "etag" not in answer.headers and "immutable" not in answer.headers.get("cache-control", "")


def test_a_picture_of_a_damaged_shard_is_refused(http: TestClient, services: Services) -> None:
    views = finish_all(services, add_job(services, scenes=1, views=2, width=24, height=16))[-1]
    assert http.get(f"/shards/{views.shard_id}/pictures/0.png").status_code == 200
    flip(services.store, views.key)
    http.app.state.pictures = ShardPictures(services.store)  # type: ignore[attr-defined]
    answer = http.get(f"/shards/{views.shard_id}/pictures/0.png")
    assert answer.status_code == 500 and views.key in answer.text
