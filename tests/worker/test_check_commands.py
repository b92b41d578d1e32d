"""`hands check` and `objects check`: the JSON contract and the exit codes."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import typer
from typer.testing import CliRunner, Result

from service.errors import InputError
from worker.hands.commands import check as check_hand
from worker.hands.commands import hand_options
from worker.objects.commands import check as check_object


def run(command: object, *arguments: str) -> Result:
    app = typer.Typer()
    app.command()(command)  # type: ignore[type-var]
    return CliRunner().invoke(app, list(arguments))


@pytest.mark.parametrize(("command", "name"), [(check_hand, "allegro"), (check_object, "block")])
def test_a_built_in_is_accepted_with_exit_code_0(command: object, name: str) -> None:
    result = run(command, name, "--json")
    report = json.loads(result.stdout.splitlines()[-1])
    assert result.exit_code == 0
    assert report["verdict"] == "accept" and report["repairs"] == [] and report["message"] and report["facts"]


@pytest.mark.parametrize("command", [check_hand, check_object])
def test_what_is_refused_exits_with_2_and_says_why(command: object, tmp_path: Path) -> None:
    empty = tmp_path / ("h.urdf" if command is check_hand else "o.stl")
    empty.write_bytes(b"")
    result = run(command, str(empty), "--json")
    report = json.loads(result.stdout.splitlines()[-1])
    assert result.exit_code == 2
    assert report["verdict"] == "refuse" and empty.name in report["message"]


def test_a_hand_option_on_the_command_line_goes_over_the_guess() -> None:
    report = json.loads(run(check_hand, "allegro", "--fix", "thumb_rotation=1.0", "--json").stdout)
    assert "thumb_rotation" not in report["facts"]["dofs"]


@pytest.mark.parametrize("text", ["1,2", "a,b,c", ""])
def test_an_approach_that_is_no_vector_is_refused(text: str) -> None:
    if not text:
        assert hand_options(palm=None, approach=text, root=None, fix=None, pre_shape=None) == {}
        return
    with pytest.raises(InputError, match="three numbers"):
        hand_options(palm=None, approach=text, root=None, fix=None, pre_shape=None)
