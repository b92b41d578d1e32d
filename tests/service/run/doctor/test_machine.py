"""Machine and store as the doctor sees them, and checks side by side."""

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import IO
from unittest.mock import Mock

import obstore
import pytest
from obstore.store import MemoryStore

from graspd.service.model.errors import StoreUnavailable
from graspd.service.run.doctor.backends import check_configured_store, check_store
from graspd.service.run.doctor.checks import Check, Condition, Finding, good, run_checks
from graspd.service.run.doctor.machine import check_data_folder, check_disk, check_limits, filesystem_type
from graspd.service.settings import Settings
from graspd.service.store.store import Store, open_store

GIB = 2**30


@pytest.mark.parametrize(
    ("free", "condition"), [(100 * GIB, Condition.GOOD), (3 * GIB, Condition.WARNING), (GIB // 2, Condition.BAD)]
)
def test_room_is_validated_by_the_fullest_disk(tmp_path: Path, free: int, condition: Condition) -> None:
    settings = Settings(data_dir=tmp_path / "data", store_url=(tmp_path / "far").as_uri())
    (tmp_path / "far").mkdir()
    found = check_disk(settings, usage=lambda folder: (0, 0, free if folder == tmp_path / "far" else 200 * GIB))
    assert found.condition is condition
    if condition is not Condition.GOOD:
        assert str(tmp_path / "far") in found.message and "GRASPD_STORE_URL" in found.fix


def test_a_data_folder_that_others_can_read_is_told(tmp_path: Path) -> None:
    tmp_path.chmod(0o755)
    found = check_data_folder(Settings(data_dir=tmp_path))
    assert found.condition is Condition.WARNING and found.fix == f"chmod 700 {tmp_path}"
    tmp_path.chmod(0o700)
    assert check_data_folder(Settings(data_dir=tmp_path)).condition is Condition.GOOD


def test_a_data_folder_on_a_network_is_told(tmp_path: Path) -> None:
    mounts = tmp_path / "mounts"
    kinds = f"/dev/sda / ext4 rw 0 0\nserver:/home {tmp_path} nfs4 rw 0 0\ntmpfs {tmp_path}/tmp tmpfs rw 0 0\n"
    mounts.write_text(kinds)
    folder = tmp_path / "data"
    found = check_data_folder(Settings(data_dir=folder), mounts=mounts)
    assert found.condition is Condition.WARNING and "nfs4" in found.message
    elsewhere = Settings(data_dir=folder, redis_url="redis://other", index_url="postgresql+psycopg://other/graspd")
    assert check_data_folder(elsewhere, mounts=mounts).condition is Condition.GOOD
    for path, kind in ((folder, "nfs4"), (tmp_path / "tmp" / "x", "tmpfs"), (Path("/etc"), "ext4")):
        assert filesystem_type(path, mounts) == kind
    assert not folder.exists()


@pytest.mark.skipif(os.getuid() == 0, reason="root may write everywhere")
def test_a_data_folder_that_cannot_be_written_is_bad(tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    assert not check_data_folder(Settings(data_dir=tmp_path / "data")).ok


def test_few_files_and_little_memory_are_told() -> None:
    assert check_limits(files=4096, memory=16 * GIB).condition is Condition.GOOD
    assert "ulimit" in check_limits(files=256, memory=16 * GIB).fix
    assert "more memory" in check_limits(files=4096, memory=GIB).fix


def test_findings_come_in_order_and_one_that_hangs_is_bad() -> None:
    hold = threading.Event()

    def hang() -> Finding:
        hold.wait(30)
        return good("late")

    away = Mock(side_effect=StoreUnavailable("the store is away"))
    checks = [
        Check("hangs", hang, limit_s=0.05, mend_hang="restart it"),
        Check("breaks", Mock(side_effect=ZeroDivisionError("by nothing"))),
        Check("away", away),
        Check("good", lambda: good("fine")),
    ]
    try:
        found = list(run_checks(checks))
    finally:
        hold.set()
    assert [one.name for one in found] == ["hangs", "breaks", "away", "good"]
    assert [one.condition for one in found] == [Condition.BAD] * 3 + [Condition.GOOD]
    assert found[0].fix == "restart it" and "ZeroDivisionError: by nothing" in found[1].message
    assert found[2].message == "the store is away"


def test_a_folder_is_good_and_nothing_is_left_in_it(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    assert check_configured_store(settings).condition is Condition.GOOD
    assert not (tmp_path / "store").exists(), "a look makes no store"
    (tmp_path / "store").mkdir()
    found = check_configured_store(settings)
    assert found.condition is Condition.GOOD, found
    assert [path for path in (tmp_path / "store").rglob("*") if path.is_file()] == []


@pytest.mark.s3
def test_a_bucket_is_good_and_nothing_is_left_in_it(tmp_path: Path, s3_url: str) -> None:
    found = check_configured_store(Settings(data_dir=tmp_path, store_url=s3_url))
    assert found.ok, found
    assert "create-only writes work" in found.message
    assert list(open_store(s3_url).list("health")) == []


@pytest.mark.s3
def test_a_wrong_secret_names_its_variables(tmp_path: Path, s3_url: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "of-somebody-else")
    found = check_configured_store(Settings(data_dir=tmp_path, store_url=s3_url))
    assert not found.ok and "AWS_SECRET_ACCESS_KEY" in found.fix and "of-somebody-else" not in str(found)


def test_a_store_in_memory_is_gone_with_its_process() -> None:
    assert check_store(open_store("memory://")).condition is Condition.WARNING


def overwrite(store: Store, key: str, file: IO[bytes]) -> bool:
    """As S3 servers do that know no conditional put."""
    file.seek(0)
    obstore.put(store._backend, key, file.read(), mode="overwrite")
    return True


@pytest.mark.parametrize(
    ("method", "other", "word"),
    [
        ("put_file", overwrite, "overwritten"),
        ("list", lambda *_, **__: iter(()), "missing in the list"),
        ("exists", lambda *_: True, "still there"),
    ],
)
def test_a_store_that_breaks_a_promise_is_bad(
    method: str, other: Callable[..., object], word: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Store, method, other)
    found = check_store(Store(MemoryStore(), "fake://"))
    assert not found.ok and word in found.message
