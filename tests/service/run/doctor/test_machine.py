"""The machine as the doctor sees it."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from graspd.service.run.doctor.checks import Condition
from graspd.service.run.doctor.machine import data_folder, disk, filesystem, limits, versions
from graspd.service.settings import Settings

GIB = 2**30


@pytest.mark.parametrize(
    ("free", "condition"), [(100 * GIB, Condition.GOOD), (3 * GIB, Condition.WARNING), (GIB // 2, Condition.BAD)]
)
def test_room_is_validated_by_the_fullest_disk(tmp_path: Path, free: int, condition: Condition) -> None:
    settings = Settings(data_dir=tmp_path / "data", store_url=(tmp_path / "far").as_uri())
    (tmp_path / "far").mkdir()
    found = disk(settings, usage=lambda folder: (0, 0, free if folder == tmp_path / "far" else 200 * GIB))
    assert found.condition is condition
    if condition is not Condition.GOOD:
        assert str(tmp_path / "far") in found.message
        assert "GRASPD_STORE_URL" in found.fix


def test_a_data_folder_that_others_can_read_is_told(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    found = data_folder(Settings(data_dir=tmp_path))
    assert found.condition is Condition.WARNING
    assert found.fix == f"chmod 700 {tmp_path}"
    tmp_path.chmod(0o700)
    assert data_folder(Settings(data_dir=tmp_path)).condition is Condition.GOOD


def test_a_data_folder_on_a_network_is_told_where_locks_are_needed(tmp_path: Path) -> None:
    mounts = tmp_path / "mounts"
    mounts.write_text(
        f"/dev/sda / ext4 rw 0 0\nserver:/home {tmp_path} nfs4 rw 0 0\ntmpfs {tmp_path}/tmp tmpfs rw 0 0\n"
    )
    folder = tmp_path / "data"
    found = data_folder(Settings(data_dir=folder), mounts=mounts)
    assert found.condition is Condition.WARNING
    assert "nfs4" in found.message
    elsewhere = Settings(data_dir=folder, redis_url="redis://other", index_url="postgresql+psycopg://other/graspd")
    assert data_folder(elsewhere, mounts=mounts).condition is Condition.GOOD
    assert [filesystem(path, mounts) for path in (folder, tmp_path / "tmp" / "x", Path("/etc"))] == [
        "nfs4",
        "tmpfs",
        "ext4",
    ]
    assert not folder.exists()


@pytest.mark.skipif(os.getuid() == 0, reason="root may write everywhere")
def test_a_data_folder_that_cannot_be_written_is_bad(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert not data_folder(Settings(data_dir=tmp_path / "data")).ok


def test_this_install_has_the_libraries_it_asks_for() -> None:
    assert versions().condition is Condition.GOOD, versions()


@pytest.mark.parametrize(
    ("requirement", "told"),
    [
        ("redis>=99", "redis>=99 (found "),
        ("no-such-library>=1", "no-such-library>=1 (absent)"),
        ('fastapi<0.1; extra == "api"', "fastapi<0.1 (found "),
        ('no-such-library>=1; extra == "api"', ""),
        ('ruff<0.1; extra == "dev"', ""),
        ('redis>=99; sys_platform == "win32"', ""),
    ],
)
def test_a_library_that_does_not_fit_is_named_with_the_command(requirement: str, told: str) -> None:
    found = versions([requirement])
    assert found.ok is (not told)
    if told:
        assert told in found.message
        assert found.fix == f"pip install '{told.partition(' (')[0]}'"


def test_few_files_and_little_memory_are_told() -> None:
    assert limits(files=4096, memory=16 * GIB).condition is Condition.GOOD
    assert "ulimit" in limits(files=256, memory=16 * GIB).fix
    assert "more memory" in limits(files=4096, memory=GIB).fix
