"""What an archive without memory to read it says."""

from __future__ import annotations

import zipfile
import zlib

import pytest

from graspd.service.store.assets import pack, unpack


def test_a_machine_without_memory_damages_no_archive(monkeypatch: pytest.MonkeyPatch) -> None:
    def starved(*_: object) -> bytes:
        raise zlib.error("Error -4 while decompressing data")

    data = pack({"asset.json": b"{}"})
    monkeypatch.setattr(zipfile.ZipExtFile, "read", starved)
    with pytest.raises(MemoryError):
        unpack(data, limit_bytes=100)
