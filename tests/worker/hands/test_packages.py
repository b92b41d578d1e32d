"""A hand in the folder of a ROS package: meshes lie beside its URDF's folder, and go by the package's name."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh

from graspd.commands.hands import report_hand
from graspd.worker.hands.load import files_from_path, hand_from_path
from tests.worker.hands.urdfs import joint, link, robot

MESH = '<collision><geometry><mesh filename="{}"/></geometry></collision>'


def package(folder: Path, reference: str, *, manifest: bool, urdf: str = "urdf/claw.urdf") -> Path:
    """A package with a URDF that names one mesh, which lies in `meshes/`."""
    (folder / "meshes").mkdir(parents=True)
    (folder / "meshes" / "finger.stl").write_bytes(trimesh.creation.box((0.01, 0.02, 0.05)).export(file_type="stl"))
    (folder / urdf).parent.mkdir(parents=True, exist_ok=True)
    palm = '<collision><geometry><box size="0.06 0.06 0.02"/></geometry></collision>'
    fingers = [link("a", MESH.format(reference)), link("b", MESH.format(reference))]
    joints = [joint("ja", "palm", "a"), joint("jb", "palm", "b")]
    (folder / urdf).write_bytes(robot(link("palm", palm), *fingers, *joints))
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
    assert sum(piece.kind == "hull" for piece in hand_from_path(urdf).pieces) == 2
    assert report_hand(str(tmp_path))["verdict"] == "accept"


def test_a_workspace_of_several_packages_is_one_upload(tmp_path: Path) -> None:
    package(tmp_path / "src" / "claw_description", "package://parts_description/meshes/finger.stl", manifest=True)
    (tmp_path / "src" / "claw_description" / "meshes").rename(tmp_path / "src" / "meshes")
    parts = tmp_path / "src" / "parts_description"
    parts.mkdir()
    (tmp_path / "src" / "meshes").rename(parts / "meshes")
    assert report_hand(str(tmp_path / "src"))["verdict"] == "accept"


def test_without_a_package_nothing_above_the_urdf_is_read(tmp_path: Path) -> None:
    urdf = package(tmp_path / "hand", "../meshes/finger.stl", manifest=False, urdf="mine/claw.urdf")
    assert set(files_from_path(urdf)[1]) == {"claw.urdf"}
    assert "outside" in report_hand(str(urdf))["message"]
    assert report_hand(str(tmp_path / "hand"))["verdict"] == "accept"


def test_a_path_out_of_the_package_is_refused(tmp_path: Path) -> None:
    (tmp_path / "secret.stl").write_bytes(b"secret")
    urdf = package(tmp_path / "claw_description", "../../secret.stl", manifest=True)
    assert set(files_from_path(urdf)[1]) == {"urdf/claw.urdf"}
    assert "outside" in report_hand(str(urdf))["message"]
