"""Xacro is expanded as ROS does it, and an expression can neither read a file nor start a command."""

from __future__ import annotations

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.api.uploads import files_of_upload
from graspd.commands.hands import report_hand
from graspd.service.model.errors import HandError, InputError
from graspd.service.model.states import AssetKind
from graspd.service.store.library import publish_asset
from graspd.service.store.store import open_store
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.xacro import expand
from graspd.worker.stages.assets import load_hand_files
from tests.worker.stages.test_ingest import zipped

CLAW = """<?xml version="1.0"?>
<robot name="claw" xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:arg name="stroke" default="0.04"/>
  <xacro:property name="size" value="${xacro.load_yaml('$(find claw_description)/config/size.yaml')}"/>
  <xacro:include filename="$(find claw_description)/urdf/parts.xacro"/>
  <link name="palm"><collision><geometry><box size="0.1 0.04 0.04"/></geometry></collision></link>
  <xacro:finger name="left" side="1"><origin xyz="0.045 0 0.02"/></xacro:finger>
  <xacro:finger name="right" side="-1"><origin xyz="${-0.09 / 2} 0 0.02"/></xacro:finger>
</robot>
"""
PARTS = """<robot xmlns:xacro="http://www.ros.org/wiki/xacro">
  <xacro:macro name="finger" params="name side *pose">
    <link name="${name}">
      <collision><origin xyz="0 0 0.03"/>
        <geometry><box size="0.01 ${size['width']} ${[0.06 for i in range(1)][0]}"/></geometry></collision>
    </link>
    <joint name="${name}_joint" type="prismatic">
      <parent link="palm"/><child link="${name}"/><xacro:insert_block name="pose"/>
      <axis xyz="${-side} 0 0"/><limit lower="0" upper="$(arg stroke)" effort="20" velocity="0.1"/>
    </joint>
  </xacro:macro>
</robot>
"""
FILES = {
    "package.xml": b"<package><name>claw_description</name></package>",
    "urdf/claw.urdf.xacro": CLAW.encode(),
    "urdf/parts.xacro": PARTS.encode(),
    "config/size.yaml": b"width: 0.02\n",
}


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """The folder of a ROS package; its name is not the package's."""
    for name, data in FILES.items():
        (tmp_path / "checkout" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "checkout" / name).write_bytes(data)
    return tmp_path / "checkout"


def test_includes_macros_arguments_and_yaml_are_expanded(package: Path) -> None:
    hand = hand_from_path(package / "urdf" / "claw.urdf.xacro")
    assert hand.name == "claw" and hand.dof_names == ("left_joint", "right_joint")
    assert hand.upper.tolist() == [0.04, 0.04]
    assert {piece.size for piece in hand.pieces if piece.link != "palm"} == {(0.01, 0.02, 0.06)}


def test_an_upload_of_the_package_is_the_same_hand(package: Path) -> None:
    report = report_hand(str(package), {"xacro": {"stroke": "0.03"}})
    assert report["verdict"] == "accept" and report["facts"]["upper"]["left_joint"] == 0.03
    packed = zipped({f"checkout/{name}": data for name, data in FILES.items()})
    files = files_of_upload(AssetKind.HAND, "claw.zip", packed, limit_bytes=1 << 20)
    found, expected = check_hand(files, "claw"), report_hand(str(package))
    # A folder is called as it is, an upload as the user says.
    assert found["verdict"] == "accept" and found["facts"] == expected["facts"]


def refusal(body: str, **others: bytes) -> str:
    head = '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    with pytest.raises(HandError) as caught:
        expand({"x.xacro": f"{head}{body}</robot>".encode(), **others}, "x.xacro", {})
    message = str(caught.value)
    assert "\n" not in message and len(message) < 400
    return message


@pytest.mark.parametrize(
    ("body", "named"),
    [
        ('<xacro:include filename="/etc/passwd"/>', "outside the hand's folder"),
        ('<xacro:include filename="../../etc/passwd"/>', "outside the hand's folder"),
        ('<xacro:include filename="/etc/*"/>', "outside the hand's folder"),
        ('<xacro:include filename="missing.xacro"/>', "missing.xacro"),
        ("""<a b="${xacro.load_yaml('/etc/passwd')}"/>""", "outside the hand's folder"),
        ('<a b="$(find nowhere)"/>', "nowhere"),
        ('<a b="$(env HOME)"/>', "environment variable"),
        ('<a b="$(arg none)"/>', "--xacro NAME=VALUE"),
        ('<a b="$(eval __import__)"/>', "__import__"),
        ('<a b="$(eval open)"/>', "cannot be expanded"),
        ('<a b="${[c for c in (lambda: [].__class__)()]}"/>', "__class__"),
        ('<a b="${(x for x in [1]).gi_frame}"/>', "gi_frame"),
        ('<a b="${xacro.load_yaml.__globals__}"/>', "__globals__"),
        ("<xacro:unknown/>", "unknown"),
        ('<xacro:macro name="m" params=""><xacro:m/></xacro:macro><xacro:m/>', "recursion"),
        ('<a b="${nothing}"/>', "nothing"),
    ],
)
def test_what_reaches_out_or_is_wrong_is_refused_in_one_line(body: str, named: str) -> None:
    assert named in refusal(body, **{"package.xml": b"<package><name>other</name></package>"})


def test_entities_are_refused_and_expansion_without_end_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(HandError, match="entities"):
        expand({"x.xacro": b'<!DOCTYPE robot [<!ENTITY a "b">]><robot name="${1}">&a;</robot>'}, "x.xacro", {})
    monkeypatch.setattr("graspd.worker.hands.xacro.CPU_LIMIT_S", 1)
    assert "takes more than" in refusal('<a b="${9**9**9}"/>')


@pytest.mark.parametrize("code", ["os.kill(os.getpid(), signal.SIGKILL)", "signal.pause()"])
def test_an_expansion_that_the_machine_ended_refuses_no_hand(code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run = subprocess.run

    def other(command: list[str], **options: object) -> object:
        return run([sys.executable, "-c", f"import os, signal; {code}"], **options)  # type: ignore[call-overload]

    monkeypatch.setattr("graspd.worker.hands.xacro.subprocess.run", other)
    monkeypatch.setattr("graspd.worker.hands.xacro._WALL_LIMIT_S", 0.5 if "pause" in code else 60.0)
    with pytest.raises(OSError, match=r"x\.xacro"):
        expand({"x.xacro": b"<robot/>"}, "x.xacro", {})


@pytest.mark.parametrize(
    "attempt",
    [
        "open('/etc/passwd')",
        "import_module('os').system('true')",
        "import_module('subprocess').run(['true'])",
        "socket.socket()",
        "os.fork()",
        "os.listdir('/')",
        "_posixsubprocess.fork_exec",
        "import_module('ctypes')",
    ],
)
def test_code_that_climbs_out_of_expression_finds_doors_closed(attempt: str) -> None:
    code = (
        "import os, socket; from importlib import import_module; from graspd.worker.hands import xacro_child as child;"
        f"child._close_doors(5, 2**30)\ntry:\n    {attempt}\nexcept BaseException as error:\n"
        "    os.write(1, type(error).__name__.encode())\nos._exit(0)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert done.stdout in (b"Refused", b"NameError")


def test_of_several_descriptions_one_is_named(tmp_path: Path) -> None:
    urdf = '<robot name="{}"><link name="l"/></robot>'
    for name in ("left", "right"):
        (tmp_path / f"{name}.urdf").write_text(urdf.format(name))
    message = report_hand(str(tmp_path))["message"]
    assert "left.urdf, right.urdf" in message and "--urdf left.urdf" in message
    assert "nowhere" in report_hand(str(tmp_path), {"file": "nowhere"})["message"]
    packed = zipped({f"hands/urdf/{name}.urdf": urdf.format(name).encode() for name in ("left", "right")})
    with pytest.raises(InputError, match=r"--urdf left\.urdf"):
        files_of_upload(AssetKind.HAND, "h.zip", packed, limit_bytes=1 << 20)
    for said in ("right.urdf", "right", "urdf/right.urdf"):
        options = f'{{"file": "{said}"}}'
        files = files_of_upload(AssetKind.HAND, "h.zip", packed, limit_bytes=1 << 20, options=options)
        assert b'"urdf/right.urdf"' in files["asset.json"]


def test_what_a_file_prints_without_end_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    text = CLAW.replace("</robot>", "${[xacro.warning('x' * 10**6) for i in range(300)]}</robot>")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert b"<robot" in expand({**FILES, "urdf/claw.urdf.xacro": text.encode()}, "urdf/claw.urdf.xacro", {})
    # 300 MB are printed; KiB.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 * 1024


@pytest.mark.parametrize("value", ["str(map(str, [1]))", "(x for x in [1])", "lambda: 1", "xacro.load_yaml", "xacro"])
def test_what_differs_from_expansion_to_expansion_is_refused(
    value: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    main = "urdf/claw.urdf.xacro"
    text = CLAW.replace("<robot", f'<robot note="${{{value}}}"', 1).encode()
    with pytest.raises(HandError, match="a new address each time"):
        expand({**FILES, main: text}, main, {})
    monkeypatch.chdir(tmp_path)
    text = CLAW.replace("<robot", '<robot note="$(cwd)"', 1).encode()
    assert tmp_path.name.encode() not in expand({**FILES, main: text}, main, {})


def test_a_hand_in_the_store_is_expanded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    store = open_store("memory://")
    asset = publish_asset(store, AssetKind.HAND, "claw", {**FILES, "asset.json": b'{"file": "urdf/claw.urdf.xacro"}'})
    first = load_hand_files(store, asset.digest)
    assert first["urdf/claw.urdf.xacro"] == expand(FILES, "urdf/claw.urdf.xacro", {})
    monkeypatch.setattr("graspd.worker.stages.assets.expand", lambda *_: pytest.fail("expanded again"))
    assert load_hand_files(store, asset.digest) == first
