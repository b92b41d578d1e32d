"""Alerts and dashboard: every series, label and command in them exists; promtool tries when alerts fire."""

import json
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import promql_parser
import pytest
import yaml

from docs.commands import Line
from graspd.doctor import all_checks
from graspd.service.model.series import SERIES
from graspd.service.settings import Settings
from tests.conftest import REPOSITORY
from tests.shell import completed

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


def test_the_dashboard_is_what_its_script_writes(tmp_path: Path) -> None:
    shutil.copy(FOLDER / "dashboard.py", tmp_path)
    subprocess.run([sys.executable, tmp_path / "dashboard.py"], check=True)
    assert (tmp_path / "grafana.json").read_text() == (FOLDER / "grafana.json").read_text()


def test_panels_do_not_overlap() -> None:
    taken: set[tuple[int, int]] = set()
    for panel in json.loads((FOLDER / "grafana.json").read_text())["panels"]:
        at = panel["gridPos"]
        cells = {(x, y) for x in range(at["x"], at["x"] + at["w"]) for y in range(at["y"], at["y"] + at["h"])}
        assert at["x"] + at["w"] <= 24
        assert not cells & taken, panel["title"]
        taken |= cells


def test_every_series_is_on_the_dashboard() -> None:
    drawn = " ".join(expression for _, expression in expressions())
    assert {name for name in SERIES if name not in drawn} == set()
