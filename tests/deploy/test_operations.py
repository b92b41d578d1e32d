"""Operations: the steps of docs/how-to/operations.md as they stand there; alerts and dashboard."""

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
from tests.conftest import REPOSITORY
from tests.deploy import composition
from tests.fakes import finish, request
from tests.service.conftest import service
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
    for services in service(tmp_path / "data"):
        identify(services)
        publish_builtins(services.store)
        finish(services, job_actions.submit(services, request(grasps=64, scenes=1))[0].id)
        job_actions.submit(services, request(grasps=32, seed=5))
        yield services


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
