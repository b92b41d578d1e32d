"""Uploads go through files, not through memory."""

from __future__ import annotations

import io
import os
import tracemalloc
import zipfile
from pathlib import Path

import pytest

from graspd.api.uploads import files_of_upload
from graspd.service.model.digests import digest_files
from graspd.service.model.errors import InputError
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.store.assets import pack
from graspd.service.store.library import load_asset_files, publish_asset

MIB = 1 << 20


def folder_of(count: int, size: int) -> bytes:
    """ZIP of a folder with a mesh and textures that do not compress."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("thing/mesh.stl", b"solid x\nendsolid x\n")
        for number in range(count):
            archive.writestr(f"thing/texture-{number}.png", os.urandom(size))
    return buffer.getvalue()


def test_a_zip_is_kept_without_ever_being_whole_in_memory(services: Services, tmp_path: Path) -> None:
    with (tmp_path / "upload.zip").open("w+b") as file:
        file.write(folder_of(3, 8 * MIB))
        tracemalloc.start()
        files = files_of_upload(AssetKind.OBJECT, "thing.zip", file, limit_bytes=32 * MIB)
        asset = publish_asset(services.store, AssetKind.OBJECT, "thing", files)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    # Two pieces of 1 MiB on their way into the store, of 24 MiB.
    assert peak < 3 * MIB
    assert len(load_asset_files(services.store, AssetKind.OBJECT, asset.digest)) == 5


def test_a_zip_on_disk_and_its_files_in_memory_are_the_same_asset() -> None:
    data = folder_of(2, 100_000)
    streamed = files_of_upload(AssetKind.OBJECT, "thing.zip", data, limit_bytes=MIB)
    held = dict(streamed)
    assert digest_files(AssetKind.OBJECT, streamed) == digest_files(AssetKind.OBJECT, held)
    assert pack(streamed) == pack(held)


def test_a_zip_whose_header_understates_its_files_is_refused() -> None:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("mesh.stl", b"0" * 5000)
    data = buffer.getvalue()
    true, false = (5000).to_bytes(4, "little"), (10).to_bytes(4, "little")
    assert data.count(true) == 2
    with pytest.raises(InputError, match="damaged"):
        files_of_upload(AssetKind.OBJECT, "thing.zip", data.replace(true, false), limit_bytes=1000)
