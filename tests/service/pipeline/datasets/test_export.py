"""Export of a snapshot: files with verified checksums, gone on with after a stop."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Iterator
from pathlib import Path

import h5py
import pytest

from graspd.service.model.errors import DamagedShard, InputError, StoreUnavailable
from graspd.service.model.records import Snapshot, SnapshotShard
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.export import export_shards, path_of
from tests.planning import plan_all
from tests.service.pipeline.datasets.makers import finish, jobs_of, wanted


@pytest.fixture
def snapshot(services: Services) -> Snapshot:
    actions.create(services, wanted(scenes=1))
    plan_all(services)
    for job in jobs_of(services, "grasps"):
        finish(services, job)
    return actions.snapshot(services, "grasps")[0]


class Source:
    """The store as a source of shards, which counts what it gives and can break off."""

    def __init__(self, services: Services, *, breaks_at: int = -1) -> None:
        self._services = services
        self._breaks_at = breaks_at
        self.given = 0

    def __call__(self, shard: SnapshotShard) -> Iterator[bytes]:
        if self.given == self._breaks_at:
            raise StoreUnavailable("away")
        self.given += 1
        yield from self._services.store.stream(shard.key)


def test_every_file_is_there_with_its_checksum(services: Services, snapshot: Snapshot, tmp_path: Path) -> None:
    assert export_shards(snapshot, tmp_path / "out", Source(services)) == 8
    check = subprocess.run(["sha256sum", "-c", "--quiet", "SHA256SUMS"], cwd=tmp_path / "out", check=False)
    assert check.returncode == 0
    assert Snapshot.model_validate_json((tmp_path / "out" / "snapshot.json").read_text()) == snapshot
    with h5py.File(tmp_path / "out" / "claw" / "cube" / "base-00000.h5") as file:
        assert file.attrs["hand"] == "claw" and len(file["grasp/hand_pose"]) == 32


def test_an_export_that_broke_off_is_gone_on_with(services: Services, snapshot: Snapshot, tmp_path: Path) -> None:
    with pytest.raises(StoreUnavailable):
        export_shards(snapshot, tmp_path / "out", Source(services, breaks_at=5))
    assert not (tmp_path / "out" / "snapshot.json").exists() and not list(tmp_path.rglob("*.part"))
    assert export_shards(snapshot, tmp_path / "out", Source(services)) == 3


def test_a_file_that_was_changed_is_fetched_again(services: Services, snapshot: Snapshot, tmp_path: Path) -> None:
    export_shards(snapshot, tmp_path, Source(services))
    spoilt = tmp_path / path_of(snapshot.shards[0])
    spoilt.write_bytes(b"x" * snapshot.shards[0].size_bytes)
    assert export_shards(snapshot, tmp_path, Source(services)) == 1
    assert hashlib.sha256(spoilt.read_bytes()).hexdigest() == snapshot.shards[0].sha256


def test_a_wrong_checksum_leaves_no_file(services: Services, snapshot: Snapshot, tmp_path: Path) -> None:
    with pytest.raises(DamagedShard, match=snapshot.shards[0].id):
        export_shards(snapshot, tmp_path / "out", lambda shard: [b"something else"])
    assert [path for path in (tmp_path / "out").rglob("*") if path.is_file()] == []


def test_a_folder_that_cannot_be_made_is_the_callers_mistake(
    services: Services, snapshot: Snapshot, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be made"):
        export_shards(snapshot, tmp_path / "file" / "out", Source(services))
