"""One grasp: its document, its page, the models it is shown with; and the list in both views."""

import html
import re
import struct
import subprocess
from pathlib import Path
from urllib.parse import parse_qsl

import numpy as np
import pytest
from starlette.testclient import TestClient

from graspd.api.catalog import grasps
from graspd.api.catalog.grasps import validated_by
from graspd.service import user_cache
from graspd.service.model.metrics import AXIS_MEANINGS, PerturbedParameter
from graspd.service.model.planning import plan_tasks
from graspd.service.pipeline.backends import Services
from graspd.service.store.shards import Shard, read_shard
from graspd.worker.validation.protocol import ValidatedBy
from tests.api.factories import JOINTS, add_job, finish, finish_all


def test_a_grasp_is_the_row_of_its_shard(http: TestClient, services: Services) -> None:
    manifest = finish_all(services, add_job(services))[0]
    shard = read_shard(services.store.get(manifest.key))
    document = http.get(f"/v1/grasps/{manifest.shard_id}/5").json()
    np.testing.assert_allclose(document["postures"]["squeeze"]["hand_pose"], shard["squeeze/hand_pose"][5])
    np.testing.assert_allclose(document["sweep"]["epsilon"], shard["quality/epsilon"][5])
    assert len(document["joint_names"]) == len(document["postures"]["grasp"]["joint_positions"]) == JOINTS
    assert document["hand_digest"] == manifest.hand_digest


def test_episodes_are_counted_and_shown_with_their_films(http: TestClient, services: Services) -> None:
    plain = {"scene": "table", "scenes": 1}
    flying = add_job(services, **plain, episodes="flying", film=["scene", "wrist"])
    _, base, made = finish_all(services, flying)
    arm = add_job(services, **plain, episodes="ur10e")
    finish(services, arm, list(plan_tasks(arm))[-1])
    assert (made.count, made.valid) == (31, 25), "the first grasp has none, and six others are out of reach"
    assert http.get(f"/v1/jobs/{flying.id}").json()["episodes"] == {"succeeded": 25, "out of reach": 6}
    assert "25 of 31 grasps executed, 25 succeeded" in http.get(f"/jobs/{flying.id}").text
    found = {
        row: [(one["robot"], one["outcome"], one["films"]) for one in http.get(f"{of}/episodes").json()]
        for row in (0, 3, 5)
        for of in (f"/v1/grasps/{base.shard_id}/{row}",)
    }
    films = {camera: f"/v1/shards/{made.shard_id}/films/3/{camera}" for camera in ("scene", "wrist")}
    assert found[0] == []
    assert sorted(found[3], key=str) == [("flying", "succeeded", films), ("ur10e", "succeeded", {})]
    assert ("flying", "out of reach", {}) in found[5]
    page = http.get(f"/grasps/{base.shard_id}/3").text
    assert all(f'<video controls preload="metadata" src="{film}"' in page for film in films.values())
    for camera, film in films.items():
        answer = http.get(film)
        assert (answer.headers["content-type"], answer.content) == ("video/mp4", f"{camera} 3".encode())
    for absent in (films["scene"].replace("/3/", "/5/"), films["scene"].replace("/3/", "/0/"), films["scene"] + "s"):
        assert http.get(absent).status_code == 404
    assert "media-src 'self'" in answer.headers["content-security-policy"]
    assert http.get(f"/jobs/{arm.id}").text.count("<video") == 0


def test_an_absent_grasp_is_named_and_a_lost_file_an_error(http: TestClient, services: Services) -> None:
    manifest = finish_all(services, add_job(services))[0]
    for row in (32, -1):
        answer = http.get(f"/v1/grasps/{manifest.shard_id}/{row}")
        assert answer.status_code == 404 and f"there is no grasp {row}" in answer.json()["detail"]
    (services.settings.data_dir / "store" / manifest.key).unlink()
    answer = http.get(f"/grasps/{manifest.shard_id}/0", headers={"Accept": "text/html"})
    assert answer.status_code == 500 and manifest.key in answer.text


def test_a_verdict_says_whose_it_is() -> None:
    success, validated = np.array([1, 0], np.int8), np.array([ValidatedBy.MUJOCO, ValidatedBy.MUJOCO_WARP], np.uint8)
    files = [{"quality/success": success, "quality/validated_by": validated}, {"quality/success": success}, {}]
    told = [[validated_by(Shard("base", {}, arrays), row) for row in (0, 1)] for arrays in files]
    assert told == [["mujoco", "mujoco_warp"], ["mujoco", "mujoco"], [None, None]]


def test_the_page_of_a_grasp_tells_quality_and_where_it_is_kept(http: TestClient, services: Services) -> None:
    record = add_job(services)
    shard = finish_all(services, record)[0].shard_id
    page = http.get(f"/grasps/{shard}/3").text
    assert f'href="/v1/shards/{shard}/file"' in page
    assert f'href="/jobs/{record.id}"' in page
    assert f'rel="prev" href="/grasps/{shard}/2"' in page
    assert f"client.shard(&#39;{shard}&#39;)[3]" in page
    assert "cm³" in page


@pytest.mark.parametrize(("kind", "name"), [("hands", "allegro"), ("objects", "mug")])
def test_models_are_served_as_gltf_and_kept_under_their_digest(http: TestClient, kind: str, name: str) -> None:
    digest = http.get(f"/v1/{kind}/{name}").json()["digest"]
    by_name, by_digest = http.get(f"/v1/{kind}/{name}/model"), http.get(f"/v1/{kind}/{digest}/model")
    assert by_name.content == by_digest.content
    magic, version, length = struct.unpack("<4sII", by_name.content[:12])
    assert (magic, version, length) == (b"glTF", 2, len(by_name.content))
    assert "immutable" in by_digest.headers["cache-control"]
    assert by_name.headers["cache-control"] == "no-cache"


def test_robust_grasps_are_found_by_share_and_first_failure(http: TestClient, services: Services) -> None:
    job = add_job(services, robust_models=8)
    manifest = finish_all(services, job)[0]
    shard = read_shard(services.store.get(manifest.key))
    share, weakest = shard["quality/robust_share"], shard["quality/robust_weakest"]
    row = int(np.flatnonzero((share < 0.9) & (weakest > 0))[0])
    document = http.get(f"/v1/grasps/{manifest.shard_id}/{row}").json()
    assert document["robust_share"] == pytest.approx(share[row])
    assert document["robust_weakest"] == PerturbedParameter(int(weakest[row])).word

    def found(**where: object) -> set[int]:
        query = {"limit": 200, "job": job.id, **where}
        return {one["row"] for one in http.get("/v1/grasps", params=query).json()["items"]}

    assert found(min_robust_share=0.75) == set(np.flatnonzero(share >= 0.75).tolist())
    assert found(robust_weakest="friction") == set(np.flatnonzero(weakest == PerturbedParameter.FRICTION).tolist())
    assert http.get("/v1/grasps", params={"robust_weakest": "luck"}).status_code == 422
    page = http.get(f"/grasps/{manifest.shard_id}/{row}").text
    assert "Robust share" in page and f"first failure: {AXIS_MEANINGS[PerturbedParameter(int(weakest[row]))]}" in page


def test_forms_tag_chosen_grasps_and_lead_back_to_the_list(http: TestClient, services: Services) -> None:
    record = add_job(services)
    shard = finish_all(services, record)[0].shard_id

    def does(action: str, **fields: object) -> str:
        answer = http.post(f"/grasps/{action}", data={"tag": "good", **fields}, follow_redirects=False)
        return answer.headers.get("location", f"{answer.status_code}")

    filters = {"filter": f"job={record.id}&valid=false", "here": "/grasps", "view": "table"}
    back = does("tag", grasp=[f"{shard}:1", f"{shard}:2"], **filters)
    assert back == f"/grasps?job={record.id}&valid=false&view=table"
    assert "2 grasps tagged good." in http.get(back).text
    assert does("untag", all="true", filter="tag=good", here=f"/jobs/{record.id}") == f"/jobs/{record.id}"
    # What a form says of where it stands leads nowhere else; and a form that chooses nothing says so.
    assert does("tag", grasp=f"{shard}:1", here="//example.org") == "/grasps"
    assert does("tag") == does("tag", all="true", filter="job=none") == does("export", grasp="../../x:1") == "422"
    assert "no grasp is selected" in http.post("/grasps/tag", data={"tag": "good"}).text
    long = {"tag": "good", "all": "true", "filter": "x" * 40_001}
    assert "the filter of the list cannot be read" in http.post("/grasps/tag", data=long).text
    assert http.post("/grasps/tag", data=filters, headers={"Origin": "https://example.org"}).status_code == 403
    assert http.post("/grasps/export", data={"grasp": f"{shard}:1", "format": "csv"}).text.count("\r\n") == 2
    assert http.post("/tags/good/delete").status_code == 422, "its name was not typed"
    gone = http.post("/tags/good/delete", data={"typed": "good"})
    assert gone.url.path == "/deleted" and "The tag good is deleted." in gone.text
    assert http.post("/deleted/tag/good/restore").url.path == "/grasps"


def test_the_address_of_a_list_holds_its_filter_and_no_empty_fields(http: TestClient) -> None:
    wrong = http.get("/grasps", params={"where": "epsilon >"})
    assert wrong.status_code == 422 and "the expression ends where a value is expected" in wrong.text
    assert 'value="epsilon &gt;"' in wrong.text
    sent = {"hand": "allegro", "where": "", "tag": "", "min_epsilon": "", "sort": "", "order": ""}
    answer = http.get("/grasps", params=sent, follow_redirects=False)
    assert (answer.status_code, answer.headers["location"]) == (303, "/grasps?hand=allegro")
    assert http.get("/grasps", params={"hand": ""}, follow_redirects=False).headers["location"] == "/grasps"


_FACET = re.compile(r'<li><a href="/grasps\?([^"]*)"><span>[^<]*</span> <span class="unit">(\d+)</span>')


def test_a_facet_counts_what_its_link_finds(http: TestClient, services: Services) -> None:
    finish_all(services, add_job(services, payload=True, robust_models=8))
    finish_all(services, add_job(services, hand="shadow", object="block", validation="none"))
    seen = set()
    for start in ("", "hand=allegro&type=pinch", "valid=true&min_epsilon=0.25&max_payload_kg=0.8"):
        found = _FACET.findall(http.get(f"/grasps?{start}").text)
        seen |= {key for address, _ in found for key, _ in parse_qsl(html.unescape(address))}
        for address, count in found:
            listed = http.get(f"/v1/grasps?{html.unescape(address)}&limit=200").json()["items"]
            assert len(listed) == int(count) > 0, (start, address)
    assert seen >= {"hand", "object", "valid", "validated", "type", "robust_weakest"}
    chips = http.get("/grasps?hand=allegro&min_epsilon=0.25").text
    assert 'href="/grasps?min_epsilon=0.25" title="Remove this filter">Hand: allegro' in chips
    assert 'href="/grasps?hand=allegro" title="Remove this filter">ε ≥ 0.250' in chips


def test_facets_of_many_grasps_are_estimates_from_a_sample(
    http: TestClient, services: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    finish_all(services, add_job(services, grasps=32 * 12))
    monkeypatch.setattr(grasps, "SAMPLE", 100)
    page = http.get("/grasps").text
    # Shards are drawn by their ids: of 12, 3.1 on average, each with 32 grasps; 0 to 8 in all but 1 of 1,000 draws.
    assert 0 <= int(re.findall(r"about (\d[\d,]*) grasps", page)[0].replace(",", "")) <= 1100
    assert len(http.get("/v1/grasps?limit=200").json()["items"]) == 200


def test_grasps_are_compared_at_a_short_address_and_placed_on_a_map(http: TestClient, services: Services) -> None:
    shard = finish_all(services, add_job(services))[0].shard_id
    sent = {"grasp": [f"{shard}:{row}" for row in (1, 2, 30)]}
    shown = http.post("/grasps/compare", data=sent)
    assert shown.url.query.decode() == f"g={','.join(f'{shard[:12]}.{row}' for row in (1, 2, 30))}"
    assert shown.text.count('data-viewer="grasp"') == 3 and "Contact area" in shown.text
    for few in ([f"{shard}:1"], [f"{shard}:{row}" for row in range(5)]):
        answer = http.post("/grasps/compare", data={"grasp": few})
        assert answer.status_code == 422 and "select 2 to 4 grasps" in answer.text
    assert http.get("/grasps/compare?g=ffffffffffff.1,nonsense", headers={"Accept": "text/html"}).status_code == 404
    drawn = http.get("/grasps?view=map&type=power").text
    assert drawn.count("<circle class=") == len(http.get("/v1/grasps?type=power&limit=200").json()["items"])
    assert "No grasp matches" in http.get("/grasps?view=map&min_epsilon=99").text
    lost = finish_all(services, add_job(services, seed=5))[0].key
    (services.settings.data_dir / "store" / lost).unlink()
    similar = http.get(f"/grasps/{shard}/3").text
    assert similar.count('<li class="card grasp">') == 6 and f'value="{shard}:3" data-fixed' in similar


def test_a_replay_is_simulated_once_and_a_missing_engine_is_told(
    http: TestClient, services: Services, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    shard = finish_all(services, add_job(services))[0].shard_id
    monkeypatch.setattr(user_cache, "cache_folder", lambda name: tmp_path / name)
    ends: list[object] = [
        subprocess.CalledProcessError(1, "python", stderr=b"...\nModuleNotFoundError: No module named 'mujoco'"),
        subprocess.TimeoutExpired("python", 60),
        subprocess.CompletedProcess("python", 0, b'{"outcome": "held", "way": []}'),
    ]
    commands = []

    def run(command: list[str], **_: object) -> object:
        commands.append(command)
        end = ends.pop(0)
        if isinstance(end, Exception):
            raise end
        return end

    monkeypatch.setattr(subprocess, "run", run)
    address = f"/v1/grasps/{shard}/3/replay"
    for words in ("No module named 'mujoco'", "longer than 60 s"):
        answer = http.get(address)
        assert answer.status_code == 503 and words in answer.json()["detail"]
    assert http.get(address).json() == http.get(address).json() == {"outcome": "held", "way": []}
    assert len(commands) == 3 and commands[-1][-2:] == [shard, "3"]
    assert http.get(f"/v1/grasps/{shard}/99/replay").status_code == 404
