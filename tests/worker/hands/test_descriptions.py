"""A hand's files however programs write, name and place them: check, add and use read them alike."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import trimesh

from graspd.api.uploads import files_of_upload
from graspd.client.add_commands import upload_of
from graspd.commands.hands import report_hand
from graspd.service.model.errors import HandError, InputError
from graspd.service.model.states import AssetKind
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import files_from_path, hand_from_path
from tests.worker.hands.mjcfs import CLAW
from tests.worker.hands.urdfs import joint, link, robot
from tests.worker.stages.test_ingest import zipped

NOTES = {
    "urdf": "leap.urdf",
    "palm_link": "palm_lower",
    "palm_normal_in_palm_link": [0, 0, -1],
    "fingertips": {"one": "b"},
    "physical": {"torque_limit_Nm_measured": 0.95},
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


def facts(report: dict[str, Any]) -> tuple[str, list[float], list[str], list[float]]:
    assert report["verdict"] == "accept", report["message"]
    said = report["facts"]
    return said["root"], said["palm_approach"], said["fingertips"], list(said["effort"].values())


def added(path: Path) -> dict[str, Any]:
    """The report of the files that the service gets from `hands add`."""
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


@pytest.mark.parametrize(
    ("text", "named"), [("[]", "hand.json"), ('{"palm_link": "nowhere"}', "nowhere"), ('{"palm_link": 5}', "hand.json")]
)
def test_unreadable_notes_are_told_and_refused_alike(urdf: Path, text: str, named: str) -> None:
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
@pytest.mark.parametrize(
    "reference",
    [
        "../meshes/finger.stl",
        "package://claw_description/meshes/finger.stl",
        "package://bundle/robots/claw_description/meshes/finger.stl",
    ],
)
def test_meshes_beside_the_folder_of_the_urdf_are_found(tmp_path: Path, reference: str, manifest: bool) -> None:
    urdf = package(tmp_path / "claw_description", reference, manifest=manifest)
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


PAD = bytes(trimesh.creation.box((0.01, 0.02, 0.06)).export(file_type="stl"))
POINTER = b"version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 5\n"
DECLARED = '<?xml version="1.0" encoding="{}"?>'


def claw(mesh: str = "") -> str:
    """Two fingers that bend towards each other; the left one touches with a mesh as well."""
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
    """What becomes of a description, of its folder, and of a ZIP of that: `accept`, or the refusal."""
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    packed = zipped({f"top/{name}": data for name, data in files.items()})
    try:
        uploaded = check_hand(files_of_upload(AssetKind.HAND, "h.zip", packed, limit_bytes=1 << 22), "h")
    except InputError as error:
        uploaded = {"verdict": "refuse", "message": str(error)}
    found: list[dict[str, Any]] = [report_hand(str(folder / main)), report_hand(str(folder)), uploaded]
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
        (claw().replace('name="test"', 'name="test" name="b"').encode(), "duplicate attribute"),
        (b"<sdf/>", "the XML root is <sdf>, a URDF begins with <robot>"),
        (b'<!DOCTYPE robot [<!ENTITY a "b">]><robot name="&a;"/>'.decode().encode("utf-16"), "entities are refused"),
    ],
)
def test_a_urdf_that_is_none_is_told_why(data: bytes, told: str) -> None:
    assert told in check_hand({"h.urdf": data}, "h")["message"]


@pytest.mark.parametrize("coding", ["utf-8-sig", "utf-16"])
@pytest.mark.parametrize("name", ["h.urdf", "h.xacro"])
def test_macros_are_found_in_any_encoding(coding: str, name: str, tmp_path: Path) -> None:
    text = claw("meshes/pad.stl").replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"', 1)
    text = DECLARED.format("UTF-16") + text.replace('"0.08 0.04 0.02"', '"${2 * 0.04} 0.04 0.02"')
    files = {name: text.encode(coding), "meshes/pad.stl": PAD}
    assert verdicts(files, name, tmp_path) == ["accept"] * 3


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
    files = {"h.urdf": claw(written.format("secret.stl")).encode()}
    found = verdicts(files, "h.urdf", tmp_path / "h")
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
        (
            {"h.xacro": b'<robot xmlns:xacro="u"><xacro:include filename="a.xacro"/></robot>', "a.xacro": POINTER},
            "'a.xacro', which",
        ),
    ],
)
def test_a_pointer_among_the_files_of_a_hand_is_told(files: dict[str, bytes], pointer: str, tmp_path: Path) -> None:
    for told in verdicts(files, next(iter(files)), tmp_path):
        assert f"{pointer} is a Git LFS pointer, not the file itself: git lfs pull" in told
