"""A folder of meshes becomes a set of objects; an archive without memory to read it is told."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from unittest.mock import Mock

import pytest

from graspd.service.model.errors import InputError, LimitError
from graspd.service.store.assets import pack, unpack
from graspd.service.store.object_sets import object_set, read_set


def names(*paths: str) -> dict[str, list[str]]:
    return {name: sorted(files) for name, files in object_set(dict.fromkeys(paths, b"x")).items()}


def test_a_flat_folder_gives_one_object_a_mesh() -> None:
    assert names("egad/A0.obj", "egad/B3.obj", "egad/readme.txt") == {"A0": ["A0.obj"], "B3": ["B3.obj"]}


def test_a_folder_an_object_takes_the_best_mesh_of_each() -> None:
    found = names(
        "ycb/003_cracker_box/google_16k/nontextured.stl",
        "ycb/003_cracker_box/google_16k/textured.obj",
        "ycb/025_mug/google_16k/textured.obj",
        "ycb/025_mug/google_16k/textured.mtl",
    )
    assert found == {"003_cracker_box": ["nontextured.stl"], "025_mug": ["textured.obj"]}


def test_asset_json_beside_a_mesh_goes_with_it() -> None:
    assert names("a/clean.stl", "a/asset.json", "b/clean.stl") == {"a": ["asset.json", "clean.stl"], "b": ["clean.stl"]}


def test_names_are_made_fit_for_the_service_and_stay_apart() -> None:
    assert set(names("x/my mug!.stl", "x/my_mug_.stl")) == {"my_mug_", "my_mug_-2"}
    with pytest.raises(InputError, match="no mesh"):
        object_set({"a.txt": b""})


def test_the_reference_objects_are_recognised(shared_data: Path) -> None:
    found = object_set(read_set(shared_data / "objects", limit_bytes=2**26))
    assert len(found) == 14 and list(found["025_mug"]) == ["clean.stl"]


def test_a_link_out_of_the_folder_is_left_alone_and_too_large_a_set_refused(tmp_path: Path) -> None:
    (tmp_path / "secret.stl").write_bytes(b"secret")
    (tmp_path / "set").mkdir()
    (tmp_path / "set" / "a.stl").write_bytes(b"x" * 100)
    (tmp_path / "set" / "b.stl").symlink_to(tmp_path / "secret.stl")
    assert list(read_set(tmp_path / "set", limit_bytes=100)) == ["a.stl"]
    with pytest.raises(LimitError):
        read_set(tmp_path / "set", limit_bytes=99)


def test_a_machine_without_memory_damages_no_archive(monkeypatch: pytest.MonkeyPatch) -> None:
    data = pack({"asset.json": b"{}"})
    monkeypatch.setattr(zipfile.ZipExtFile, "read", Mock(side_effect=zlib.error("Error -4 while decompressing data")))
    with pytest.raises(MemoryError):
        unpack(data, limit_bytes=100)
