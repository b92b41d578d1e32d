"""What an export wrote is opened by a library of its target before the export says that it is done."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd.exchange.opening import READERS, opened
from graspd.service.model.errors import GraspdError


@pytest.mark.parametrize("suffix", sorted(READERS))
def test_a_file_that_its_library_cannot_read_is_named(suffix: str, tmp_path: Path) -> None:
    with pytest.raises(GraspdError, match=rf"broken\{suffix} was written but .* cannot read it"), opened(tmp_path):
        (tmp_path / f"broken{suffix}").write_bytes(b"\x00<broken\n1,2\xff")


def test_files_that_were_there_before_are_not_looked_at(tmp_path: Path) -> None:
    (tmp_path / "old.xml").write_bytes(b"broken")
    with opened(tmp_path):
        (tmp_path / "new.json").write_text("{}")


def test_a_file_that_is_written_anew_is_looked_at(tmp_path: Path) -> None:
    (tmp_path / "scene.xml").write_text("<mujoco/>")
    with pytest.raises(GraspdError, match="scene"), opened(tmp_path):
        (tmp_path / "scene.xml").write_text("<mujoco><tendon><fixed/></tendon></mujoco>")
