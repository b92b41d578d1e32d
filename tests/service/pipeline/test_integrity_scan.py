"""The controller's integrity scan: findings, speed, place to go on from, and whom it makes way for."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from typer.testing import CliRunner

from graspd.service.model import names
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.pipeline.integrity import FOLDERS, MISSING, NO_MANIFEST
from graspd.service.pipeline.integrity_scan import IntegrityScan, Interrupted, ReadPermit
from graspd.service.run.store_commands import app
from graspd.service.settings import Settings
from graspd.service.store.manifests import ShardManifest
from graspd.service.store.store import open_store
from tests.damage import flip, overwrite, remove
from tests.fakes import make_shard, message_for, with_settings
from tests.indexes import empty_index
from tests.memory_queue import MemoryQueue
from tests.waiting import PATIENCE_S, until


class Slept(threading.Event):
    """An event whose waits take no time, but are counted; the clock of whom it is given to."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0

    def wait(self, timeout: float | None = None) -> bool:
        self.now += timeout or 0.0
        return self.is_set()

    def clock(self) -> float:
        return self.now


@pytest.fixture
def shards(services: Services) -> list[ShardManifest]:
    return [make_shard(services.store, message_for(seed=seed)) for seed in range(4)]


def a_round(services: Services, stop: Slept | None = None) -> None:
    stop = stop or Slept()
    scan = IntegrityScan(services, stop, clock=stop.clock)
    for _ in FOLDERS:
        scan.advance()
    scan.turn.end()
    assert services.index.notes.scan_note().ended


def found(services: Services) -> dict[str, str]:
    return {one.shard: one.what for one in services.index.damage.known()[1]}


def test_a_round_notes_what_is_damaged_and_nothing_else(services: Services, shards: list[ShardManifest]) -> None:
    a_round(services)
    assert services.index.damage.known() == (0, [])
    services.index.notes.set_scan_note(type(services.index.notes.scan_note())())
    flip(services.store, shards[0].key)
    remove(services.store, shards[1].key)
    a_round(services)
    noted = found(services)
    assert noted.keys() == {shards[0].shard_id, shards[1].shard_id}
    assert "SHA-256" in noted[shards[0].shard_id]
    assert noted[shards[1].shard_id] == MISSING


def test_what_is_mended_or_removed_since_is_forgotten(services: Services, shards: list[ShardManifest]) -> None:
    whole = services.store.get(shards[0].key)
    services.store.put("shards/base/notes.txt", b"mine")
    for manifest in shards[:3]:
        flip(services.store, manifest.key)
    a_round(services)
    assert services.index.damage.known()[0] == 4
    overwrite(services.store, shards[0].key, whole)
    remove(services.store, names.shard_manifest(shards[1].stage, shards[1].shard_id))
    remove(services.store, shards[1].key)
    remove(services.store, "shards/base/notes.txt")
    IntegrityScan(services, Slept()).look_again()
    assert found(services).keys() == {shards[2].shard_id}


def test_a_file_whose_manifest_may_be_on_its_way_is_no_damage(services: Services, shards: list[ShardManifest]) -> None:
    remove(services.store, names.shard_manifest(shards[0].stage, shards[0].shard_id))
    a_round(services)
    assert NO_MANIFEST not in found(services).values()


def test_it_reads_no_faster_than_the_settings_say(services: Services, shards: list[ShardManifest]) -> None:
    size = sum(manifest.size_bytes for manifest in shards)
    stop = Slept()
    a_round(with_settings(services, integrity_scan_mb_per_s=size / 2**20 / 100), stop)
    assert stop.now > 99.0


def test_a_successor_goes_on_where_it_stopped(services: Services, shards: list[ShardManifest]) -> None:
    for manifest in shards:
        flip(services.store, manifest.key)
    ordered = sorted(names.shard_manifest(one.stage, one.shard_id) for one in shards)
    note = services.index.notes.scan_note()
    services.index.notes.set_scan_note(type(note)(started="2026-01-01T00:00:00.000Z", after=ordered[1]))
    a_round(services)
    assert {names.shard_manifest(shards[0].stage, shard) for shard in found(services)} == set(ordered[2:])


def test_a_small_store_is_not_read_over_and_over(services: Services, shards: list[ShardManifest]) -> None:
    a_round(services)
    flip(services.store, shards[0].key)
    scan = IntegrityScan(services, Slept())
    assert not scan.advance()
    note = services.index.notes.scan_note()
    services.index.notes.set_scan_note(type(note)(**vars(note) | {"started": "2026-01-01T00:00:00.000Z"}))
    assert scan.advance()
    assert found(services).keys() == {shards[0].shard_id}


def test_it_makes_way_for_a_verify_and_goes_on_afterwards(services: Services, shards: list[ShardManifest]) -> None:
    stop = Slept()
    scan = IntegrityScan(services, stop, clock=stop.clock)
    verify = ReadPermit(services, is_controller=False)
    assert verify.is_mine()
    with pytest.raises(Interrupted):
        scan.advance()
    assert not ReadPermit(services, is_controller=False).is_mine()
    assert not ReadPermit(services, is_controller=True).is_mine()
    verify.end()
    assert scan.advance()


def test_a_verify_takes_the_turn_from_a_controller(services: Services) -> None:
    assert ReadPermit(services, is_controller=True).is_mine()
    assert not ReadPermit(services, is_controller=True).is_mine()
    assert ReadPermit(services, is_controller=False).is_mine()


def test_a_second_verify_is_refused(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    index = empty_index(settings.resolved_index_url)
    other = Services(settings, open_store(settings.resolved_store_url), index, MemoryQueue())
    assert ReadPermit(other, is_controller=False).is_mine()
    refused = CliRunner().invoke(app, ["store", "verify", "--data-dir", str(tmp_path)])
    other.close()
    assert refused.exit_code == 2
    assert "another `graspd admin store verify`" in refused.output


@pytest.mark.parametrize("rate", [100.0, 0.0])
def test_the_controller_scans_beside_its_rounds_unless_it_is_off(
    services: Services, shards: list[ShardManifest], rate: float
) -> None:
    flip(services.store, shards[0].key)
    set_so = with_settings(services, integrity_scan_mb_per_s=rate, controller_interval_s=0.05)
    stop = threading.Event()
    thread = threading.Thread(target=Controller(set_so).run, args=(stop,))
    thread.start()
    names_now = {one.name for one in threading.enumerate()}
    try:
        if rate:
            until(lambda: found(services), "the damage is found")
    finally:
        stop.set()
        thread.join(PATIENCE_S)
    assert found(services).keys() == ({shards[0].shard_id} if rate else set())
    assert ("integrity scan" in names_now) <= bool(rate)
    assert not any(one.name == "integrity scan" for one in threading.enumerate())
