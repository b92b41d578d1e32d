"""Operations: the steps of docs/how-to/operations.md, alerts and dashboard; the cost model and the simulated week."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, Final

import promql_parser
import pytest
import yaml

from benchmarks.cost_model import Measured, Prices, Work, estimate, sizes, table
from benchmarks.week import CONTROLLER_TASKS_PER_S, HARSH, Rates, Told, Week, task_seconds
from docs.commands import Line
from graspd.doctor import all_checks
from graspd.service.index.index import Index
from graspd.service.index.rebuild import differences
from graspd.service.model.series import SERIES
from graspd.service.model.states import State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.identity import identify
from graspd.service.settings import Settings
from graspd.service.store.library import publish_builtins
from graspd.service.store.store import open_store
from tests.conftest import REPOSITORY
from tests.deploy import composition
from tests.fakes import finish, request
from tests.service.conftest import (
    service,
    services,  # noqa: F401
)
from tests.shell import completed

TEXT: Final = "\n".join((REPOSITORY / "docs" / "how-to" / page).read_text() for page in ("install.md", "operations.md"))
_TRIED: Final = re.compile(r"<!-- tried: ([\w-]+) -->\n```sh\n(.*?)```", re.DOTALL)


def run_block(name: str, folder: Path, environment: Mapping[str, str]) -> subprocess.CompletedProcess[str]:
    """Run a marked block as a user would, `graspd` being that of this environment; a failing line ends it."""
    shims = folder / "bin"
    shims.mkdir(exist_ok=True)
    shim = shims / "graspd"
    shim.write_text(f'#!/bin/sh\nexec {sys.executable} -m graspd "$@"\n')
    shim.chmod(0o755)
    return completed(
        ["bash", "-euo", "pipefail", "-c", dict(_TRIED.findall(TEXT))[name]],
        cwd=folder,
        env=os.environ | {"PATH": f"{shims}:{os.environ['PATH']}", "PYTHONPATH": str(REPOSITORY)} | dict(environment),
    )


@pytest.fixture
def kept(tmp_path: Path) -> Iterator[Services]:
    """A data folder with a finished job and one that has not begun."""
    for found in service(tmp_path / "data"):
        identify(found)
        publish_builtins(found.store)
        finish(found, job_actions.submit(found, request(grasps=64, scenes=1))[0].id)
        job_actions.submit(found, request(grasps=32, seed=5))
        yield found


def names_of(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def test_a_back_up_restored_elsewhere_gives_the_same_index(kept: Services, tmp_path: Path) -> None:
    data, fresh = kept.settings.data_dir, tmp_path / "new"
    (data / "keys.json").write_text("{}")
    (data / "store" / "shards" / "half-written.h5#123").write_bytes(b"half")
    where = {"GRASPD_DATA_DIR": str(data), "NEW_DATA_DIR": str(fresh)}
    for step in ("back-up", "restore"):
        done = run_block(step, tmp_path, where)
        assert done.returncode == 0, done.stderr
    assert names_of(fresh / "store") == names_of(data / "store") - {"shards/half-written.h5#123"}
    assert (fresh / "keys.json").exists()
    with closing(Index(Settings(data_dir=fresh).resolved_index_url)) as restored:
        assert differences(restored, kept.store) == []
        jobs = {job.id: job.state for job in restored.jobs.page(limit=10).items}
        assert jobs == {job.id: job.state for job in kept.index.jobs.page(limit=10).items}
        assert set(jobs.values()) == {State.SUCCEEDED, State.QUEUED}


def test_a_back_up_works_where_no_key_was_ever_made(kept: Services, tmp_path: Path) -> None:
    done = run_block("back-up", tmp_path, {"GRASPD_DATA_DIR": str(kept.settings.data_dir)})
    assert done.returncode == 0, done.stderr


def test_keys_are_made_rotated_limited_and_revoked(tmp_path: Path) -> None:
    done = run_block("keys", tmp_path, {"GRASPD_DATA_DIR": str(tmp_path / "data"), "COLUMNS": "200"})
    assert done.returncode == 0, done.stderr
    first, second = re.findall(r"^(gd_\S+)", done.stdout, re.MULTILINE)
    assert first != second
    assert first not in (tmp_path / "data" / "keys.json").read_text()


def test_every_profile_service_and_variant_on_the_page_exists() -> None:
    profiles = {name for service in composition.SERVICES.values() for name in service.get("profiles", ())}
    assert set(re.findall(r"--profile (\S+)", TEXT)) <= profiles
    assert set(re.findall(r"--scale ([\w-]+)=", TEXT)) <= composition.SERVICES.keys()
    for variant in re.findall(r"apply -k (\S+)", TEXT):
        assert (REPOSITORY / variant / "kustomization.yaml").is_file()


FOLDER = REPOSITORY / "docker" / "monitoring"
RULES = [rule for group in yaml.safe_load((FOLDER / "alerts.yaml").read_text())["groups"] for rule in group["rules"]]
PANELS = [one for one in json.loads((FOLDER / "grafana.json").read_text())["panels"] if one["type"] != "row"]
PAGE = (REPOSITORY / "docs" / "reference" / "metrics.md").read_text()
#: Labels that Prometheus adds, and that of the bounds of a histogram.
ADDED = {"instance", "job", "le"}


def expressions() -> list[tuple[str, str]]:
    of_panels = [(panel["title"], target["expr"]) for panel in PANELS for target in panel["targets"]]
    return [*((rule["alert"], rule["expr"]) for rule in RULES), *of_panels]


def nodes(node: Any) -> Iterator[Any]:
    yield node
    for name in ("lhs", "rhs", "expr", "vector_selector", "param"):
        if (inner := getattr(node, name, None)) is not None:
            yield from nodes(inner)
    for inner in getattr(node, "args", None) or ():
        yield from nodes(inner)


def parsed(expression: str) -> Any:
    return promql_parser.parse(expression.replace("$__rate_interval", "5m"))


@pytest.mark.parametrize(("who", "expression"), expressions(), ids=lambda text: text[:40])
def test_series_and_labels_exist_and_rates_are_of_counters(who: str, expression: str) -> None:
    asked: set[str] = set()
    for node in nodes(parsed(expression)):
        if isinstance(node, promql_parser.Call) and node.func.name in ("rate", "increase"):
            (of,) = node.args
            series = SERIES[re.sub(r"_(bucket|sum|count)$", "", of.vector_selector.name)]
            assert series.kind in ("counter", "histogram"), f"{who}: {series.name}"
        if not isinstance(node, promql_parser.VectorSelector) or node.name == "up":
            continue
        series = SERIES.get(node.name) or SERIES[re.sub(r"_(bucket|sum|count)$", "", node.name)]
        assert (series.kind == "histogram") is node.name.endswith(("_bucket", "_sum", "_count"))
        matched = {matcher.name for matcher in node.matchers.matchers}
        assert matched <= {*series.labels, *ADDED}, f"{who}: {node.name}"
        asked |= {*series.labels, *ADDED}
    for labels in re.findall(r"\b(?:by|without|on) \(([^)]*)\)", expression):
        assert {label.strip() for label in labels.split(",") if label.strip()} <= asked, f"{who}: {labels}"


@pytest.mark.parametrize("rule", RULES, ids=lambda rule: rule["alert"])
def test_an_alert_says_what_it_means_and_the_mend(rule: dict[str, Any]) -> None:
    assert rule["labels"]["severity"] in ("page", "ticket")
    assert {"summary", "description", "fix"} <= rule["annotations"].keys()
    assert f"| `{rule['alert']}` | {rule['labels']['severity']} |" in PAGE
    fix = rule["annotations"]["fix"]
    named = re.findall(r"\bgraspd [a-z][^;,]*", fix)
    assert not any(faults := [Line("alerts.yaml", one).fault() for one in named]), faults
    checks = {check.name for check in all_checks(Settings())}
    for only in re.findall(r"--only (\S+)", fix):
        assert set(only.rstrip(";").split(",")) <= checks
    labels = set(re.findall(r"\$labels\.(\w+)", str(rule["annotations"])))
    by = {word.strip() for found in re.findall(r"by \(([^)]*)\)", rule["expr"]) for word in found.split(",")}
    assert labels <= by, "a label that the expression has dropped would be shown empty"


def test_every_alert_is_tried_firing_and_silent() -> None:
    tests = yaml.safe_load((FOLDER / "alerts_test.yaml").read_text())["tests"]
    silent = {one["alertname"] for one in tests[0]["alert_rule_test"]}
    firing = {name for one in tests[1]["promql_expr_test"] for name in re.findall(r'alertname="(\w+)"', one["expr"])}
    assert silent == firing == {rule["alert"] for rule in RULES}


def test_promtool_agrees() -> None:
    promtool = shutil.which("promtool")
    if promtool is None:
        pytest.skip("no promtool on the PATH (package `prometheus` of Debian)")
    done = completed([promtool, "test", "rules", str(FOLDER / "alerts_test.yaml")])
    assert done.returncode == 0, done.stdout + done.stderr


def test_panels_do_not_overlap() -> None:
    taken: set[tuple[int, int]] = set()
    for panel in json.loads((FOLDER / "grafana.json").read_text())["panels"]:
        at = panel["gridPos"]
        cells = {(x, y) for x in range(at["x"], at["x"] + at["w"]) for y in range(at["y"], at["y"] + at["h"])}
        assert at["x"] + at["w"] <= 24
        assert not cells & taken, panel["title"]
        taken |= cells


def test_the_dashboard_has_every_series_and_is_what_its_script_writes(tmp_path: Path) -> None:
    drawn = " ".join(expression for _, expression in expressions())
    assert {name for name in SERIES if name not in drawn} == set()
    shutil.copy(FOLDER / "dashboard.py", tmp_path)
    subprocess.run([sys.executable, tmp_path / "dashboard.py"], check=True)
    assert (tmp_path / "grafana.json").read_text() == (FOLDER / "grafana.json").read_text()


SCALING = (REPOSITORY / "docs" / "explanation" / "scaling.md").read_text()
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
    shown = re.search(r"<!-- cost -->\n(.*?)\n<!-- /cost -->", SCALING, re.DOTALL)
    assert shown is not None
    works = [Work(grasps=count, scenes=2) for count in (10**6, 10**8)]
    assert shown[1] == table([estimate(work, Measured(), Prices()) for work in works])
    alone = estimate(Work(grasps=10**6, scenes=0), Measured(), Prices())
    assert f"(`--scenes 0`) take {alone.core_hours:.1f} core hours and {alone.gigabytes:.1f} GB" in SCALING


def test_the_inputs_on_the_page_are_those_of_the_model() -> None:
    inputs = Measured()
    assert f"| c_grasp | {inputs.core_s_per_grasp} core s |" in SCALING
    assert f"| c_picture | {inputs.core_s_per_picture} core s |" in SCALING
    assert f"| c_scene | {inputs.core_s_per_scene} core s |" in SCALING
    assert (
        f"{inputs.base_bytes_per_grasp:,.0f} B, {inputs.scene_bytes:,.0f} B, {inputs.picture_bytes:,.0f} B" in SCALING
    )
    assert f"tasks / time × {inputs.redis_ops_per_task:.0f} + workers × {inputs.redis_ops_worker:.0f}" in SCALING


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
    first = re.search(r"\| core hours \| ([\d,.]+) \|", SCALING)
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
