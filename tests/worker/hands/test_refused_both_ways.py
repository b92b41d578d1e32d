"""Hands that nobody should run or that hold nothing: one clear line from `graspd hands check`, and of an upload."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from graspd.cli import build
from graspd.service.model.states import AssetKind
from graspd.service.store.store import open_store
from tests.worker.hands.mjcfs import CLAW
from tests.worker.hands.urdfs import joint, link, robot
from tests.worker.objects.test_dae import BOMB, SCENE, dae
from tests.worker.stages.test_hostile_uploads import upload, zipped

XACRO = '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro">{}</robot>'
MESH = '<collision><geometry><mesh filename="part.dae"/></geometry></collision>'
BALL = '<collision><geometry><sphere radius="{}"/></geometry></collision>'
#: Both balls turn about their own centres: nothing comes closer to anything.
FORK = robot(
    link("palm", BALL.format(0.01)),
    link("a", BALL.format(0.0005)),
    link("b", BALL.format(0.0005)),
    joint("ja", "palm", "a", origin="0.03 0 0.05", axis="0 0 1"),
    joint("jb", "palm", "b", origin="-0.03 0 0.05", axis="0 0 1"),
)
HANDS: dict[str, tuple[dict[str, bytes], str]] = {
    "runs.xacro": (
        {"runs.xacro": XACRO.format("""<a b="${__import__('os').system('touch ran')}"/>""").encode()},
        "__import__",
    ),
    "reads.xacro": (
        {"reads.xacro": XACRO.format('<xacro:include filename="/etc/passwd"/>').encode()},
        "outside the hand's folder",
    ),
    "includes.xml": (
        {"includes.xml": CLAW.replace('<light pos="0 0 1"/>', '<include file="/etc/passwd"/>').encode()},
        "outside the hand's folder",
    ),
    "far_mesh.xml": (
        {"far_mesh.xml": CLAW.replace('file="tip.stl"', 'file="../../../etc/passwd.stl"').encode()},
        "outside the hand's folder",
    ),
    "bomb.urdf": (
        {
            "bomb.urdf": robot(link("palm", MESH), link("a", MESH), joint("j", "palm", "a")),
            "part.dae": dae(SCENE.replace("<library_nodes>", f"<library_nodes>{BOMB}").replace("#part", "#n0")),
        },
        "too deep",
    ),
    "fork.urdf": ({"fork.urdf": FORK}, "no two opposing digits"),
}


@pytest.mark.parametrize("name", HANDS)
def test_a_bad_hand_is_refused_in_one_line_here_and_as_an_upload(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, says = HANDS[name]
    folder = tmp_path / "hand"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for file, data in files.items():
        (folder / file).write_bytes(data)
    told = CliRunner().invoke(build(), ["hands", "check", name])
    assert told.exit_code == 2 and told.stdout == ""
    (line,) = told.stderr.splitlines()
    assert line.startswith("graspd: refused: ") and says in line and len(line) < 400

    found = upload(open_store("memory://"), AssetKind.HAND, "hand.zip", zipped(files))
    assert found["verdict"] == "refuse" and says in found["message"] and "\n" not in found["message"]
    assert "root:" not in line + found["message"] and set(files) == {path.name for path in folder.iterdir()}
