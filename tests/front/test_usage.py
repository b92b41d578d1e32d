"""Help shows each word that a command declares; what cannot be understood is one line with the word that was meant."""

import inspect
import os
import re
import sys
from collections.abc import Iterator
from typing import Any

import pytest
from typer.testing import CliRunner

import graspd.cli
from graspd.cli import build_app
from tests.shell import completed

OFFERED = {"": "synth", "admin ker": "kernels", "admin index re": "rebuild", "datasets cr": "create"}
OFFERED |= {"export --for": "--format", "datasets card --li": "--licence"}
#: Of a number that is no count: its unit, or the word of one without.
UNIT = re.compile(r"\[\w+\]|\b(mm|kg|kg/m3|metres|coefficient|share|candidates)\b", re.IGNORECASE)


@pytest.mark.parametrize(
    ("command", "line"),
    [
        ("store verify", "no such command store; did you mean restore?"),
        ("admin stor", "no such command stor; did you mean store?"),
        ("jbos", "no such command jbos; did you mean jobs?"),
        ("datasets lst", "no such command lst; did you mean list?"),
        ("submit --handd allegro", "there is no option --handd; did you mean --hand?"),
        ("submit", "missing option --hand; see `graspd submit --help`"),
        ("submit --hand", "option --hand requires an argument"),
        ("submit --hand allegro --object mug -n 0", "--grasps: must be at least 1"),
        ("submit --hand x --object y --grasps many", "--grasps: must be a whole number; see `graspd submit --help`"),
        (
            "jobs --state runing",  # codespell:ignore runing
            "--state: must be one of queued, running, succeeded, failed, cancelled; did you mean running?",
        ),
        ("export x.h5 --format mjcf -o out", "there is no export format 'mjcf'"),
        ("export x.h5 --depth tiff -o out", "there is no depth format 'tiff'"),
        ("datasets card ./x --snapshot 0f -o out", "./x is a folder; --snapshot goes with the name of a dataset"),
        ("doctor --only disk,weather", "there is no check weather; choose from disk"),
        ("evaluate g.h5 --robust 2 --protocol displacement", "--robust repeats pushes or lifts in perturbed models"),
        ("evaluate g.h5 --robust 2 -o none/g.h5", "none/g.h5 cannot be written: choose a file in an existing folder"),
        ("evaluate g.json --robust 2 -o g.h5", "g.json is no shard of graspd"),
        ("objects add notes.txt --scale-to 0.1,0.2", "several sizes need a mesh file or a folder of meshes"),
        ("worker --workers 2 --once --stages none", "--burst, --once and --max-tasks are for a single worker"),
        ("hands check allegro --closing ja=2", "--closing ja=2 must be -1, 0 or 1"),
        ("hands check allegro --closing ja", "--closing 'ja' must be JOINT=VALUE with a number"),
        ("hands check allegro --xacro x", "--xacro 'x' must be NAME=VALUE"),
        ("tags add good", "select grasps: SHARD:ROW, or --where, --job, --dataset"),
        ("tags add good abc:1 --where valid", "give SHARD:ROW, or --where, --job and --dataset, not both"),
        ("tags add good abc:1 abc", "'abc' does not name a grasp; write SHARD:ROW"),
        ("tags export good -o good.h5", "good.h5: the name of the file must end in .zip, .csv or .json"),
    ],
)
def test_a_mistake_is_one_line(command: str, line: str) -> None:
    done = CliRunner().invoke(build_app(), command.split(), prog_name="graspd", env={"GRASPD_API_URL": "nobody"})
    assert done.exit_code == 2 and done.stderr.startswith(f"graspd: {line}") and done.stderr.count("\n") == 1


def test_a_group_without_a_command_shows_its_help() -> None:
    done = CliRunner().invoke(build_app(), ["tags"], prog_name="graspd")
    assert done.exit_code == 2 and not done.stderr and "Usage: graspd tags" in done.stdout


@pytest.mark.parametrize(("typed", "offered"), OFFERED.items())
def test_completion_knows_commands_without_the_engine(typed: str, offered: str) -> None:
    code = "import sys; sys.argv[0] = 'graspd'; from graspd.cli import main\ntry: main()\n"
    code += "finally: print('warp' in sys.modules, file=sys.stderr)"
    words = {"COMP_WORDS": f"graspd {typed}", "COMP_CWORD": str(1 + typed.count(" "))}
    asked = os.environ | {"_GRASPD_COMPLETE": "complete_bash"} | words
    done = completed([sys.executable, "-c", code], env=asked)
    assert offered in done.stdout.split()
    assert done.stderr.strip() == "False"


def commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(command, graspd.cli.DeferredCommand):
        command = graspd.cli.load_command(command.module, path.rpartition(" ")[2])
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, f"{path} {name}")


@pytest.fixture(scope="module")
def every() -> dict[str, Any]:
    return {
        path: one
        for name, module, _, _ in graspd.cli.COMMANDS
        for path, one in commands(graspd.cli.load_command(module, name), f"graspd {name}")
    }


def test_help_loses_no_word(every: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    # Wide enough that no line is broken; typer reads the width at import.
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 4000)
    lost = []
    for path, command in every.items():
        command.make_context(path, ["--help"], resilient_parsing=True).get_help()
        shown = " ".join(capsys.readouterr().out.split())
        told = [command.help, command.epilog, *(getattr(one, "help", None) for one in command.params)]
        for text in filter(None, told):
            said = " ".join(inspect.cleandoc(text.partition("\f")[0]).replace("\\[", "[").split())
            if said not in shown:
                lost.append(f"{path}: {said}")
    assert len(every) > 60
    assert not lost, "\n".join(lost)


def test_every_option_has_a_help_with_its_unit(every: dict[str, Any]) -> None:
    options = [(path, one) for path, command in every.items() for one in command.params if one.opts[0][:1] == "-"]
    numbers = [(path, one) for path, one in options if "float" in str(one.type_descriptor.annotation)]
    silent = [f"{path} {one.opts[0]}" for path, one in options if not one.help]
    no_unit = [f"{path} {one.opts[0]}: {one.help}" for path, one in numbers if not UNIT.search(one.help)]
    assert len(numbers) > 20
    assert (silent, no_unit) == ([], [])
