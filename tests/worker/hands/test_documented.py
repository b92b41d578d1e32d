"""Every `graspd hands check` of docs/how-to/hands.md does what it says; tests/front/test_docs.py has the rest."""

from __future__ import annotations

import functools
import json
import re
import shlex
from pathlib import Path

import pytest
from PIL import Image
from typer.testing import CliRunner

from graspd.cli import build
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.model import HandModel
from graspd.worker.rendering import portraits
from graspd.worker.stages import hand_self_test
from graspd.worker.stages.hand_self_test import SelfTest
from tests.conftest import REPOSITORY
from tests.worker.hands.my_hand import asset_json_of, write_all

PAGE = (REPOSITORY / "docs" / "how-to" / "hands.md").read_text()
BLOCKS = "".join(re.findall(r"```sh\n(.*?)```", PAGE, re.DOTALL)).replace("\\\n", " ")
LINES = [line for line in BLOCKS.splitlines() if line.strip()]
COMMANDS = [line for line in LINES if line.startswith("graspd hands check ")]
#: Pictures are as large, and the self-test as long, as it takes to see that they are made.
SMALL = (68, 72)
FEW = 6
#: The one whose self-test is run; the others are told what one would say.
TRIED = "graspd hands check franka_hand/"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("reader")
    write_all(made)
    return made


@pytest.mark.parametrize("command", COMMANDS)
def test_a_documented_command_accepts_its_hand(command: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(portraits, "SIZE", SMALL)
    whole = functools.partial(hand_self_test.self_test, grasps=FEW)
    monkeypatch.setattr(hand_self_test, "self_test", whole if command == TRIED else _untried)
    arguments = shlex.split(command, comments=True)[1:]
    told = CliRunner().invoke(build(), [*arguments, "--json"])
    report = json.loads(told.stdout.splitlines()[-1])
    assert told.exit_code == 0 and report["verdict"] == "accept", report["message"]
    if "--picture" in arguments:
        with Image.open(folder / arguments[arguments.index("--picture") + 1]) as picture:
            assert picture.width == 3 * SMALL[0]
    assert report["self_test"]["n"] == (FEW if command == TRIED else 0)
    if command == TRIED:
        assert report["self_test"]["says"].startswith("ready: ")
    if "--root" in arguments:
        assert report["facts"]["root"] == arguments[arguments.index("--root") + 1]
    if "--palm" in arguments:
        assert report["facts"]["preshape"]["joint_12.0"] == 1.2 and "palm" not in report["facts"]["guessed"]


def _untried(hand: HandModel, run: ExecutionContext) -> SelfTest:
    return SelfTest(0.9, 0, 0.04, {}, 0.8, 0)


def test_the_page_has_its_commands_and_all_of_them_are_run() -> None:
    with_a_service = ("graspd hands add ", "graspd submit ", "curl ")
    assert len(COMMANDS) >= 9 and TRIED in COMMANDS
    assert [line for line in LINES if line not in COMMANDS and not line.startswith(with_a_service)] == []


def test_what_is_written_has_the_keys_of_the_asset_json_example(
    folder: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(folder)
    command = ["hands", "check", "my_hand/my_hand.urdf", "--no-self-test", "--write", str(tmp_path / "asset.json")]
    assert CliRunner().invoke(build(), command).exit_code == 0
    written = json.loads((tmp_path / "asset.json").read_text())
    assert set(written) - {"root"} <= set(asset_json_of(PAGE))
