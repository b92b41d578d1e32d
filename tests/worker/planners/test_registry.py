"""The plug-in point: names, options, and planners of other packages."""

from __future__ import annotations

import os
import subprocess
import sys
from importlib import metadata
from importlib.metadata import EntryPoint
from pathlib import Path

import h5py
import pytest

from graspd.service.model.domain import FREE_ONLY_METHODS
from graspd.service.model.errors import InputError
from graspd.worker.planners import PLANNERS, method, method_names, planner
from graspd.worker.planners.port import Method


@pytest.mark.parametrize("name", sorted(PLANNERS))
def test_every_method_of_graspds_own_says_what_it_is_and_where_it_is_published(name: str) -> None:
    found = method(name)
    assert found.summary and found.source
    options = {name: "0" * 32 for name, field in found.options.model_fields.items() if field.is_required()}
    assert callable(planner(name, options, in_scenes=found.in_scenes))


def test_options_of_a_method_are_read_from_text() -> None:
    assert planner("autograsp", {"standoff_m": "0.01"}).options.standoff_m == 0.01  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": "9"}, "its options: standoff_m"),
        ({"standoff_m": "far"}, "standoff_m"),
        ({"standoff_m": -1}, "at least 0;"),
    ],
)
def test_a_wrong_option_is_refused_with_those_there_are(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        planner("autograsp", options)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("theirs", "graspd.baselines.autograsp.method:METHOD", None),
        ("theirs", "no.such.module:METHOD", "theirs"),
        ("theirs", "graspd.worker.planners:GROUP", "theirs"),
        ("fast_graspd", "graspd.baselines.autograsp.method:METHOD", None),
    ],
)
def test_entry_points_of_other_packages_are_methods_or_refused(monkeypatch, name, value, message: str | None) -> None:
    monkeypatch.setattr(metadata, "entry_points", lambda group: [EntryPoint(name, value, group)])
    assert name in method_names()
    if message is None:
        assert isinstance(method(name), Method)
    else:
        with pytest.raises(InputError, match=message):
            method(name)
    assert "Fast-Grasp'D" in method("fast_graspd").source, "nobody takes the name of a method of graspd's own"
    with pytest.raises(InputError, match=r"unknown method 'magic'.*fast_graspd"):
        method("magic")


def documented_example() -> str:
    page = (Path(__file__).parents[3] / "docs" / "how-to" / "planners.md").read_text()
    return page.split("```python\n", 1)[1].split("```", 1)[0]


def test_the_documented_package_runs_as_a_method(tmp_path: Path) -> None:
    """As installed: a module and its metadata beside each other on the path."""
    (tmp_path / "mine.py").write_text(documented_example())
    metadata = tmp_path / "mine-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 0.1\n")
    (metadata / "entry_points.txt").write_text("[graspd.planners]\nmine = mine:METHOD\n")
    out = tmp_path / "grasps.h5"
    command = [sys.executable, "-m", "graspd", "synth", "--hand", "barrett", "--object", "block", "-n", "2"]
    command += ["--method", "mine", "--option", "tries=2", "--threads", "1", "-o", str(out)]
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    with h5py.File(out) as file:
        assert file.attrs["method"] == "mine" and len(file["grasp/hand_pose"]) == 2


@pytest.mark.parametrize("name", sorted(PLANNERS))
def test_the_page_names_every_method_with_all_its_options_and_defaults(name: str) -> None:
    page = (Path(__file__).parents[3] / "docs" / "how-to" / "planners.md").read_text()
    row = next(line for line in page.splitlines() if line.startswith(f"| `{name}` | "))
    for option, field in method(name).options.model_fields.items():
        assert f"`{option}` ({'required' if field.is_required() else format(field.default, 'g')}" in row


@pytest.mark.parametrize("name", FREE_ONLY_METHODS)
def test_a_method_that_plans_around_free_objects_is_refused_in_scenes(name: str) -> None:
    with pytest.raises(InputError, match=f"{name} plans around free objects only; in scenes choose fast_graspd"):
        planner(name, in_scenes=True)
    assert callable(planner("fast_graspd", in_scenes=True))
