"""Lists of jobs, hands and objects; the search; what a job cost, why candidates were rejected, the log of a task."""

import re
from datetime import datetime
from operator import attrgetter

import pytest
from starlette.testclient import TestClient

from graspd.api.access.keys import Scope
from graspd.api.formatting import duration
from graspd.service.model.planning import PlannedTask, plan_tasks
from graspd.service.model.records import JobRecord
from graspd.service.model.states import State
from graspd.service.pipeline import tagging
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.queue.port import rq_id
from graspd.service.settings import Settings
from tests.api.factories import add_job, finish, finish_all, people_of
from tests.fakes import fail_task, plan_all

NEVER = "9999-01-01T00:00:00Z"
INFO = {"outcomes": {"slipped": 7, "penetration": 2}, "planner_seconds": 9.0, "validation_seconds": 3.0}


#: Label and value of a row, with or without a bar.
ROW = r"<dt>([^<]+)(?:<span[^>]*>[^<]*</span>)?</dt><dd[^>]*>(?:<progress.*?</progress></dd><dd[^>]*>)?([^<]+)"


def listed(http: TestClient, path: str) -> list[str]:
    """Ids of the jobs on a list, in its order."""
    return list(dict.fromkeys(re.findall(r'href="/jobs/([0-9a-f]{32})"', http.get(path).text)))


def task_of(record: JobRecord) -> PlannedTask:
    return next(plan_tasks(record))


def test_jobs_are_found_by_words(http: TestClient, services: Services) -> None:
    one, other = add_job(services, hand="barrett", object="bottle"), add_job(services, hand="shadow", object="mug")
    cells = DatasetRequest.model_validate({"name": "kitchen-1", "hands": ["allegro"], "objects": ["block"]})
    actions.create(services, cells)
    plan_all(services)
    (cell,) = (job.id for job in services.index.jobs.page().items if job.request.hand == "allegro")
    expected = {"barr": one.id, other.id[:9]: other.id, "MUG shad": other.id, "kitchen": cell, "barrett mug": None}
    for words, job in expected.items():
        assert listed(http, f"/jobs?q={words}") == ([job] if job else []), words
    assert listed(http, "/jobs?q=%25") == [], "the characters of LIKE mean themselves"


def test_jobs_are_found_by_the_name_of_their_key(http: TestClient, services: Services, settings: Settings) -> None:
    people = people_of(settings, ada=(Scope.SUBMIT, "lab"), bob=(Scope.SUBMIT, "lab"))
    of = {}
    for seed, (name, key) in enumerate(people.items()):
        said = {"hand": "allegro", "object": "mug", "grasps": 32, "seed": seed}
        of[name] = http.post("/v1/jobs", json=said, headers=key).json()["id"]
    page = http.get("/jobs?q=ADA", headers=people["bob"]).text
    assert of["ada"] in page and of["bob"] not in page


@pytest.mark.parametrize("sort", ["created", "hand", "object", "state", "duration"])
def test_jobs_are_paged_in_every_order(services: Services, sort: str) -> None:
    for seed in range(7):
        job = add_job(services, seed=seed, hand=("allegro", "barrett")[seed % 2], object=("mug", "block")[seed // 4])
        if seed % 3 == 0:
            finish_all(services, job)
    every = services.index.jobs.page(sort=sort).items
    value = {
        "hand": lambda job: job.request.hand,
        "object": lambda job: job.request.object,
        # Unfinished jobs have taken longest.
        "duration": lambda job: datetime.fromisoformat(job.finished or NEVER) - datetime.fromisoformat(job.created),
    }.get(sort, attrgetter(sort))
    values = [value(job) for job in every]
    assert values == sorted(values, reverse=True) and len(values) == 7
    for descending, ids in ((True, [job.id for job in every]), (False, [job.id for job in every][::-1])):
        found, cursor = [], None
        while cursor or not found:
            page = services.index.jobs.page(sort=sort, descending=descending, limit=3, cursor=cursor)
            found, cursor = [*found, *(job.id for job in page.items)], page.next
        assert found == ids


def test_many_jobs_are_changed_at_once(http: TestClient, services: Services) -> None:
    jobs = [add_job(services, seed=seed).id for seed in range(5)]
    done = add_job(services, hand="barrett")
    finish_all(services, done)

    def states() -> list[State]:
        return [services.index.jobs.get(job).state for job in jobs]

    answer = http.post("/jobs/act?action=cancel", data={"job": [*jobs[:2], done.id]})
    assert "2 jobs cancelled." in answer.text and "1 unchanged, for example" in answer.text
    answer = http.post("/jobs/act?action=cancel", data={"job": jobs[2:], "query": "q=allegro"})
    assert "3 jobs cancelled." in answer.text and 'value="allegro"' in answer.text, "the list stays"
    assert states() == [State.CANCELLED] * 5
    http.post("/jobs/act?action=retry", data={"job": jobs[:1]})
    assert states() == [State.QUEUED] + [State.CANCELLED] * 4
    refused = http.post("/jobs/act?action=delete", data={"job": jobs[1:], "typed": "3"})
    assert refused.status_code == 422 and "type 4" in refused.text and len(states()) == 5
    http.post("/jobs/act?action=delete", data={"job": jobs[1:], "typed": "4"})
    assert set(listed(http, "/jobs")) == {jobs[0], done.id}
    for wrong in ({"job": []}, {"job": ["a"] * 200}):
        assert http.post("/jobs/act?action=cancel", data=wrong).status_code in (400, 422)
    assert http.post("/jobs/act?action=burn", data={"job": jobs[:1]}).status_code == 422


def test_a_key_changes_only_its_own_jobs(http: TestClient, services: Services, settings: Settings) -> None:
    people = people_of(settings, ada=(Scope.SUBMIT, ""), bob=(Scope.SUBMIT, ""))
    said = {"hand": "allegro", "object": "mug", "grasps": 32}
    job = http.post("/v1/jobs", json=said, headers=people["ada"]).json()["id"]
    answer = http.post("/jobs/act?action=cancel", data={"job": job}, headers=people["bob"])
    assert "0 jobs cancelled. 1 unchanged" in answer.text
    assert services.index.jobs.get(job).state is State.QUEUED


def test_a_job_says_what_was_rejected_and_what_it_cost(
    http: TestClient, services: Services, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    priced = settings.model_copy(update={"cpu_price_per_h": 36.0, "price_unit": "EUR"})
    monkeypatch.setattr(http.app.state, "settings", priced)
    earlier = finish(services, other := add_job(services, seed=1), task_of(other))
    record = add_job(services, grasps=64)
    assert "Reasons appear after the first task." in http.get(f"/jobs/{record.id}").text
    made = [finish(services, record, task, **INFO) for task in plan_tasks(record)]
    page = http.get(f"/jobs/{record.id}").text
    rows = dict(re.findall(ROW, page))
    # Two tasks of 12.5 s on a CPU, at 1 EUR per 100 s; the earlier job took 12.5 s for its valid grasps.
    assert rows["slipped"] == "14" and rows["with penetration in simulation"] == "4"
    assert (rows["planner"], rows["validation"]) == ("18 s", "6.0 s")
    assert (rows["CPU workers"], rows["Cost so far"]) == ("25 s", "0.250")
    assert rows["Estimate"] == duration(64 * 12.5 / earlier.valid)
    assert "reuse" not in page
    # The same batches in a smaller job: its shards are there already.
    half = add_job(services, grasps=32)
    services.index.write.add_manifests(made[:1])
    page = http.get(f"/jobs/{half.id}").text
    assert "All tasks reuse results that were stored already" in page and "none, reused" in page


def test_the_log_of_a_task_is_shown_while_it_runs_and_afterwards(http: TestClient, services: Services) -> None:
    record = add_job(services, grasps=64)
    first, second = plan_tasks(record)
    services.queue.put_task_log(rq_id(first.id, 1), "10:00 <rollout>")
    page = http.get(f"/jobs/{record.id}/tasks/{first.id}").text
    assert "10:00 &lt;rollout&gt;" in page and f'data-events="/v1/jobs/{record.id}/events"' in page
    finish(services, record, first, **INFO, log="all of it")
    fail_task(services, record.id, second, log="until here", reason="it broke")
    page = http.get(f"/jobs/{record.id}/tasks/{first.id}").text
    assert "all of it" in page and "9.0 s" in page
    page = http.get(f"/jobs/{record.id}/tasks/{second.id}").text
    assert all(words in page for words in ("until here", "it broke"))
    assert f'href="/jobs/{record.id}/tasks/{second.id}"' in http.get(f"/jobs/{record.id}").text
    other = add_job(services, seed=3)
    assert http.get(f"/jobs/{other.id}/tasks/{first.id}").status_code == 404
    assert "all of it" not in str(services.index.shards.get(first.output).manifest), "the index stays small"


def test_hands_and_objects_name_their_datasets_and_licence(http: TestClient, services: Services) -> None:
    wanted = DatasetRequest.model_validate({"name": "kitchen", "hands": ["allegro"], "objects": ["mug"]})
    actions.create(services, wanted)
    for path, others in (("/hands", 2), ("/objects", 2)):
        page = http.get(path).text
        assert page.count("data-model=") == page.count("Apache-2.0") == 3
        assert page.count('href="/datasets/kitchen"') == 1 == 3 - others
    assert "<dt>Joints</dt><dd>16</dd>" in http.get("/hands").text
    for words in ("<dt>Size</dt><dd>60 × 45 × 90 mm</dd>", "<dt>Mass</dt><dd>0.156 kg</dd>"):
        assert words in http.get("/objects/block").text and words in http.get("/objects").text, "without a check"
    assert 'href="/datasets/kitchen"' in http.get("/objects/mug").text
    assert 'href="/datasets/kitchen"' not in http.get("/objects/block").text
    assert 'href="/datasets/kitchen"' in http.get("/hands/allegro").text


def test_the_search_finds_everything_and_leads_there(http: TestClient, services: Services) -> None:
    job = add_job(services, object="bottle")
    shard = finish_all(services, job)[0].shard_id
    tagging.tag_grasps(services, "bottles I like", [(shard, 0)], project="", owner="", permit=lambda _: None)
    actions.create(
        services, DatasetRequest.model_validate({"name": "bottles", "hands": ["allegro"], "objects": ["mug"]})
    )
    page = http.get("/search?q=bottle").text
    for address in ("/datasets/bottles", "/objects/bottle", "/grasps?tag=bottles%20I%20like", f"/jobs/{job.id}"):
        assert f'href="{address}"' in page
    for text, address in (("sub", "/submit"), (job.id[:8], f"/jobs/{job.id}"), ("barrett", "/hands/barrett")):
        answer = http.get(f"/search?q={text}&go=true", follow_redirects=False)
        assert answer.headers["location"] == address
    assert "Nothing has this name" in http.get("/search?q=zzz&go=true").text
