"""`/v1/shards` and `/v1/grasps`: what was made."""

from __future__ import annotations

import io
from collections.abc import Callable

import h5py
import pytest
from starlette.testclient import TestClient

from graspd.api.dashboard.job_pages import Pictures
from graspd.api.routes.jobs import parse_range
from graspd.service.pipeline.backends import Services
from graspd.service.store.store import Store
from tests.api.factories import add_job, finish_all
from tests.damage import cut, flip, remove


@pytest.fixture
def shard(http: TestClient, services: Services) -> str:
    return finish_all(services, add_job(services))[0].shard_id


def test_a_downloaded_shard_is_hdf5_with_its_sum_as_etag(http: TestClient, shard: str) -> None:
    answer = http.get(f"/v1/shards/{shard}/file")
    assert answer.headers["content-type"] == "application/x-hdf5"
    assert answer.headers["etag"] == f'"{http.get(f"/v1/shards/{shard}").json()["sha256"]}"'
    with h5py.File(io.BytesIO(answer.content)) as file:
        assert file["grasp/hand_pose"].shape == (32, 7)


def test_a_range_gives_just_its_bytes_and_what_is_none_the_whole(http: TestClient, shard: str) -> None:
    whole = http.get(f"/v1/shards/{shard}/file").content
    for header, wanted in (("bytes=0-99", whole[:100]), ("bytes=100-", whole[100:]), ("bytes=-7", whole[-7:])):
        part = http.get(f"/v1/shards/{shard}/file", headers={"Range": header})
        assert (part.status_code, part.content) == (206, wanted)
        assert part.headers["content-range"].endswith(f"/{len(whole)}")
    answer = http.get(f"/v1/shards/{shard}/file", headers={"Range": "bytes=99999999-"})
    assert (answer.status_code, answer.headers["content-range"]) == (416, f"bytes */{len(whole)}")
    digits = "9" * 4400
    odd = ("bytes=-", "items=0-3", "bytes=0-1,4-5", f"bytes=-{digits}", f"bytes={digits}-", f"bytes=0-{digits}")
    assert {parse_range(header, 100) for header in (None, *odd)} == {None}


def test_a_store_that_signs_hands_the_file_out_itself(
    http: TestClient, services: Services, shard: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(services.store), "sign", lambda *_, **__: "https://bucket.example/signed")
    answer = http.get(f"/v1/shards/{shard}/file", follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (307, "https://bucket.example/signed")


def test_grasps_come_in_the_order_and_by_the_filters_asked_for(http: TestClient, shard: str) -> None:
    grasps = http.get("/v1/grasps", params={"sort": "penetration_depth_mm", "order": "asc"}).json()["items"]
    depths = [grasp["penetration_depth_mm"] for grasp in grasps]
    assert depths == sorted(depths)
    query = {"hand": "allegro", "valid": "true", "min_epsilon": 0.1, "max_intersection_volume_cm3": 0.3}
    grasps = http.get("/v1/grasps", params=query).json()["items"]
    assert grasps and all(g["valid"] and g["epsilon"] >= 0.1 and g["intersection_volume_cm3"] <= 0.3 for g in grasps)
    assert http.get("/v1/grasps", params=query | {"hand": "shadow"}).json()["items"] == []
    assert http.get("/v1/grasps", params={"colour": "red"}).status_code == 422


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
    http.app.state.pictures = Pictures(services.store)  # type: ignore[attr-defined]
    answer = http.get(f"/shards/{views.shard_id}/pictures/0.png")
    assert answer.status_code == 500 and views.key in answer.text
