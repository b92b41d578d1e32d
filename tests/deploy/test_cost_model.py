"""The cost model and the simulated week: by hand on small numbers, and in step with docs/explanation/scaling.md."""

import re
from pathlib import Path

import pytest

from benchmarks.cost_model import Measured, Prices, Work, estimate, sizes, table
from benchmarks.week import CONTROLLER_TASKS_PER_S, HARSH, Rates, Told, Week, task_seconds
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.store.store import open_store
from tests.conftest import REPOSITORY
from tests.fakes import finish, request
from tests.service.conftest import services  # noqa: F401

PAGE = (REPOSITORY / "docs" / "explanation" / "scaling.md").read_text()
_CORE_S = {"core_s_per_grasp": 1.0, "core_s_per_scene": 10.0, "core_s_per_picture": 100.0, "busy": 0.5}
_BYTES = {"base_bytes_per_grasp": 1.0, "scene_bytes": 1000.0, "picture_bytes": 1e6, "manifest_bytes": 0.0}
_REDIS = {"redis_ops_per_task": 86_400.0, "redis_ops_worker": 1.0, "redis_ops_controller": 5.0}
ONE_OF_EACH = Measured(**_CORE_S, **_BYTES, **_REDIS)
_EVENTS = ("reclaimed_per_day", "killed_per_day", "cut_off_per_day", "zone_per_week", "controller_killed_per_day")
NOTHING = Rates(**dict.fromkeys((*_EVENTS, "redis_restarts_per_week", "store_outages_per_week"), 0))
DAY_S = 86_400.0


def test_the_model_is_the_sum_done_by_hand() -> None:
    # 64 grasps: 2 batches, 4 scenes, 4 x 3 x 2 = 24 pictures; (64 + 40 + 2400) / 0.5 = 5008 core s.
    found = estimate(Work(grasps=64, days=1.0, job=32), ONE_OF_EACH, Prices())
    assert (found.batches, found.tasks, found.jobs, found.pictures) == (2, 6, 2, 24)
    assert found.core_hours == pytest.approx(5008 / 3600) and found.cores == 1
    # 6 tasks in 86400 s at 86400 each, one worker, the controller.
    assert found.redis_ops_per_second == pytest.approx(6 + 1 + 5)
    assert found.gigabytes == pytest.approx((64 + 4 * 1000 + 24 * 1e6) / 1e9)
    assert (found.objects, found.index_rows) == (14, 64 + 12 + 2)
    prices = Prices(core_hour=3600.0, gb_month=0.0, thousand_writes=1000.0, thousand_reads=0.0, service_hour=1.0)
    found = estimate(Work(grasps=64, days=1.0, job=32), ONE_OF_EACH, prices)
    assert (found.money_compute, found.money_store, found.money_service) == pytest.approx((5008, 14, 24))
    assert found.money_per_million == pytest.approx((5008 + 14 + 24) / 64 * 1e6)


def test_the_page_shows_what_the_command_prints() -> None:
    shown = re.search(r"<!-- cost -->\n(.*?)\n<!-- /cost -->", PAGE, re.DOTALL)
    assert shown is not None
    works = [Work(grasps=count, scenes=2) for count in (10**6, 10**8)]
    assert shown[1] == table([estimate(work, Measured(), Prices()) for work in works])
    alone = estimate(Work(grasps=10**6, scenes=0), Measured(), Prices())
    assert f"(`--scenes 0`) take {alone.core_hours:.1f} core hours and {alone.gigabytes:.1f} GB" in PAGE


def test_the_inputs_on_the_page_are_those_of_the_model() -> None:
    inputs = Measured()
    assert f"| c_grasp | {inputs.core_s_per_grasp} core s |" in PAGE
    assert f"| c_picture | {inputs.core_s_per_picture} core s |" in PAGE
    assert f"| c_scene | {inputs.core_s_per_scene} core s |" in PAGE
    assert f"{inputs.base_bytes_per_grasp:,.0f} B, {inputs.scene_bytes:,.0f} B, {inputs.picture_bytes:,.0f} B" in PAGE
    assert f"tasks / time × {inputs.redis_ops_per_task:.0f} + workers × {inputs.redis_ops_worker:.0f}" in PAGE


def test_sizes_are_measured_on_a_data_folder(services: Services, tmp_path: Path) -> None:  # noqa: F811
    store = open_store((tmp_path / "store").as_uri())
    kept = Services(services.settings, store, services.index, services.queue)
    for entry in [*services.store.list("assets")]:
        store.put(entry.key, services.store.get(entry.key))
    with pytest.raises(SystemExit, match="no shard"):
        sizes(tmp_path)
    finish(kept, job_actions.submit(kept, request(grasps=64))[0].id)
    shards = list((tmp_path / "store" / "shards" / "base").glob("*.h5"))
    assert sizes(tmp_path)["base_bytes_per_grasp"] == sum(shard.stat().st_size for shard in shards) / 64


def test_every_page_gives_a_million_grasps_the_same_cost() -> None:
    hours = f"{estimate(Work(grasps=1_000_000), Measured(), Prices()).core_hours:,.0f}"
    pages = [REPOSITORY / "README.md", *sorted((REPOSITORY / "docs").rglob("*.md"))]
    hour = r"\b([\d,]+) core hours"
    cited = {
        (page.name, before or after)
        for page in pages
        for before, after in re.findall(
            rf"{hour}\s+for\s+a\s+million|\ba million\b[^|]{{0,90}}?{hour}", page.read_text()
        )
    }
    assert cited == {("figures.md", hours), ("million.md", hours)}
    first = re.search(r"\| core hours \| ([\d,.]+) \|", PAGE)
    assert first and f"{float(first[1].replace(',', '')):,.0f}" == hours


def week(rates: Rates, *, nodes: int = 50, days: float = 7.0, task_s: float = 60.0, seed: int = 1) -> Told:
    return Week(nodes=nodes, days=days, task_s=task_s, rates=rates, seed=seed).run()


def test_where_nothing_happens_all_time_is_work() -> None:
    told = week(NOTHING)
    assert (told.lost, told.interruptions, told.idle_s) == (0.0, {}, {})
    assert told.node_s == pytest.approx(50 * 7 * DAY_S)
    # The last task of each node is not done, and the first one was begun before.
    assert told.useful_s == pytest.approx(told.node_s, rel=1e-3)
    mean_s = told.useful_s / told.done
    assert mean_s == pytest.approx(60.0 * 2.718281828 ** (0.3**2 / 2), rel=0.01)


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("rates", [Rates(), HARSH])
def test_under_a_hundred_of_the_work_is_lost(rates: Rates, seed: int) -> None:
    told = week(rates, nodes=30, task_s=task_seconds(1), seed=seed)
    assert 0 < told.lost < 0.01
    assert told.failed_for_good < 1e-2
    assert told.controller_busy < 1 and 30 / task_seconds(1) < CONTROLLER_TASKS_PER_S
