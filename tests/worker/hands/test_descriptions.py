"""A hand's files however programs write, name and place them; xacro, which can neither read nor start anything."""

import json
import resource
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path

import pytest
import trimesh

from graspd.api.uploads import files_of_upload
from graspd.client.add_commands import upload_of
from graspd.commands.hands import report_hand
from graspd.service.model.errors import HandError, InputError
from graspd.service.model.states import AssetKind
from graspd.service.store.hand_files import find_main_file
from graspd.service.store.library import publish_asset
from graspd.service.store.store import open_store
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import files_from_path, hand_from_path
from graspd.worker.hands.xacro import expand_xacro
from graspd.worker.stages.assets import load_hand_files
from tests.api.factories import zipped
from tests.worker.hands.mjcfs import CLAW
from tests.worker.hands.urdfs import joint, link, robot

NOTES = {
    "urdf": "leap.urdf",
    "palm_link": "palm_lower",
    "palm_normal_in_palm_link": [0, 0, -1],
    "fingertips": {"one": "b"},
    "physical": {"torque_limit_Nm_measured": 0.95},
}
PAD = bytes(trimesh.creation.box((0.01, 0.02, 0.06)).export(file_type="stl"))
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 5\n"
INCLUDES = b'<robot xmlns:xacro="u"><xacro:include filename="a.xacro"/></robot>'
DECLARED = '<?xml version="1.0" encoding="{}"?>'
MACROS = """<?xml version="1.0"?>
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
    "urdf/claw.urdf.xacro": MACROS.encode(),
    "urdf/parts.xacro": PARTS.encode(),
    "config/size.yaml": b"width: 0.02\n",
}


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    """A hand whose palm is fixed turned on a base, so that root and approach differ with and without the notes."""
    folder = tmp_path / "leap"
    folder.mkdir()
    turned = '<origin rpy="0 1.5707963 0" xyz="0 0 0.1"/>'
    base = f'<joint name="mount" type="fixed"><parent link="base"/><child link="palm_lower"/>{turned}</joint>'
    parts = [link("base"), link("palm_lower"), link("a"), link("b"), base]
    parts += [joint("j1", "palm_lower", "a"), joint("j2", "palm_lower", "b")]
    (folder / "leap.urdf").write_bytes(robot(*parts))
    return folder / "leap.urdf"


def facts(report: dict) -> tuple[str, list[float], list[str], list[float]]:
    assert report["verdict"] == "accept", report["message"]
    said = report["facts"]
    return said["root"], said["palm_approach"], said["fingertips"], list(said["effort"].values())


def added(path: Path) -> dict:
    with upload_of(path) as (upload, main):
        said = json.dumps({"file": main}) if main else ""
        files = files_of_upload(AssetKind.HAND, upload.name, upload.read_bytes(), limit_bytes=10**7, options=said)
    return check_hand(files, "leap")


@pytest.mark.parametrize("described", ["hand.json", "asset.json", "both", "neither"])
def test_check_add_and_use_agree_whatever_lies_beside_the_urdf(urdf: Path, described: str) -> None:
    if described in ("hand.json", "both"):
        urdf.with_name("hand.json").write_text(json.dumps(NOTES))
    if described in ("asset.json", "both"):
        said = {"file": "leap.urdf", "root": "palm_lower", "palm": {"link": "palm_lower", "approach": [0, 1, 0]}}
        urdf.with_name("asset.json").write_text(json.dumps(said))
    expected = facts(report_hand(str(urdf)))
    folder, archive = urdf.parent, urdf.parent.with_suffix(".zip")
    archive.write_bytes(zipped({file.name: file.read_bytes() for file in folder.iterdir()}))
    # However a path is given, its files are read alike: each is checked, added and used from two of the three.
    assert [facts(report_hand(str(path))) for path in (folder, archive)] == [expected] * 2
    assert [facts(added(path)) for path in (urdf, archive)] == [expected] * 2
    hand = hand_from_path(urdf)
    assert (hand.root_link, hand.palm.approach.round(6).tolist()) == expected[:2]
    approach = {"hand.json": [0, 0, -1], "neither": expected[1]}.get(described, [0, 1, 0])
    assert (expected[0], expected[1]) == ("base" if described == "neither" else "palm_lower", approach)
    noted = described in ("hand.json", "both")
    assert expected[3] == ([0.95, 0.95] if noted else [1.0, 1.0])


def test_notes_on_another_urdf_and_assumed_torques_are_told(urdf: Path) -> None:
    bare = facts(report_hand(str(urdf)))
    urdf.with_name("hand.json").write_text(json.dumps(NOTES | {"urdf": "other.urdf"}))
    assert facts(report_hand(str(urdf))) == facts(added(urdf)) == bare
    assert "effort" not in report_hand(str(urdf))["facts"]["guessed"]
    urdf.write_text(urdf.read_text().replace('effort="1"', ""))
    assert "effort" in report_hand(str(urdf))["facts"]["guessed"]


@pytest.mark.parametrize("text", ["[]", '{"palm_link": "nowhere"}', '{"palm_link": 5}'])
def test_unreadable_notes_are_told_and_refused_alike(urdf: Path, text: str) -> None:
    named = "nowhere" if "nowhere" in text else "hand.json"
    urdf.with_name("hand.json").write_text(text)
    with pytest.raises(HandError, match=named):
        hand_from_path(urdf)
    for report in (report_hand(str(urdf)), added(urdf)):
        assert report["verdict"] == "refuse" and named in report["message"]


def package(folder: Path, reference: str, *, manifest: bool, urdf: str = "urdf/claw.urdf") -> Path:
    """A package with a URDF that names one mesh, which lies in `meshes/`."""
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "finger.stl").write_bytes(trimesh.creation.box((0.01, 0.02, 0.05)).export(file_type="stl"))
    (folder / urdf).parent.mkdir(parents=True, exist_ok=True)
    (folder / urdf).write_text(claw(reference))
    if manifest:
        (folder / "package.xml").write_text("<package><name>claw_description</name></package>")
    return folder / urdf


@pytest.mark.parametrize("manifest", [True, False])
@pytest.mark.parametrize("where", ["..", "package://claw_description", "package://bundle/robots/claw_description"])
def test_meshes_beside_the_folder_of_the_urdf_are_found(tmp_path: Path, where: str, manifest: bool) -> None:
    urdf = package(tmp_path / "claw_description", f"{where}/meshes/finger.stl", manifest=manifest)
    name, files, stated = files_from_path(urdf)
    assert (name, stated, set(files)) == ("claw", {"file": "urdf/claw.urdf"}, {"urdf/claw.urdf", "meshes/finger.stl"})
    assert sum(piece.kind == "hull" for piece in hand_from_path(urdf).pieces) == 1
    assert report_hand(str(tmp_path))["verdict"] == "accept"


def test_a_workspace_of_several_packages_is_one_upload(tmp_path: Path) -> None:
    package(tmp_path / "src" / "claw_description", "package://parts_description/meshes/finger.stl", manifest=True)
    (tmp_path / "src" / "claw_description" / "meshes").rename(tmp_path / "src" / "meshes")
    parts = tmp_path / "src" / "parts_description"
    parts.mkdir()
    (tmp_path / "src" / "meshes").rename(parts / "meshes")
    assert report_hand(str(tmp_path / "src"))["verdict"] == "accept"


def test_nothing_out_of_package_or_above_a_plain_folder_is_read(tmp_path: Path) -> None:
    (tmp_path / "secret.stl").write_bytes(b"secret")
    urdf = package(tmp_path / "claw_description", "../../secret.stl", manifest=True)
    assert set(files_from_path(urdf)[1]) == {"urdf/claw.urdf"}
    assert "outside" in report_hand(str(urdf))["message"]
    urdf = package(tmp_path / "hand", "../meshes/finger.stl", manifest=False, urdf="mine/claw.urdf")
    assert set(files_from_path(urdf)[1]) == {"claw.urdf"}
    assert "outside" in report_hand(str(urdf))["message"]
    assert report_hand(str(tmp_path / "hand"))["verdict"] == "accept"


def claw(mesh: str = "") -> str:
    box = '<collision><geometry><box size="0.08 0.04 0.02"/></geometry></collision>'
    more = f'<collision><geometry><mesh filename="{mesh}"/></geometry></collision>' if mesh else ""
    finger = '<collision><origin xyz="0 0 0.03"/><geometry><box size="0.02 0.02 0.06"/></geometry></collision>'
    return robot(
        link("palm", box),
        link("left", finger + more),
        link("right", finger),
        joint("jl", "palm", "left", origin="0.03 0 0.01", axis="0 -1 0"),
        joint("jr", "palm", "right", origin="-0.03 0 0.01", axis="0 1 0"),
    ).decode()


def verdicts(files: Mapping[str, bytes], main: str, folder: Path) -> list[str]:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    packed = zipped({f"top/{name}": data for name, data in files.items()})
    try:
        uploaded = check_hand(files_of_upload(AssetKind.HAND, "h.zip", packed, limit_bytes=1 << 22), "h")
    except InputError as error:
        uploaded = {"verdict": "refuse", "message": str(error)}
    found: list[dict] = [report_hand(str(folder / main)), report_hand(str(folder)), uploaded]
    return ["accept" if one["verdict"] == "accept" else one["message"] for one in found]


WRITTEN = {
    "byte order mark": b"\xef\xbb\xbf" + claw().encode(),
    "CRLF": claw().replace("><", ">\r\n<").encode(),
    "UTF-16": (DECLARED.format("UTF-16") + claw()).encode("utf-16"),
    "UTF-16 that is UTF-8": (DECLARED.format("UTF-16") + claw()).encode(),
    "UTF-32": (DECLARED.format("UTF-32") + claw()).encode("utf-32"),
    "GB 2312": (DECLARED.format("gb2312") + claw().replace("<link", "<!-- \u624b --><link", 1)).encode("gb2312"),
    "no encoding": (DECLARED.format("nonsense") + claw()).encode(),
    "Latin 1": claw().replace("<link", "<!-- 90\u00b0 --><link", 1).encode("latin-1"),
    "a comment first": ("<!-- a licence -->\n" + DECLARED.format("utf-8") + claw()).encode(),
    "a line first": ("\n" + DECLARED.format("utf-8") + claw()).encode(),
    "a namespace": claw().replace("<robot", '<robot xmlns="http://www.ros.org"', 1).encode(),
    "padded": claw().encode() + b"\n\0\0",
}


@pytest.mark.parametrize("written", WRITTEN)
def test_a_urdf_is_read_as_programs_write_it(written: str) -> None:
    found = check_hand({"h.urdf": WRITTEN[written]}, "h")
    assert found["verdict"] == "accept", found["message"]


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b" \r\n", "h.urdf contains nothing but spaces"),
        (b'<?xml version="1.0"?>', "h.urdf is empty; export it again"),
        (claw().replace('name="test"', 'name="test" name="b"').encode(), "duplicate attribute"),
        (b"<sdf/>", "the XML root is <sdf>, but a URDF begins with <robot>"),
        (b'<!DOCTYPE robot [<!ENTITY a "b">]><robot name="&a;"/>'.decode().encode("utf-16"), "entities are refused"),
        (claw("https://any/pad.stl").encode(), "put it beside the URDF"),
    ],
)
def test_a_urdf_that_is_none_is_told_why(data: bytes, told: str) -> None:
    assert told in check_hand({"h.urdf": data}, "h")["message"]


@pytest.mark.parametrize("coding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("name", ["h.urdf", "h.xacro"])
def test_macros_are_found_in_any_encoding(coding: str, name: str, tmp_path: Path) -> None:
    text = claw("meshes/pad.stl").replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"', 1)
    text = DECLARED.format("UTF-16") + text.replace('"0.08 0.04 0.02"', '"${2 * 0.04} 0.04 0.02"')
    assert verdicts({name: text.encode(coding), "meshes/pad.stl": PAD}, name, tmp_path) == ["accept"] * 3


@pytest.mark.parametrize(
    ("written", "there"),
    [
        ("Meshes/PAD.STL", "meshes/pad.stl"),
        ("meshes/pad%20a.stl", "meshes/pad a.stl"),
        ("meshes/pad%20a.stl", "meshes/pad%20a.stl"),
        ("PACKAGE://any/meshes/pad.stl", "meshes/pad.stl"),
        ("package:/any/meshes/pad.stl", "meshes/pad.stl"),
        ("file:meshes/pad.stl", "meshes/pad.stl"),
        ("model://any/../meshes/pad.stl", "meshes/pad.stl"),
        ("./meshes//x/../pad.stl", "meshes/pad.stl"),
        (" meshes/pad.stl ", "meshes/pad.stl"),
        ("meshes\\pad.stl", "meshes/pad.stl"),
        ("model:\\\\any\\meshes\\pad.stl", "meshes/pad.stl"),
        ("file:///meshes/pad.stl", "meshes/pad.stl"),
        ("a&amp;b.stl", "a&b.stl"),
    ],
)
def test_a_mesh_is_found_however_it_is_written(written: str, there: str, tmp_path: Path) -> None:
    assert verdicts({"h.urdf": claw(written).encode(), there: PAD}, "h.urdf", tmp_path) == ["accept"] * 3


@pytest.mark.parametrize("written", ["../{}", "package://any/../../{}", "/{}", "file:///../{}", "%2e%2e/{}", "C:\\{}"])
def test_a_mesh_outside_the_folder_is_read_by_no_spelling(written: str, tmp_path: Path) -> None:
    (tmp_path / "secret.stl").write_bytes(PAD)
    found = verdicts({"h.urdf": claw(written.format("secret.stl")).encode()}, "h.urdf", tmp_path / "h")
    assert all("outside" in one or "not there" in one for one in found)


def test_a_package_that_xacro_finds_holds_the_mesh(tmp_path: Path) -> None:
    text = claw("$(find any)/meshes/pad.stl").encode()
    files = {"urdf/h.xacro": text, "meshes/pad.stl": PAD, "package.xml": b"<package><name>any</name></package>"}
    assert verdicts(files, "urdf/h.xacro", tmp_path) == ["accept"] * 3


def test_a_part_of_a_xacro_file_is_not_taken_for_the_hand(tmp_path: Path) -> None:
    text = claw().replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"', 1)
    text = text.replace("<link", '<xacro:include filename="Parts\\looks.XACRO"/><link', 1)
    files = {"h.xacro": text.encode(), "parts/looks.xacro": b'<robot><material name="red"/></robot>'}
    assert verdicts(files, "h.xacro", tmp_path) == ["accept"] * 3


@pytest.mark.parametrize(
    ("files", "pointer"),
    [
        ({"h.urdf": POINTER}, "h.urdf"),
        ({"h.urdf": claw("a.stl").encode(), "a.stl": POINTER}, "a.stl"),
        ({"h.xml": CLAW.encode(), "meshes/tip.stl": POINTER}, "meshes/tip.stl"),
        ({"h.xml": b'<mujoco><include file="a.xml"/></mujoco>', "a.xml": POINTER}, "a.xml"),
        ({"h.xacro": INCLUDES, "a.xacro": POINTER}, "'a.xacro', which"),
    ],
)
def test_a_pointer_among_the_files_of_a_hand_is_told(files: dict[str, bytes], pointer: str, tmp_path: Path) -> None:
    for told in verdicts(files, next(iter(files)), tmp_path):
        assert f"{pointer} is a Git LFS pointer, not the file itself: git lfs pull" in told


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    for name, data in FILES.items():
        (tmp_path / "checkout" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "checkout" / name).write_bytes(data)
    return tmp_path / "checkout"


def test_includes_macros_arguments_and_yaml_are_expanded(checkout: Path) -> None:
    hand = hand_from_path(checkout / "urdf" / "claw.urdf.xacro")
    assert hand.name == "claw" and hand.dof_names == ("left_joint", "right_joint")
    assert hand.upper.tolist() == [0.04, 0.04]
    assert {piece.size for piece in hand.pieces if piece.link != "palm"} == {(0.01, 0.02, 0.06)}


def test_an_upload_of_the_package_is_the_same_hand(checkout: Path) -> None:
    report = report_hand(str(checkout), {"xacro": {"stroke": "0.03"}})
    assert report["verdict"] == "accept" and report["facts"]["upper"]["left_joint"] == 0.03
    packed = zipped({f"checkout/{name}": data for name, data in FILES.items()})
    files = files_of_upload(AssetKind.HAND, "claw.zip", packed, limit_bytes=1 << 20)
    found, expected = check_hand(files, "claw"), report_hand(str(checkout))
    # A folder is called as it is, an upload as the user says.
    assert found["verdict"] == "accept" and found["facts"] == expected["facts"]


def refusal(body: str, **others: bytes) -> str:
    head = '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro">'
    with pytest.raises(HandError) as caught:
        expand_xacro({"x.xacro": f"{head}{body}</robot>".encode(), **others}, "x.xacro", {})
    message = str(caught.value)
    assert "\n" not in message and len(message) < 400
    return message


@pytest.mark.parametrize(
    ("body", "named"),
    [
        ('<xacro:include filename="../../etc/passwd"/>', "outside the hand's folder"),
        ('<xacro:include filename="/etc/*"/>', "outside the hand's folder"),
        ('<xacro:include filename="missing.xacro"/>', "'missing.xacro', which is missing"),
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
        ("""<a b="${'x' * 5 * 2**20}"/>""", "characters; at most 4194304 are taken"),
        pytest.param('<a b="${[' + "1," * 100_001 + ']}"/>', "an expression is too long", id="many numbers"),
    ],
)
def test_what_reaches_out_or_is_wrong_is_refused_in_one_line(body: str, named: str) -> None:
    assert named in refusal(body, **{"package.xml": b"<package><name>other</name></package>"})


def test_entities_are_refused_and_expansion_without_end_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(HandError, match="entities"):
        expand_xacro({"x.xacro": b'<!DOCTYPE robot [<!ENTITY a "b">]><robot name="${1}">&a;</robot>'}, "x.xacro", {})
    monkeypatch.setattr("graspd.worker.hands.xacro.CPU_LIMIT_S", 1)
    assert "takes more than" in refusal('<a b="${9**9**9}"/>')


@pytest.mark.parametrize("code", ["os.kill(os.getpid(), signal.SIGKILL)", "signal.pause()"])
def test_an_expansion_that_the_machine_ended_refuses_no_hand(code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    run = subprocess.run

    def other(command: list[str], **options: object) -> object:
        return run([sys.executable, "-c", f"import os, signal; {code}"], **options)  # type: ignore[call-overload]

    monkeypatch.setattr("graspd.worker.objects.isolation.subprocess.run", other)
    monkeypatch.setattr("graspd.worker.objects.isolation._WALL_LIMIT_S", 0.5 if "pause" in code else 60.0)
    with pytest.raises(OSError, match=r"x\.xacro"):
        expand_xacro({"x.xacro": b"<robot/>"}, "x.xacro", {})


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
        f"child._restrict_process(5, 2**30)\ntry:\n    {attempt}\nexcept BaseException as error:\n"
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
    with pytest.raises(InputError, match=r"2 files 'h\.urdf'.*name one by its path"):
        find_main_file(dict.fromkeys(("old/h.urdf", "new/h.urdf"), b"<robot/>"), "h.urdf")


def test_a_folder_of_too_many_files_is_no_hand(checkout: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.service.store.hand_files.MAX_FILES", 1)
    assert "more than 1 files; give the folder of one hand" in report_hand(str(checkout))["message"]


def test_what_a_file_prints_without_end_is_not_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    text = MACROS.replace("</robot>", "${[xacro.warning('x' * 10**6) for i in range(300)]}</robot>")
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    assert b"<robot" in expand_xacro({**FILES, "urdf/claw.urdf.xacro": text.encode()}, "urdf/claw.urdf.xacro", {})
    # 300 MB are printed; KiB.
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 * 1024


@pytest.mark.parametrize("value", ["str(map(str, [1]))", "(x for x in [1])", "lambda: 1", "xacro.load_yaml", "xacro"])
def test_what_differs_from_expansion_to_expansion_is_refused(value: str, tmp_path, monkeypatch) -> None:
    main = "urdf/claw.urdf.xacro"
    text = MACROS.replace("<robot", f'<robot note="${{{value}}}"', 1).encode()
    with pytest.raises(HandError, match="a new address each time"):
        expand_xacro({**FILES, main: text}, main, {})
    monkeypatch.chdir(tmp_path)
    text = MACROS.replace("<robot", '<robot note="$(cwd)"', 1).encode()
    assert tmp_path.name.encode() not in expand_xacro({**FILES, main: text}, main, {})


def test_a_hand_in_the_store_is_expanded_once(monkeypatch: pytest.MonkeyPatch) -> None:
    store = open_store("memory://")
    asset = publish_asset(store, AssetKind.HAND, "claw", {**FILES, "asset.json": b'{"file": "urdf/claw.urdf.xacro"}'})
    first = load_hand_files(store, asset.digest)
    assert first["urdf/claw.urdf.xacro"] == expand_xacro(FILES, "urdf/claw.urdf.xacro", {})
    monkeypatch.setattr("graspd.worker.stages.assets.expand_xacro", lambda *_: pytest.fail("expanded again"))
    assert load_hand_files(store, asset.digest) == first
