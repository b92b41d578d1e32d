"""The API is light: it loads no engine."""

from __future__ import annotations

import subprocess
import sys
from functools import cache

import pytest

HEAVY = ("warp", "newton", "trimesh", "mujoco", "scipy", "yourdfpy", "graspd.worker")


@cache
def modules_after(statement: str) -> frozenset[str]:
    """Libraries by their names, and graspd's own packages."""
    code = f"{statement}\nimport sys\nprint(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    parts = (name.split(".") for name in done.stdout.split())
    return frozenset(".".join(part[:2]) if part[0] == "graspd" else part[0] for part in parts)


@pytest.mark.parametrize(
    "statement", ["import graspd.api.app", "import graspd.client.commands", "import graspd.client.client"]
)
def test_the_front_door_imports_no_engine(statement: str) -> None:
    assert modules_after(statement).isdisjoint(HEAVY)


@pytest.mark.parametrize("statement", ["import graspd.client.commands", "import graspd.client.dataset_commands"])
def test_a_command_line_needs_no_templates_and_no_server(statement: str) -> None:
    assert modules_after(statement).isdisjoint({"jinja2", "uvicorn", "graspd.worker"})


def test_commands_that_talk_http_need_no_web_framework_and_no_database() -> None:
    modules = ("client", "commands", "add_commands", "dataset_commands", "access_commands", "tag_commands")
    statement = "import " + ", ".join(f"graspd.client.{module}" for module in modules)
    assert modules_after(statement).isdisjoint({"fastapi", "starlette", "sqlalchemy", "redis"})


OVERVIEW = """
import contextlib, io, sys
import graspd.cli
sys.argv = ["graspd", "--help"]
with contextlib.redirect_stdout(io.StringIO()), contextlib.suppress(SystemExit):
    graspd.cli.main()
"""


def test_the_overview_of_commands_imports_no_room() -> None:
    assert modules_after(OVERVIEW).isdisjoint({*HEAVY, "fastapi", "sqlalchemy", "h5py", "numpy"})
