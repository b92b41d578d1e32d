"""What is sent of a hand on the user's disk: its own files, and nothing that lies elsewhere."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd.client.add_commands import upload_of
from graspd.service.model.errors import InputError
from graspd.service.store.assets import unpack

MESH = '<mesh filename="{}"/>'


@pytest.fixture
def hand(tmp_path: Path) -> Path:
    """A folder with a URDF, its meshes, other things, and a secret beside it."""
    folder = tmp_path / "claw"
    (folder / "meshes").mkdir(parents=True)
    for name in ("a.stl", "b.stl", "c.stl"):
        (folder / "meshes" / name).write_bytes(name.encode())
    (folder / "README.md").write_text("notes")
    (tmp_path / "secret.stl").write_text("secret")
    (folder / "link.stl").symlink_to(tmp_path / "secret.stl")
    named = ("meshes/a.stl", "package://claw/meshes/b.stl", "../secret.stl", "link.stl", "meshes/missing.stl")
    (folder / "claw.urdf").write_text(f"<robot>{''.join(MESH.format(name) for name in named)}</robot>")
    return folder


def sent(path: Path) -> set[str]:
    with upload_of(path) as (upload, _):
        return set(unpack(upload.read_bytes(), limit_bytes=10_000))


def test_a_urdf_brings_the_meshes_that_it_names(hand: Path) -> None:
    assert sent(hand / "claw.urdf") == {"claw.urdf", "meshes/a.stl", "meshes/b.stl"}


def test_a_folder_brings_urdf_and_all_meshes_inside(hand: Path) -> None:
    (hand / "asset.json").write_text("{}")
    assert sent(hand) == {"asset.json", "claw.urdf", "meshes/a.stl", "meshes/b.stl", "meshes/c.stl"}


def test_the_upload_is_named_after_the_hand(hand: Path) -> None:
    for path in (hand, hand / "claw.urdf"):
        with upload_of(path) as (upload, _):
            assert upload.name == "claw.zip"
        assert not upload.exists()


def test_other_files_are_sent_as_they_are(hand: Path, tmp_path: Path) -> None:
    (tmp_path / "plain.urdf").write_text("<robot/>")
    for path in (tmp_path / "plain.urdf", tmp_path / "hand.zip", tmp_path / "missing.urdf"):
        with upload_of(path) as (upload, _):
            assert upload == path


def test_a_folder_without_a_urdf_is_a_mistake(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no URDF"), upload_of(tmp_path):
        pass
