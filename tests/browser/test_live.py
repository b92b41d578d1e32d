"""The pages in a real browser: they move by themselves, fit every screen, read without scripts, are accessible."""

import re
import time
from itertools import product
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from graspd.service.model.planning import plan_tasks
from graspd.service.model.states import State
from graspd.service.pipeline import deletion, tagging
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.queue.port import rq_id
from graspd.service.store.records import publish_record
from tests.api.dashboard.test_tradeoff import RUNS, a_record
from tests.api.factories import add_job, add_worker, fail, finish, finish_all
from tests.fakes import beat_of, plan_all, record_of
from tests.waiting import until

pytestmark = pytest.mark.browser
AXE = Path(__file__).parent / "vendor" / "axe.min.js"
#: Rules of axe that look at colours; what is serious of the others is so in every scheme.
COLOURS = ["color-contrast", "link-in-text-block"]
#: Pages that show all colours between them.
IN_DARK = re.compile(
    r"/$|/datasets/kitchen$|/jobs|/objects|/search|/hands|/grasps$|/grasps/|/hands/|/stability|/chart|/submit|/problems|/engine|/notifications"
)
#: Pages that are looked at by axe at all widths, too.
NARROW = re.compile(r"/$|/jobs|/objects|/hands|/search|/grasps|/compare")
WHY = {
    "outcomes": {"slipped": 70, "penetration": 12},
    "planner_seconds": 9.0,
    "log": "12:00:00.000 INFO progress 0% starts",
}
CHART = {"created": "2026-11-21T12:00:00Z", "device": "cpu", "runs": RUNS}


@pytest.fixture
def places(services: Services) -> list[str]:
    """Addresses of every page, over a service in which something of everything has happened."""
    # A list of few grasps has what one of many has, and is looked at sooner.
    record = add_job(services, grasps=6, scenes=1, views=2, stereo=True)
    shard = finish_all(services, record)[0].shard_id
    fail(services, failed := add_job(services, seed=9), "a reason " * 30)
    few = add_job(services, grasps=6, seed=12)
    finish(services, few, next(plan_tasks(few)), **WHY)
    waiting = add_job(services, seed=10)
    add_worker(services, "worker-1", "idle")
    wanted = DatasetRequest.model_validate({"name": "kitchen", "hands": ["allegro"], "objects": ["mug", "block"]})
    actions.create(services, wanted)
    publish_record(services.store, "charts", CHART)
    publish_record(services.store, "stability", a_record())
    tagging.tag_grasps(services, "good ones", [(shard, 0), (shard, 1)], project="", owner="", permit=lambda _: None)
    gone = add_job(services, seed=11)
    fail(services, gone, "a reason")
    deletion.delete_job(services, gone.id)
    datasets = "/ /datasets /datasets/kitchen /datasets/kitchen?state=queued /compare?one=kitchen&other=kitchen /engine"
    finding = "/jobs /jobs?q=none /jobs?state=failed /objects /objects/mug /search?q=mug"
    grasps = "/grasps /grasps?view=table /grasps?min_epsilon=99 /grasps?tag=good+ones /hands /hands/shadow"
    others = (
        "/docs /workers /chart /stability /submit /submit?density=400 /notifications /problems /login /deleted /usage"
    )
    side_by_side = f"/grasps/compare?g={shard[:12]}.0,{shard[:12]}.1"
    tasks = [f"/jobs/{job.id}/tasks/{next(plan_tasks(job)).id}" for job in (few, failed, waiting)]
    of_these = [
        *(f"/jobs/{job.id}" for job in (record, few, failed, waiting)),
        *tasks,
        f"/grasps/{shard}/0",
        side_by_side,
        "/grasps?view=map",
    ]
    return [*datasets.split(), *of_these, *finding.split(), *grasps.split(), *others.split()]


def test_a_job_page_follows_its_job_without_a_reload(page: Any, services: Services) -> None:
    record = add_job(services, scenes=1, views=1)
    tasks = list(plan_tasks(record))
    page.goto(f"/jobs/{record.id}")
    page.evaluate("window.stayed = true")
    page.wait_for_selector("#head .queued")
    finish(services, record, tasks[0])
    page.wait_for_selector("#best .grasp")
    for task in tasks[1:]:
        finish(services, record, task)
    page.wait_for_selector("#head .succeeded")
    page.wait_for_selector("#views img")
    assert page.evaluate("window.stayed") is True


def test_chosen_cells_stay_chosen_while_the_matrix_moves(page: Any, services: Services) -> None:
    page.goto("/datasets")
    page.check("input[value='allegro|mug']")
    finish_all(services, add_job(services))
    page.wait_for_selector("td.succeeded")
    assert page.is_checked("input[value='allegro|mug']")
    assert page.inner_text("[data-chosen]") == "1 cell selected"


def test_a_column_stays_chosen_while_its_head_has_the_focus(page: Any, services: Services) -> None:
    page.goto("/datasets")
    page.click("thead button:has-text('allegro')")
    finish_all(services, add_job(services, seed=21))
    page.wait_for_selector("td.succeeded")
    until(lambda: page.locator("input[name=cell]:checked").count() == 3, "the cells are chosen again")


def test_a_press_on_a_head_takes_and_submits_the_column(page: Any) -> None:
    page.goto("/datasets")
    page.click("thead button:has-text('allegro')")
    assert page.inner_text("[data-chosen]") == "3 cells selected"
    page.click(".act button[value=submit]")
    page.wait_for_selector("text=3 jobs submitted")
    assert page.locator("td.queued").count() == 3


def test_a_filter_takes_effect_at_once_and_stands_in_the_address(page: Any, services: Services) -> None:
    finish_all(services, add_job(services, grasps=96))
    page.goto("/grasps?view=table")
    page.evaluate("window.stayed = true")
    page.click("#facets a:has-text('rejected')")
    page.wait_for_selector("#found .badge:has-text('rejected')")
    page.wait_for_url("**/grasps?view=table&valid=false")
    until(lambda: page.locator("#found .badge:has-text('valid')").count() == 0, "the others are gone")
    assert page.evaluate("window.stayed") is True


def test_a_press_on_a_bar_shows_the_grasps_in_it(page: Any, services: Services) -> None:
    finish_all(services, record := add_job(services))
    page.goto(f"/jobs/{record.id}")
    bar = page.locator("svg.hist a").first
    count = int(bar.get_attribute("aria-label").split()[0])
    page.goto(bar.get_attribute("href") + "&view=table")
    assert page.locator("#found tbody tr").count() == count


def test_maps_that_are_published_appear_and_say_what_a_cell_is(page: Any, services: Services) -> None:
    page.clock.install()
    page.goto("/stability")
    page.wait_for_selector("text=No measurements yet")
    publish_record(services.store, "stability", a_record())
    # The page's clock moves on by as long as it waits between two looks at what no event tells of.
    page.clock.fast_forward(1000 * int(page.get_attribute("body", "data-poll")))
    page.wait_for_selector(".cells td.broken")
    said = page.locator("#stiffness .cells td.broken").first.get_attribute("title")
    assert said == "stiffness [N/m] 1e4, time step [s] 0.01: broken; note 4"


def test_the_bound_of_theory_lies_over_its_cells_at_every_width(page: Any, services: Services) -> None:
    publish_record(services.store, "stability", a_record())
    for width in (390, 1440):
        page.set_viewport_size({"width": width, "height": 800})
        page.goto("/stability")
        line, last = (
            page.locator(f"#stiffness {part}").bounding_box()
            for part in (".bound", "tbody tr:last-child td:last-child")
        )
        # Half of a cell's gap, rounded.
        assert abs(line["x"] + line["width"] - (last["x"] + last["width"])) <= 2
        assert abs(line["y"] + line["height"] - (last["y"] + last["height"])) <= 2


#: What is wider than its card, and not within a part of it that scrolls or is cut off on purpose.
BESIDE_CARDS = """() => [...document.querySelectorAll('.card')].flatMap(card => {
    const box = card.getBoundingClientRect();
    const held = one => getComputedStyle(one).overflowX !== 'visible' || (one !== card && held(one.parentElement));
    return [...card.querySelectorAll('*')].filter(one => {
        const { left, right, width, height } = one.getBoundingClientRect();
        return width && height && (right > box.right + 1 || left < box.left - 1) && !held(one.parentElement);
    }).map(one => `${card.className}: ${one.outerHTML.slice(0, 80)}`);
})"""
#: Tables that a phone shows as lines: nothing of them is cut off.
TABLES_OF_LINES = ("/", "/jobs", "/problems", "/deleted", "/notifications")


def test_a_phone_shows_all_of_short_tables(page: Any, places: list[str]) -> None:
    assert set(TABLES_OF_LINES) <= set(places)
    page.set_viewport_size({"width": 390, "height": 800})
    for path in TABLES_OF_LINES:
        page.goto(path)
        tables = "[...document.querySelectorAll('table')].map(one => [one.scrollWidth, one.parentElement.clientWidth])"
        sizes = page.evaluate(tables)
        assert sizes and all(inner <= outer for inner, outer in sizes), (path, sizes)


def test_no_page_scrolls_sideways(page: Any, places: list[str]) -> None:
    for path in places:
        page.goto(path)
        for width in (390, 1440):
            page.set_viewport_size({"width": width, "height": 800})
            page.wait_for_function("width => window.innerWidth === width", arg=width)
            # Charts are drawn anew at the resize that the browser tells of before its second frame from here.
            page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
            assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), (path, width)
            # A card that holds its content on a phone holds it on a screen.
            assert width > 390 or page.evaluate(BESIDE_CARDS) == [], path


def _nodes(finding: dict[str, Any]) -> list[str]:
    """HTML of a finding's nodes, without the buttons that Swagger UI nests."""
    nested = finding["id"] == "nested-interactive"
    html = [node["html"][:160] for node in finding["nodes"]]
    return [one for one in html if not (nested and "opblock-summary-control" in one)]


def test_no_page_has_a_serious_accessibility_finding(page: Any, places: list[str]) -> None:
    page.emulate_media(reduced_motion="reduce")
    found = []
    for path in places:
        page.goto(path)
        if path == "/docs":
            page.wait_for_selector("#explorer .opblock")
        page.evaluate(AXE.read_text())
        # Colours are the same variables on all pages: some show them all.
        dark = [("dark", f"{{ runOnly: {COLOURS} }}")] if IN_DARK.match(path) else []
        narrow = (
            [(width, *one) for width in (1024, 390) for one in (("light", "{}"), *dark)] if NARROW.match(path) else []
        )
        for width, scheme, rules in [(1440, "light", "{}"), *((1440, *one) for one in dark), *narrow]:
            page.set_viewport_size({"width": width, "height": 900})
            page.emulate_media(color_scheme=scheme)
            result = page.evaluate(f"axe.run(document, {{ resultTypes: ['violations'], ...{rules} }})")
            found += [
                f"{path}, {scheme}, {width}: {entry['id']}: {nodes[:3]}"
                for entry in result["violations"]
                if entry["impact"] in ("serious", "critical") and (nodes := _nodes(entry))
            ]
    assert found == []


def test_forms_and_notices_are_accessible_at_every_width(page: Any, services: Services, places: list[str]) -> None:
    record = add_job(services, seed=12)
    task = next(plan_tasks(record)).id
    services.index.live.set_workers([beat_of("worker-2", state="busy", task_id=task)], forget_before="2000")
    services.index.live.set_running({task: "worker-2"})
    page.emulate_media(reduced_motion="reduce")
    opened = "document.querySelectorAll('details').forEach(one => one.open = true)"
    for path in ("/submit?density=400", "/notifications", "/engine", "/workers", "/deleted", f"/jobs/{record.id}"):
        page.goto(path)
        if path.startswith("/jobs/"):
            page.click("button:has-text('Cancel')")
            page.wait_for_selector(".toast:has-text('The job is cancelled')")
        page.evaluate(f"{opened}; {AXE.read_text()}")
        for width, scheme in product((1440, 1024, 390), ("light", "dark")):
            page.set_viewport_size({"width": width, "height": 800})
            page.emulate_media(color_scheme=scheme)
            result = page.evaluate("axe.run(document, { resultTypes: ['violations'] })")
            assert [(one["id"], _nodes(one)[:3]) for one in result["violations"]] == [], (path, width, scheme)
            assert page.evaluate("document.documentElement.scrollWidth <= window.innerWidth"), (path, width)
            assert width > 390 or page.evaluate(BESIDE_CARDS) == [], path


def _text_of(page: Any, path: str) -> str:
    page.goto(path)
    return str(page.inner_text("main"))


def test_every_page_reads_without_javascript(address: str, page: Any, places: list[str]) -> None:
    context = page.context.browser.new_context(java_script_enabled=False, base_url=address)
    # Each in a page of its own: without JavaScript pages load themselves again, which ends the way to another one.
    texts = {path: _text_of(context.new_page(), path) for path in places}
    context.close()
    assert all(len(text) > 40 for text in texts.values())
    told = {"/grasps/": "Penetration", "/grasps": "allegro × mug", "/datasets": "kitchen", "/chart": "standard"}
    for start, words in (told | {"/hands/": "Save as a new hand", "/stability": "hands sink in"}).items():
        assert words in next(text for path, text in texts.items() if path.startswith(start))


def test_a_dataset_is_deleted_by_its_name_and_comes_back(page: Any, services: Services) -> None:
    """One press asks; what protects it is said; the press after that can be taken back."""
    wanted = DatasetRequest.model_validate({"name": "kitchen", "hands": ["allegro"], "objects": ["mug"]})
    actions.create(services, wanted)
    plan_all(services)
    finish_all(services, record_of(services, services.index.jobs.page().items[0].id))
    actions.take_snapshot(services, "kitchen")
    page.goto("/datasets/kitchen")
    page.click("button:has-text('Delete')")
    dialog = page.get_by_role("dialog")
    assert "32 grasps" in dialog.inner_text() and "Delete its snapshots too" in dialog.inner_text()
    dialog.get_by_role("button", name="Delete").click()
    assert dialog.is_visible(), "the browser asks for the name and the snapshots"
    dialog.get_by_role("button", name="Keep it").click()
    assert dialog.is_hidden()
    page.click("button:has-text('Delete')")
    dialog.get_by_role("textbox").fill("kitchen")
    dialog.get_by_role("checkbox").check()
    dialog.get_by_role("button", name="Delete").click()
    page.wait_for_selector("text=The dataset kitchen is deleted.")
    assert services.index.datasets.page().items == []
    page.click("button:has-text('Undo')")
    page.wait_for_url("**/datasets/kitchen")
    assert "Snapshots" in page.inner_text("main")
    assert services.index.datasets.get("kitchen").grasps == 32


def test_grasps_are_chosen_tagged_found_and_exported_by_keyboard(page: Any, services: Services) -> None:
    finish_all(services, add_job(services))
    page.goto("/grasps?view=table")
    assert page.is_disabled("button:has-text('Export')")
    boxes = page.locator("input[name=grasp]")
    for row in (0, 2):
        boxes.nth(row).focus()
        page.keyboard.press("Space")
    assert page.inner_text("[data-chosen]") == "2 grasps selected"
    page.fill("form.choose input[name=tag]", "good")
    page.keyboard.press("Tab")
    page.keyboard.press("Enter")
    page.wait_for_selector("text=2 grasps tagged good.")
    page.click("#facets a:has-text('good')")
    page.wait_for_url("**tag=good**")
    page.wait_for_selector("#found .tag-head")
    assert boxes.count() == 2
    page.check("input[name=all]")
    page.select_option("[name=format]", "csv")
    with page.expect_download() as download:
        page.click("button:has-text('Export')")
    assert Path(download.value.path()).read_text().count("\n") == 3
    page.fill("#where", "epsilon > 1000")
    page.keyboard.press("Enter")
    page.wait_for_selector("text=No grasp matches these filters")


class Hand:
    """Clicks of a user; `seconds` is their time with the answers of the pages."""

    def __init__(self, page: Any) -> None:
        self.page, self.clicks, self._start = page, 0, time.monotonic()

    def click(self, where: str) -> None:
        self.clicks += 1
        self.page.click(where)

    @property
    def seconds(self) -> float:
        return time.monotonic() - self._start


def test_fifty_queued_jobs_are_cancelled_in_four_clicks(page: Any, services: Services, record_property: Any) -> None:
    jobs = [add_job(services, seed=seed).id for seed in range(50)]
    finish_all(services, done := add_job(services, seed=50))
    page.goto("/")
    hand = Hand(page)
    hand.click("nav >> text=Jobs")
    hand.click("#found nav >> text=queued")
    hand.click("[data-every]")
    assert page.inner_text("[data-chosen]") == "50 jobs selected"
    hand.click("#list button:has-text('Cancel')")
    page.wait_for_selector("text=50 jobs cancelled.")
    record_property("seconds", hand.seconds)
    assert hand.clicks <= 4
    assert {services.index.jobs.get(job).state for job in jobs} == {State.CANCELLED}
    assert services.index.jobs.get(done.id).state is State.SUCCEEDED


def test_why_a_job_found_little_is_seen_in_three_clicks(page: Any, services: Services, record_property: Any) -> None:
    for seed in range(30):
        add_job(services, seed=seed)
    job = add_job(services, hand="barrett")
    finish(services, job, next(plan_tasks(job)), **WHY)
    add_job(services, seed=40)
    page.goto("/")
    hand = Hand(page)
    hand.click("nav >> text=Jobs")
    page.fill("#q", "barrett")
    page.wait_for_url("**q=barrett**")
    hand.click("#list a.main")
    page.wait_for_selector("#follow .meter")
    record_property("seconds", hand.seconds)
    first = page.inner_text("#follow .meter >> nth=0").split("\n")
    assert "slipped" in first[0] and "70" in "".join(first[:3])
    assert page.locator("#follow .meter").first.bounding_box()["y"] < 900, "without scrolling"
    hand.click("#tasks a.main")
    page.wait_for_selector("text=progress 0% starts")
    assert hand.clicks <= 3


def test_a_view_of_the_list_is_saved_shown_and_removed(page: Any, services: Services) -> None:
    fail(services, add_job(services), "a reason")
    page.goto("/jobs?state=failed&q=mug")
    page.fill("[name=view]", "my failures")
    page.keyboard.press("Enter")
    page.goto("/jobs")
    page.click("#view-names >> text=my failures")
    page.wait_for_url("**/jobs?state=failed&q=mug")
    assert page.get_attribute("#view-names a", "aria-current") == "true"
    page.fill("[name=view]", "my failures")
    page.click("text=Save this view")
    assert page.locator("#view-names a").count() == 0


def test_a_log_grows_on_the_page_of_its_task(page: Any, services: Services) -> None:
    job = add_job(services)
    task = next(plan_tasks(job))
    page.goto(f"/jobs/{job.id}/tasks/{task.id}")
    page.wait_for_selector("text=The log appears when a worker starts the task.")
    services.queue.put_task_log(rq_id(task.id, 1), "it rolls")
    services.index.live.set_running({task.id: "worker-1"})
    page.wait_for_selector("text=it rolls")
    finish(services, job, task, log="it rolls\nit is done")
    page.wait_for_selector("text=it is done")


def test_the_keyboard_leads_everywhere(page: Any, services: Services) -> None:
    job = add_job(services, hand="barrett")
    page.goto("/")
    page.keyboard.press("Control+k")
    page.keyboard.type(job.id[:7])
    page.wait_for_selector(f"#palette a[href='/jobs/{job.id}']")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    page.wait_for_url(f"**/jobs/{job.id}")
    page.keyboard.press("o")
    page.wait_for_url("**/objects")
    page.keyboard.press("j")
    page.wait_for_url("**/jobs")
    page.keyboard.press("/")
    page.keyboard.type("jog")
    assert page.input_value("#q") == "jog", "keys in a field are text"
    page.locator("h1").click()
    page.locator("#q").blur()
    page.keyboard.press("?")
    page.wait_for_selector("text=Keyboard shortcuts")
    page.uncheck("#single-keys")
    page.keyboard.press("Escape")
    page.keyboard.press("d")
    page.keyboard.press("?")
    assert page.locator("#keys").is_hidden() and "/jobs" in page.url, "they can be switched off"


@pytest.mark.parametrize(("scheme", "dark"), [("light", False), ("dark", True)])
def test_a_route_is_opened_and_tried(page: Any, scheme: str, dark: bool) -> None:
    hosts = set()
    page.on("request", lambda request: hosts.add(urlsplit(request.url).netloc))
    page.emulate_media(color_scheme=scheme)
    page.goto("/docs")
    page.locator("#explorer .opblock").first.wait_for()
    assert page.evaluate("document.documentElement.classList.contains('dark-mode')") is dark
    stats = page.locator("#explorer .opblock", has_text="/v1/stats")
    stats.locator(".opblock-summary-control").click()
    stats.get_by_role("button", name="Try it out").click()
    stats.get_by_role("button", name="Execute").click()
    answer = stats.locator(".live-responses-table td.response-col_status:not(.col_header)")
    answer.wait_for()
    assert answer.inner_text().split()[0] == "200"
    assert len({host for host in hosts if host}) == 1
