"""A description and the names in it as different programs write them: read, or refused for what is the case."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import trimesh

from graspd.api.uploads import files_of_upload
from graspd.commands.hands import report_hand
from graspd.service.model.errors import InputError
from graspd.service.model.states import AssetKind
from graspd.worker.hands.check import check_hand
from tests.worker.hands.mjcfs import CLAW
from tests.worker.hands.urdfs import joint, link, robot

BOX = bytes(trimesh.creation.box((0.01, 0.02, 0.06)).export(file_type="stl"))
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
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for name, data in files.items():
            archive.writestr(f"top/{name}", data)
    try:
        uploaded = check_hand(files_of_upload(AssetKind.HAND, "h.zip", packed.getvalue(), limit_bytes=1 << 22), "h")
    except InputError as error:
        uploaded = {"verdict": "refuse", "message": str(error)}
    found: list[dict[str, Any]] = [report_hand(str(folder / main)), report_hand(str(folder)), uploaded]
    return ["accept" if one["verdict"] == "accept" else one["message"] for one in found]


@pytest.mark.parametrize(
    "data",
    [
        b"\xef\xbb\xbf" + claw().encode(),
        claw().replace("><", ">\r\n<").encode(),
        (DECLARED.format("UTF-16") + claw()).encode("utf-16"),
        (DECLARED.format("UTF-16") + claw()).encode(),
        (DECLARED.format("UTF-32") + claw()).encode("utf-32"),
        (DECLARED.format("gb2312") + claw().replace("<link", "<!-- \u624b --><link", 1)).encode("gb2312"),
        (DECLARED.format("nonsense") + claw()).encode(),
        claw().replace("<link", "<!-- 90\u00b0 --><link", 1).encode("latin-1"),
        ("<!-- a licence -->\n" + DECLARED.format("utf-8") + claw()).encode(),
        ("\n" + DECLARED.format("utf-8") + claw()).encode(),
        claw().replace("<robot", '<robot xmlns="http://www.ros.org"', 1).encode(),
        claw().encode() + b"\n\0\0",
    ],
    ids=[
        "byte order mark",
        "CRLF",
        "UTF-16",
        "UTF-16 that is UTF-8",
        "UTF-32",
        "GB 2312",
        "no encoding",
        "Latin 1",
        "a comment first",
        "a line first",
        "a namespace",
        "padded",
    ],
)
def test_a_urdf_is_read_as_programs_write_it(data: bytes) -> None:
    report = check_hand({"h.urdf": data}, "h")
    assert report["verdict"] == "accept", report["message"]


@pytest.mark.parametrize(
    ("data", "told"),
    [
        (b" \r\n", "h.urdf holds nothing but spaces"),
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
    files = {name: text.encode(coding), "meshes/pad.stl": BOX}
    assert verdicts(files, name, tmp_path) == ["accept"] * 3


@pytest.mark.parametrize(
    ("written", "there"),
    [
        ("Meshes/PAD.STL", "meshes/pad.stl"),
        ("package://any/Meshes/pad.stl", "meshes/pad.stl"),
        ("meshes/pad%20a.stl", "meshes/pad a.stl"),
        ("meshes/pad%20a.stl", "meshes/pad%20a.stl"),
        ("package://any/meshes/pad%20a.stl", "meshes/pad a.stl"),
        ("PACKAGE://any/meshes/pad.stl", "meshes/pad.stl"),
        ("package:/any/meshes/pad.stl", "meshes/pad.stl"),
        ("file:meshes/pad.stl", "meshes/pad.stl"),
        ("model://any/../meshes/pad.stl", "meshes/pad.stl"),
        ("./meshes//x/../pad.stl", "meshes/pad.stl"),
        (" meshes/pad.stl ", "meshes/pad.stl"),
        ("a&amp;b.stl", "a&b.stl"),
        ("meshes&#x5c;pad.stl", "meshes/pad.stl"),
    ],
)
def test_a_mesh_is_found_however_it_is_written(written: str, there: str, tmp_path: Path) -> None:
    assert verdicts({"h.urdf": claw(written).encode(), there: BOX}, "h.urdf", tmp_path) == ["accept"] * 3


@pytest.mark.parametrize("written", ["../{}", "package://any/../../{}", "/{}", "file:///../{}", "%2e%2e/{}", "C:\\{}"])
def test_a_mesh_outside_the_folder_is_read_by_no_spelling(written: str, tmp_path: Path) -> None:
    (tmp_path / "secret.stl").write_bytes(BOX)
    files = {"h.urdf": claw(written.format("secret.stl")).encode()}
    found = verdicts(files, "h.urdf", tmp_path / "h")
    assert all("outside" in one or "not there" in one for one in found)


def test_a_package_that_xacro_finds_holds_the_mesh(tmp_path: Path) -> None:
    text = claw("$(find any)/meshes/pad.stl").encode()
    files = {"urdf/h.xacro": text, "meshes/pad.stl": BOX, "package.xml": b"<package><name>any</name></package>"}
    assert verdicts(files, "urdf/h.xacro", tmp_path) == ["accept"] * 3


def test_a_part_of_a_xacro_file_is_not_taken_for_the_hand(tmp_path: Path) -> None:
    text = claw().replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"', 1)
    text = text.replace("<link", '<xacro:include filename="Parts\\looks.XACRO"/><link', 1)
    files = {"h.xacro": text.encode(), "parts/looks.xacro": b'<robot><material name="red"/></robot>'}
    assert verdicts(files, "h.xacro", tmp_path) == ["accept"] * 3


def test_a_model_whose_meshes_are_named_in_an_included_file_is_read_by_its_name_alone(tmp_path: Path) -> None:
    start, end = CLAW.index("<default>"), CLAW.index("<asset>")
    files = {
        "h.xml": b'<mujoco><compiler angle="degree" meshdir="assets"/><include file="parts/meshes.xml"/>'
        b'<include file="parts/body.xml"/></mujoco>',
        "parts/meshes.xml": b'<mujocoinclude><asset><mesh name="tip" file="Tip.STL" scale="0.001 0.001 0.001"/></asset>'
        b"</mujocoinclude>",
        "parts/body.xml": f"<mujoco>{CLAW[start:end]}{CLAW[CLAW.index('<worldbody>') :]}".encode(),
        "assets/tip.stl": BOX,
    }
    assert verdicts(files, "h.xml", tmp_path) == ["accept"] * 3


@pytest.mark.parametrize(
    ("files", "pointer"),
    [
        ({"h.urdf": claw("a.stl").encode(), "a.stl": POINTER}, "a.stl"),
        ({"h.xml": CLAW.encode(), "meshes/tip.stl": POINTER}, "meshes/tip.stl"),
        ({"h.xml": b'<mujoco><include file="a.xml"/></mujoco>', "a.xml": POINTER}, "a.xml"),
        (
            {"h.xacro": b'<robot xmlns:xacro="u"><xacro:include filename="a.xacro"/></robot>', "a.xacro": POINTER},
            "'a.xacro', which",
        ),
    ],
    ids=["a mesh of a URDF", "a mesh of an MJCF model", "a part of an MJCF model", "a part of a xacro file"],
)
def test_a_pointer_among_the_files_of_a_hand_is_told(files: dict[str, bytes], pointer: str, tmp_path: Path) -> None:
    for told in verdicts(files, next(iter(files)), tmp_path):
        assert f"{pointer} is a Git LFS pointer, not the file itself: git lfs pull" in told
