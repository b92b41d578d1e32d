"""The pages: complete without JavaScript, escaped, honest when empty."""

import io
import re
import shlex
from collections.abc import Callable
from html import unescape
from typing import Any
from unittest.mock import Mock

import httpx
import pytest
from PIL import Image
from starlette.testclient import TestClient
from typer.testing import CliRunner

from graspd.api.dashboard.forms import INPUTS
from graspd.cli import build_app
from graspd.client.client import Client
from graspd.service.index.notes import Damage
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import QueueUnavailable
from graspd.service.model.planning import plan_tasks
from graspd.service.model.states import State
from graspd.service.pipeline.backends import Services
from tests.api.conftest import BASE_URL
from tests.api.factories import add_job, add_worker, fail, finish, finish_all
from tests.fakes import beat_of
from tests.memory_queue import MemoryQueue

FORM = {"hand": "allegro", "object": "mug", "grasps": "32", "fidelity": "standard", "seed": "0", "friction": "1.0"}


def test_damage_of_the_store_is_shown_while_there_is_some(http: TestClient, services: Services) -> None:
    services.index.damage.update([Damage(f"shards/base/{n}.h5", "its <file> is gone", f"{n}") for n in range(7)])
    for path, words in (("/", ("shards/base/0.h5", "its &lt;file&gt; is gone", "and 2 more")), ("/workers", ())):
        page = http.get(path).text
        assert all(word in page for word in (*words, "7 objects of the store", "graspd admin store verify --repair"))
    services.index.damage.replace([])
    assert not [path for path in ("/", "/workers") if "damaged or missing" in http.get(path).text]


def test_home_shows_jobs_workers_and_failures(http: TestClient, services: Services) -> None:
    record = add_job(services, seed=1)
    finish_all(services, record)
    fail(services, add_job(services, seed=2), "the mesh has 12 open edges")
    add_worker(services, "worker-7", "busy")
    page = http.get("/").text
    assert f'href="/jobs/{record.id}"' in page and "worker-7" in page and "the mesh has 12 open edges" in page


def test_jobs_are_filtered_by_state(http: TestClient, services: Services) -> None:
    empty = http.get("/").text
    assert "graspd submit" in empty and "graspd worker" in empty, "it says what to do"
    add_job(services)
    shown = [state for state in State if "allegro" in http.get("/jobs", params={"state": state.value}).text]
    assert shown == [State.QUEUED]


def test_a_finished_job_shows_quality_views_files_and_code(http: TestClient, services: Services) -> None:
    record = add_job(services, scenes=1, views=2, stereo=True)
    manifests = finish_all(services, record)
    page = http.get(f"/jobs/{record.id}").text
    assert page.count("<img ") == 4 * 3  # colour, depth, segmentation
    assert all(f"/v1/shards/{manifest.shard_id}/file" in page for manifest in manifests)
    assert "cm²" in page
    assert f"client.job(&#39;{record.id}&#39;).grasps()" in page


def test_a_job_that_has_not_ended_can_be_cancelled_on_its_page(http: TestClient, services: Services) -> None:
    record = add_job(services, grasps=96, scenes=1)
    page = http.get(f"/jobs/{record.id}").text
    assert f'action="/jobs/{record.id}/cancel"' in page
    assert f'data-events="/v1/jobs/{record.id}/events"' in page
    finish(services, record, next(plan_tasks(record)))
    assert "1 of 3" in http.get(f"/jobs/{record.id}").text


def test_a_failed_job_says_why_and_offers_a_retry(http: TestClient, services: Services) -> None:
    fail(services, record := add_job(services), "<b>not</b> watertight")
    page = http.get(f"/jobs/{record.id}").text
    assert "&lt;b&gt;not&lt;/b&gt; watertight" in page and f'action="/jobs/{record.id}/retry"' in page
    assert "&lt;b&gt;not&lt;/b&gt; watertight" in http.get("/jobs?state=failed").text


def test_a_thumbnail_is_the_picture_of_the_shard(http: TestClient, services: Services) -> None:
    record = add_job(services, scenes=1, views=1, width=64, height=48)
    base, *_, views = (manifest.shard_id for manifest in finish_all(services, record))
    answer = http.get(f"/shards/{views}/pictures/0.png")
    picture = Image.open(io.BytesIO(answer.content))
    assert (answer.headers["content-type"], picture.size) == ("image/png", (64, 48))
    assert picture.getpixel((0, 0)) == (40, 40, 40)
    for channel in ("depth", "segmentation"):
        answer = http.get(f"/shards/{views}/pictures/0.png", params={"channel": channel, "width": 32})
        assert Image.open(io.BytesIO(answer.content)).size == (32, 24)
    for path in (f"/shards/{views}/pictures/9.png", f"/shards/{base}/pictures/0.png"):
        assert http.get(path).status_code == 404
    assert http.get("/shards/x/pictures/0.png", params={"channel": "feasible"}).status_code == 422


def test_the_table_of_grasps_keeps_its_filters_and_says_what_fits_none(http: TestClient, services: Services) -> None:
    finish_all(services, add_job(services, grasps=128))
    page = http.get("/grasps", params={"valid": "true", "sort": "penetration_depth_mm", "order": "asc"}).text
    (address,) = re.findall(r'rel="next" href="([^"]*)"', page.replace("&amp;", "&"))
    assert "valid=true" in address
    assert http.get(address).text.count('<li class="card grasp">') > 2
    assert "No grasp matches these filters" in http.get("/grasps", params={"min_epsilon": 99}).text
    answer = http.get("/grasps", params={"min_epsilon": "much"})
    assert answer.status_code == 422 and "min_epsilon" in answer.text


@pytest.mark.parametrize(
    ("change", "words"), [({"grasps": "0"}, "must be at least 1"), ({"views": "3", "scenes": "0"}, "views need scenes")]
)
def test_a_form_in_error_keeps_what_was_typed(http: TestClient, change: dict[str, str], words: str) -> None:
    answer = http.post("/submit", data=FORM | {"seed": "77"} | change)
    assert answer.status_code == 422 and words in answer.text and 'value="77"' in answer.text


def test_the_buttons_cancel_and_retry_a_job(http: TestClient, services: Services) -> None:
    record = add_job(services)
    for action, state in (("cancel", "cancelled"), ("retry", "queued")):
        answer = http.post(f"/jobs/{record.id}/{action}", follow_redirects=False)
        assert (answer.status_code, answer.headers["location"]) == (303, f"/jobs/{record.id}")
        assert http.get(f"/v1/jobs/{record.id}").json()["state"] == state


def test_no_page_asks_for_anything_from_elsewhere_or_inline(http: TestClient) -> None:
    served = set()
    for path in (
        "/",
        "/datasets",
        "/grasps",
        "/workers",
        "/engine",
        "/chart",
        "/stability",
        "/submit",
        "/notifications",
    ):
        page = http.get(path).text
        addresses = re.findall(r'(?:src|href|action)="([^"]*)"', page)
        assert addresses and all(address.startswith(("/", "#")) for address in addresses)
        assert not re.search(r"\sstyle=|\son[a-z]+=|<style|<script>", page)
        served |= {address for address in addresses if address.startswith("/static/")}
    assert served and {http.get(address).status_code for address in served} == {200}


def test_pages_are_read_without_redis(http: TestClient, services: Services, monkeypatch: pytest.MonkeyPatch) -> None:
    record = add_job(services)
    finish_all(services, record)
    away = Mock(side_effect=QueueUnavailable("Redis does not answer at unix:///redis.sock"))
    for method in ("ping", "depths"):
        monkeypatch.setattr(MemoryQueue, method, away)
    page = http.get("/")
    assert page.status_code == 200 and "Redis does not answer at unix:///redis.sock" in page.text
    assert http.get(f"/jobs/{record.id}").status_code == 200
    health = http.get("/readyz")
    assert (health.status_code, health.json()["parts"]["redis"]["ok"]) == (503, False)
    assert 'graspd_part_up{part="redis"} 0.0' in http.get("/metrics").text


@pytest.mark.parametrize(
    ("said", "words"),
    [
        ({}, r"About .* on one worker \(.* to .*\) for 32 valid grasps from \d+ candidates"),
        ({"mass": "0.4", "min_payload": "0.5"}, r"About .* on one worker"),
        ({"validation": "none", "grasps": "64"}, r"for 64 feasible grasps from"),
        ({"grasps": "0"}, "No estimate until all values are valid"),
        ({"fidelity": "auto", "target": "gsr>=0.6"}, "No estimate until all values are valid"),
        ({"options": "steps"}, "No estimate until all values are valid"),
    ],
)
def test_the_form_estimates_its_cost_in_a_sentence(http: TestClient, said: dict[str, str], words: str) -> None:
    answer = http.get("/submit", params=said)
    assert answer.status_code == 200
    assert re.search(words, text_of(re.findall(r'<p id="estimate".*?</p>', answer.text, re.DOTALL)[0]))


def text_of(page: str) -> str:
    return unescape(re.sub(r"\s+", " ", re.sub(r"<[^>]*>", "", page)))


def test_the_form_has_every_option_of_a_job_in_a_group_with_help(http: TestClient) -> None:
    first, _, advanced = http.get("/submit").text.partition("<details")
    fields = dict(re.findall(r'<(?:input|select)[^>]*? name="(\w+)"()', advanced))
    assert set(fields) >= set(JobOptions.model_fields) - {"grasps", "scene"}
    assert {"grasps", "scene"} <= set(re.findall(r'id="(\w+)" name="\w+"', first))
    assert all(one.hint for one in INPUTS)
    for name, words in {"mass": "Mass [kg]", "width": "of each picture; default 320", "views": "default 0"}.items():
        assert words in advanced, name
    assert "<details" in (closed := http.get("/submit").text) and 'advanced" open' not in closed
    for said in ({"density": "400"}, {"payload": "true"}):
        assert 'advanced" open' in http.get("/submit", params=said).text
    assert 'advanced" open' in http.post("/submit", data=FORM | {"digits": "elbow"}).text


OPTIONS = {"grasps": "8", "type": "pinch", "digits": "thumb, index", "payload": "true", "options": "steps=90"}


def test_snippets_submit_the_job_of_the_form(http: TestClient, services: Services, calls: Any) -> None:
    command = calls(http.get("/submit", params=OPTIONS | {"density": "400.5", "neighbours": ""}).text)
    (job,) = services.index.jobs.page().items
    assert (job.request.digits, job.request.options, job.request.payload) == (("thumb", "index"), {"steps": 90}, True)
    assert CliRunner().invoke(build_app(), shlex.split(command)[1:]).exit_code == 0
    http.post("/submit", data=FORM | OPTIONS | {"density": "400.5"})
    assert [one.id for one in services.index.jobs.page().items] == [job.id]


@pytest.fixture
def calls(http: TestClient, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], str]:
    """Runs the Python code of a page against the service; returns the page's commands."""

    def answer(request: httpx.Request) -> httpx.Response:
        sent = {"content": request.read(), "headers": {"content-type": "application/json"}}
        found = http.request(request.method, str(request.url), **sent)
        return httpx.Response(found.status_code, content=found.content)

    client = Client(BASE_URL, transport=httpx.MockTransport(answer))
    for module in ("graspd.remote", "graspd.client.reports"):
        monkeypatch.setattr(f"{module}.open_client", lambda url, key=None: client)
    monkeypatch.setattr(client, "close", lambda: None)

    def run(page: str) -> str:
        found = {
            kind: unescape(code) for kind, code in re.findall(r'<pre id="snippet-(\w+)"[^>]*>(.*?)</pre>', page, re.S)
        }
        exec(found.get("python", ""), {})
        return found["shell"]

    return run


def test_every_page_has_code_for_what_it_shows(http: TestClient, services: Services, calls: Any) -> None:
    record = add_job(services)
    shard = finish_all(services, record)[0].shard_id
    http.post("/v1/datasets", json={"name": "kitchen", "hands": ["allegro"], "objects": ["mug"]}).raise_for_status()
    pages = (
        "/ /?state=failed /submit /datasets /datasets/kitchen /compare?one=kitchen&other=kitchen /hands /hands/shadow"
    )
    pages += " /workers /usage /deleted /notifications /chart /stability /engine /grasps?valid=true&min_epsilon=0.1"
    for path in (*pages.split(), f"/jobs/{record.id}", f"/grasps/{shard}/0"):
        for line in calls(http.get(path).text).splitlines():
            words = shlex.split(line)
            if words[0] == "curl":
                assert http.get(words[-1] if "&&" not in words else words[4]).status_code == 200, line
            else:
                told = CliRunner().invoke(build_app(), [*words[1:], "--help"])
                assert (words[0], told.exit_code) == ("graspd", 0), line


def test_a_toast_tells_once_what_happened(http: TestClient, services: Services) -> None:
    job = http.post("/submit", data=FORM)
    assert "The job is submitted." in job.text and "The job is submitted." not in http.get(job.url.path).text
    assert "The same job existed already" in http.post("/submit", data=FORM).text
    for action, words in (("cancel", "The job is cancelled"), ("retry", "run again")):
        assert words in http.post(f"{job.url.path}/{action}").text
    http.cookies.set("graspd_toast", "%3Cscript%3E")
    assert "<script>" not in re.findall(r'<p class="alert good toast".*', http.get("/").text)[0]


def test_a_worker_s_card_names_task_phase_and_fidelity_apart(http: TestClient, services: Services) -> None:
    record = add_job(services, fidelity="draft")
    task = next(plan_tasks(record))
    beat = beat_of("worker-1", state="busy", task_id=task.id)
    services.index.live.set_workers([beat], forget_before="2000-01-01T00:00:00Z")
    services.index.live.set_running({task.id: "worker-1"})
    services.index.live.set_progress({task.id: (1.0, 4.0, "starts")})
    rows = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", http.get("/workers").text))
    told = {name: text_of(rows[name]) for name in ("Task", "Stage", "Phase", "Fidelity")}
    assert told == {"Task": "allegro × mug, batch 0", "Stage": "synthesize", "Phase": "starts", "Fidelity": "draft"}
