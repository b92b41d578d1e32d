"""Every command of "Hands as they come" in docs/hands.md does what it says."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from graspd.cli import build
from tests.worker.hands.mjcfs import FOUR_BAR
from tests.worker.hands.test_packages import package
from tests.worker.hands.test_roots import humanoid

DOCS = Path(__file__).parents[3] / "docs" / "hands.md"
SECTION = DOCS.read_text().partition("## Hands as they come")[2].partition("\n## ")[0]
COMMANDS = re.findall(r"^graspd (hands check [^#\n]*)", SECTION, re.MULTILINE)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_documented_command_accepts_its_hand(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    urdf = package(tmp_path / "my_description", "../meshes/finger.stl", manifest=True, urdf="urdf/my_hand.urdf")
    (urdf.parent / "my_hand.urdf.xacro").write_text(
        urdf.read_text().replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ', 1).replace(
            '<link name="palm">', '<link name="$(arg side)_frame"/><joint name="f" type="fixed"><parent link="'
            '$(arg side)_frame"/><child link="palm"/></joint><link name="palm">',
        )
    )  # fmt: skip
    (urdf.parent / "other.urdf").write_text("<robot/>")
    (tmp_path / "my_model").mkdir()
    (tmp_path / "my_model" / "hand.xml").write_text(FOUR_BAR)
    (tmp_path / "my_robot.urdf").write_bytes(humanoid("left", "right"))
    told = CliRunner().invoke(build(), [*shlex.split(command), "--json"])
    report = json.loads(told.stdout.splitlines()[-1])
    assert told.exit_code == 0 and report["verdict"] == "accept", report["message"]


def test_the_section_has_its_commands() -> None:
    assert len(COMMANDS) >= 5
