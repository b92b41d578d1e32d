"""Tasks of a person, with the clicks and seconds that they take; and the views of grasps."""

import gzip
import time
from pathlib import Path
from typing import Any

import pytest

from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from tests.api.factories import add_job, finish_all
from tests.fakes import plan_all, record_of
from tests.waiting import until

pytestmark = pytest.mark.browser
#: Longest time of a task [s]: three seconds a click, and a busy machine that draws WebGL without a GPU.
TASK_S = 45.0


class Person:
    """Someone at a page, whose clicks and seconds count. A slider that is moved is a click."""

    def __init__(self, page: Any) -> None:
        self.page, self.clicks, self.began = page, 0, time.monotonic()

    def click(self, what: str) -> None:
        self.clicks += 1
        self.page.locator(what).first.click()

    def slide(self, what: str, value: str) -> None:
        self.clicks += 1
        self.page.locator(what).fill(value)

    def needed(self, most: int) -> None:
        assert self.clicks <= most
        assert time.monotonic() - self.began < TASK_S


def test_ten_best_pinch_grasps_of_a_mug_that_lift_400_g(page: Any, services: Services) -> None:
    for seed in range(4):
        finish_all(services, add_job(services, grasps=96, payload=True, seed=seed))
    finish_all(services, add_job(services, object="block", payload=True))
    page.goto("/")
    person = Person(page)
    person.click(".nav >> text=Grasps")
    person.click("#facets a:has-text('mug')")
    page.wait_for_url("**object=mug")
    person.click("#facets a:has-text('pinch')")
    page.wait_for_url("**type=pinch")
    person.click("#facets a:has-text('valid')")
    page.wait_for_url("**valid=true")
    person.slide("fieldset:has-text('Payload') input[data-end=min]", "0.4")
    page.wait_for_url("**/grasps?object=mug&type=pinch&valid=true&min_payload_kg=0.4")
    page.wait_for_selector("#found .chosen >> text=Payload ≥ 0.400 kg")
    person.needed(most=6)
    shown = [one.get_attribute("href") for one in page.locator("#found .grasp > a").all()[:10]]
    found = page.request.get("/v1/grasps?object=mug&valid=true&min_payload_kg=0.4&limit=200").json()["items"]
    pinches = [one for one in found if one["grasp_type"] == 2 and one["digits"] in (3, 5, 9, 17)]
    assert len(shown) >= 5 and shown == [f"/grasps/{one['shard_id']}/{one['row']}" for one in pinches[:10]]


def test_two_datasets_are_compared(page: Any, services: Services) -> None:
    for name in ("kitchen", "bath"):
        wanted = {"name": name, "hands": ["allegro"], "objects": ["mug"], "seed": len(name)}
        actions.create(services, DatasetRequest.model_validate(wanted))
        plan_all(services)
    for job in services.index.jobs.page().items:
        finish_all(services, record_of(services, job.id))
    page.goto("/")
    person = Person(page)
    person.click(".nav >> text=Datasets")
    person.click("text=Compare two")
    page.wait_for_selector("#quality-title")
    person.needed(most=4)
    assert {"kitchen", "bath"} == set(page.locator(".versus thead a").all_inner_texts()[:2])


def test_a_selection_is_taken_home(page: Any, services: Services) -> None:
    finish_all(services, add_job(services))
    page.goto("/grasps?view=table")
    person = Person(page)
    person.click("input[name=grasp] >> nth=1")
    person.click("input[name=grasp] >> nth=4")
    page.select_option("[name=format]", "csv")
    with page.expect_download() as download:
        person.click("button:has-text('Export')")
    person.needed(most=3)
    assert Path(download.value.path()).read_text().count("\n") == 3


def contact(force: float, *, hand: bool) -> list[float]:
    return [0, 0, 0, 0, 0, 1, 0, 0, force, 0, 0.001, 0, float(hand)]


def test_a_replay_moves_the_object_and_its_forces_are_told(page: Any, services: Services) -> None:
    shard = finish_all(services, add_job(services))[0].shard_id
    detail = page.request.get(f"/v1/grasps/{shard}/3").json()
    planned = [point for point in detail["way"] if point["name"]]
    made = [
        {**{k: p[k] for k in ("name", "place", "hand_pose", "joint_positions")}, "phase": "closing"} for p in planned
    ]
    for point in made:
        point |= {"object_pose": [0, 0, 0, 1, 0, 0, 0], "contacts": [contact(2, hand=True)], "load": [0, 0, -1.5]}
    last = {**made[-1], "name": "pushes", "place": 3, "object_pose": [0, 0, 0.03, 1, 0, 0, 0]}
    asked: list[str] = []

    def answer(route: Any) -> None:
        asked.append(route.request.url)
        if len(asked) == 1:
            route.fulfill(status=503, json={"detail": "no engine here"})
        else:
            route.fulfill(json={"outcome": "held", "way": [*made, last]})

    page.route("**/replay", answer)
    page.goto(f"/grasps/{shard}/3")
    page.wait_for_selector(".viewer[data-state=ready]")
    box = "[data-toggle=physics]"
    page.click(box)
    page.wait_for_selector("text=No replay: no engine here")
    assert not page.is_checked(box)
    page.click(box)
    page.wait_for_selector("[data-balance]:not([hidden])")
    page.click("text=pushes")
    assert "the replay ends: held" in page.inner_text("[data-say]")
    rows = page.locator("[data-balance] tbody tr").all_inner_texts()
    told = {row.split("\t")[0]: row.split("\t")[1:] for row in rows}
    assert told["hand"] == ["0.00", "0.00", "2.00", "2.00"] and told["push"][2] == "-1.50"
    assert told["remaining"][2] == "0.50" and told["torque [N mm]"] == ["0.00", "1.00", "0.00", "1.00"]
    page.click("text=Copy link to this view")
    link = page.url
    assert link.endswith("contacts,physics") and ";3;" in link
    page.goto("/grasps")
    page.goto(link)
    page.wait_for_selector("[data-balance]:not([hidden])")
    until(lambda: page.get_attribute(".viewer input[type=range]", "aria-valuetext") == "pushes", "the view is back")
    assert len(page.watch.trouble) == 1 and "503" in page.watch.trouble.pop(), "the browser tells of the refusal"


#: Largest gzipped size of a page with its styles, scripts and figures, without models and fonts [bytes].
PAGE_BYTES = 150_000


def test_pages_with_3d_views_are_light(page: Any, services: Services) -> None:
    shard = finish_all(services, add_job(services))[0].shard_id
    answers: list[Any] = []
    page.on("response", lambda answer: answers.append(answer))
    for path in (f"/grasps/{shard}/0", "/grasps", "/submit", "/hands/shadow", "/objects"):
        answers.clear()
        page.goto(path)
        page.wait_for_selector("canvas:is([data-state=ready], [data-state=ready] *)")
        parts = [one for one in answers if one.request.resource_type in ("document", "script", "stylesheet")]
        assert len(parts) > 5 and sum(len(gzip.compress(one.body())) for one in parts) < PAGE_BYTES, path


def test_grasps_side_by_side_move_together(page: Any, services: Services) -> None:
    shard = finish_all(services, add_job(services))[0].shard_id
    page.goto("/grasps?view=table")
    for row in (0, 1):
        page.locator("input[name=grasp]").nth(row).check()
    page.click("button:has-text('Compare')")
    page.wait_for_url("**/grasps/compare?g=*,*")
    page.wait_for_selector("section:nth-child(2) .viewer[data-state=ready]")
    assert shard[:8] in page.inner_text("main")
    page.locator("[data-posture='2']").first.click()
    told = page.locator(".viewer input[type=range]")
    until(lambda: [one.get_attribute("aria-valuetext") for one in told.all()] == ["squeeze"] * 2, "both close")
