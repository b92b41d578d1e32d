"""`--help` of every command shows each word that the command declares."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

import pytest

import graspd.cli


def commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    """A command and all below it, those of other packages loaded."""
    if isinstance(command, graspd.cli.Deferred):
        command = graspd.cli.load(command.module, path.rpartition(" ")[2])
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, f"{path} {name}")


@pytest.fixture(scope="module")
def every() -> dict[str, Any]:
    """All commands of graspd by what a user types."""
    return {
        path: one
        for name, module, _, _ in graspd.cli.COMMANDS
        for path, one in commands(graspd.cli.load(module, name), f"graspd {name}")
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


#: Of a number that is no count: its unit, or the word of one without.
UNIT = re.compile(r"\[\w+\]|\b(mm|kg|kg/m3|metres|coefficient|share|candidates)\b", re.IGNORECASE)


def test_every_option_has_a_help_with_its_unit(every: dict[str, Any]) -> None:
    options = [(path, one) for path, command in every.items() for one in command.params if one.opts[0][:1] == "-"]
    numbers = [(path, one) for path, one in options if "float" in str(one.type_descriptor.annotation)]
    silent = [f"{path} {one.opts[0]}" for path, one in options if not one.help]
    no_unit = [f"{path} {one.opts[0]}: {one.help}" for path, one in numbers if not UNIT.search(one.help)]
    assert len(numbers) > 20
    assert (silent, no_unit) == ([], [])
