"""A turned byte of anything in the store is found and named; the controller's integrity scan makes way for others."""

import io
import random
import re
import threading
from pathlib import Path
from typing import Final

import numpy as np
import pytest
from typer.testing import CliRunner

from graspd.service.index.rebuild import rebuild
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import DamagedError
from graspd.service.model.records import AttemptRecord, JobRecord, ObjectSet, Tag
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.webhooks import Webhook
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.identity import ServiceRecord
from graspd.service.pipeline.integrity import (
    FOLDERS,
    MISSING,
    NO_MANIFEST,
    IntegrityScan,
    ScanInterrupted,
    examine,
    repair,
    scan,
)
from graspd.service.run.store_commands import app
from graspd.service.settings import Settings
from graspd.service.store import records
from graspd.service.store.assets import pack as pack_files
from graspd.service.store.integrity import put_document, put_sealed
from graspd.service.store.library import builtin_assets, load_check, publish_builtins, store_files
from graspd.service.store.manifests import ShardManifest, load_manifest
from tests.damage import flip, flipped, overwrite, remove
from tests.fakes import HAND_FILES, OBJECT_FILES, make_shard, message_for, request, tasks_of, with_settings
from tests.indexes import open_services
from tests.waiting import PATIENCE_S, Pauses, until

#: Flips of each object: with some thirty objects more than the 265 that were once tried by hand.
FLIPS: Final = 15
#: Kinds of keys: digests and numbers do not count.
_ID: Final = re.compile(r"[0-9a-f]{32}|[0-9]+|T[0-9]+Z")


@pytest.fixture
def full(services: Services) -> Services:
    """A store with an object of every kind."""
    store = services.store
    job, _ = job_actions.submit(services, request(grasps=96))
    record = records.read_record(JobRecord, store, names.job_record_key(job.id))
    lone, first, _ = tasks_of(record)
    services.index.write.add_manifests([make_shard(store, lone)])
    records.add_job_event(store, job.id, "cancelled")
    attempt = {"task_id": first.task_id, "job_id": job.id, "stage": Stage.SYNTHESIZE, "number": 1, "kind": "Error"}
    failed = AttemptRecord(**attempt, reason="broke", worker="w", ended=timestamp(), last=False)
    records.put_record(store, names.attempt_key(first.task_id, 1), failed)
    actions.create(services, DatasetRequest(name="all", hands=["gripper"], objects=["ball"], grasps=96))
    services.index.write_dataset.set_progress("all", planned=True)
    actions.cancel(services, "all")
    actions.take_snapshot(services, "all")
    actions.add_object_set(services, "balls", ["ball"])
    records.put_record(
        store, f"{names.DELETIONS}/job/{'e' * 32}.json", records.Deletion(what="job", id="e" * 32, at=timestamp())
    )
    records.put_record(store, f"{names.RELEASED}/1-{job.id}.json", records.DeletedJob(at=timestamp(), job=record))
    gone = records.Deletion(what="job", id="b" * 32, at=timestamp())
    records.put_record(store, f"{records.removed_folder(gone)}/deletion.json", gone)
    records.put_record(store, f"{records.removed_folder(gone)}/{names.job_record_key(gone.id)}", record)
    records.put_record(store, f"{names.SERVICE}/000001.json", ServiceRecord(id="c" * 32, at=timestamp()))
    put_document(store, names.mark_key("d" * 32), {"at": timestamp()})
    hand = services.index.assets.get(AssetKind.HAND, "gripper").digest
    put_document(store, names.asset_key(AssetKind.HAND, hand, "expanded.json"), {"urdf": "<robot name='claw'/>"})
    hook = Webhook(id="f" * 32, url="https://example.org/", states=("succeeded",), created=timestamp())
    records.put_record(store, names.webhook_key(hook.id), hook)
    tag = Tag(id="a" * 32, name="good", number=1, created=timestamp(), changed=timestamp())
    records.put_record(store, names.tag_version_key(tag.id, 1), tag)
    for kind in ("charts", "scene_charts/table", "stability"):
        records.publish_record(store, kind, {"created": timestamp(), "runs": [1.0, 2.0]})
    publish_builtins(store)
    ball = services.index.assets.get(AssetKind.OBJECT, "ball").digest
    file = io.BytesIO()
    np.savez(file, vertices=np.arange(30.0))
    put_sealed(store, names.asset_key(AssetKind.OBJECT, ball, f"prepared/{'1' * 32}.npz"), file.getvalue())
    put_sealed(store, names.asset_key(AssetKind.OBJECT, ball, f"pieces/{'2' * 32}.npz"), file.getvalue())
    return services


def test_every_flipped_byte_is_found_and_named(full: Services) -> None:
    draw, missed, candidates = random.Random(45), [], 0
    kinds = {_ID.sub("*", entry.key): entry.key for folder in FOLDERS for entry in full.store.list(folder)}
    keys = sorted(kinds.values())
    for key in keys:
        data = full.store.get(key)
        for at in draw.sample(range(len(data)), FLIPS):
            overwrite(full.store, key, data[:at] + bytes([data[at] ^ 1 << draw.randrange(8)]) + data[at + 1 :])
            # The file of a shard is examined with its manifest.
            wrong = examine(full.store, re.sub(r"\.h5$", ".json", key))
            candidates += 1
            if wrong is None or wrong.key != key:
                missed.append((key, at))
        overwrite(full.store, key, data)
    assert missed == []
    assert candidates >= 265
    assert {key.partition("/")[0] for key in keys} == set(FOLDERS)
    assert [wrong for _, wrong in scan(full.store) if wrong is not None] == []


def test_a_damaged_manifest_is_neither_read_nor_indexed(full: Services) -> None:
    manifest = next(entry.key for entry in full.store.list(names.SHARDS) if entry.key.endswith(".json"))
    data = full.store.get(manifest)
    at = data.index(b'"epsilon":0.') + len(b'"epsilon":0.')
    overwrite(full.store, manifest, data[:at] + (b"9" if data[at : at + 1] != b"9" else b"1") + data[at + 1 :])
    with pytest.raises(DamagedError, match=re.escape(manifest)):
        load_manifest(full.store, Stage.SYNTHESIZE, manifest[-37:-5])
    assert rebuild(full.index, full.store)["left_out"] == 1
    made = full.index.notes.completeness()
    assert made is not None and made.names == (manifest,)


def test_what_an_earlier_graspd_wrote_is_read_and_counted(services: Services) -> None:
    found = ObjectSet(name="c" * 64, digest="a" * 32, objects=("ball",), created=timestamp())
    key, without = names.object_set_key(found.name, found.digest), list[str]()
    services.store.put(key, found.model_dump_json().encode())
    zipped = names.asset_key(AssetKind.OBJECT, services.index.assets.get(AssetKind.OBJECT, "ball").digest, "files.zip")
    overwrite(services.store, zipped, pack_files(OBJECT_FILES))
    assert records.read_record(ObjectSet, services.store, key) == found
    assert [wrong for _, wrong in scan(services.store, unsealed=without.append) if wrong is not None] == []
    assert {key, zipped} <= set(without)


def test_files_of_an_upload_replace_damaged_ones_and_match_their_name(services: Services) -> None:
    key = names.asset_key(AssetKind.HAND, services.index.assets.get(AssetKind.HAND, "gripper").digest, "files.zip")
    overwrite(services.store, key, flipped(services.store.get(key)))
    store_files(services.store, AssetKind.HAND, "gripper", HAND_FILES)
    assert examine(services.store, key) is None
    overwrite(services.store, key, pack_files(HAND_FILES | {"hand.urdf": b"<robot name='other'/>"}))
    wrong = examine(services.store, key)
    assert wrong is not None and "its files do not match its name" in wrong.what


@pytest.mark.parametrize("file", ["model.glb", "check.json"])
def test_what_a_check_found_is_made_again(services: Services, file: str) -> None:
    ball = services.index.assets.get(AssetKind.OBJECT, "ball").digest
    folder = names.asset_key(AssetKind.OBJECT, ball, "check.json").rpartition("/")[0]
    put_document(services.store, f"{folder}/check.json", {"verdict": "accept"})
    put_sealed(services.store, f"{folder}/model.glb", b"glTF" + bytes(8) + b"\4\0\0\0JSON{}  ")
    overwrite(services.store, f"{folder}/{file}", flipped(services.store.get(f"{folder}/{file}")))
    found = [wrong for _, wrong in scan(services.store) if wrong is not None]
    repaired, left = repair(services, found)
    assert [one.key for one in repaired] == [f"{folder}/{file}"]
    assert left == []
    assert load_check(services.store, AssetKind.OBJECT, ball) is None
    assert [check.digest for check in services.index.feed.ready_checks(now=1e12, limit=9)] == [ball]


def test_what_comes_with_graspd_is_put_again(services: Services) -> None:
    publish_builtins(services.store)
    mug = next(asset for asset in builtin_assets() if asset.kind is AssetKind.OBJECT)
    folder = names.asset_key(mug.kind, mug.digest, "asset.json").rpartition("/")[0]
    for file in ("asset.json", "files.zip", "model.glb"):
        overwrite(services.store, f"{folder}/{file}", flipped(services.store.get(f"{folder}/{file}")))
    _, left = repair(services, [wrong for _, wrong in scan(services.store) if wrong is not None])
    assert left == []
    assert [wrong for _, wrong in scan(services.store) if wrong is not None] == []


def test_charts_of_one_moment_are_all_kept(services: Services) -> None:
    at = timestamp()
    keys = [records.publish_record(services.store, "charts", {"created": at, "runs": [number]}) for number in range(12)]
    assert len(set(keys)) == 12
    found = records.latest_record(services.store, "charts")
    assert found is not None and found["runs"] == [11]


@pytest.fixture
def shards(services: Services) -> list[ShardManifest]:
    return [make_shard(services.store, message_for(seed=seed)) for seed in range(4)]


def a_round(services: Services, stop: Pauses | None = None) -> None:
    stop = stop or Pauses()
    scan = IntegrityScan(services, stop, clock=stop.clock)
    for _ in FOLDERS:
        scan.advance()
    assert services.index.notes.scan_note().ended


def found(services: Services) -> dict[str, str]:
    return {one.shard: one.what for one in services.index.damage.summary()[1]}


def test_a_round_notes_what_is_damaged_and_nothing_else(services: Services, shards: list[ShardManifest]) -> None:
    a_round(services)
    assert services.index.damage.summary() == (0, [])
    services.index.notes.set_scan_note(type(services.index.notes.scan_note())())
    flip(services.store, shards[0].key)
    remove(services.store, shards[1].key)
    a_round(services)
    noted = found(services)
    assert noted.keys() == {shards[0].shard_id, shards[1].shard_id} and "SHA-256" in noted[shards[0].shard_id]
    assert noted[shards[1].shard_id] == MISSING


def test_what_is_mended_or_removed_since_is_forgotten(services: Services, shards: list[ShardManifest]) -> None:
    whole = services.store.get(shards[0].key)
    services.store.put("shards/base/notes.txt", b"mine")
    for manifest in shards[:3]:
        flip(services.store, manifest.key)
    a_round(services)
    assert services.index.damage.summary()[0] == 4
    overwrite(services.store, shards[0].key, whole)
    remove(services.store, names.shard_manifest_key(shards[1].stage, shards[1].shard_id))
    remove(services.store, shards[1].key)
    remove(services.store, "shards/base/notes.txt")
    IntegrityScan(services, Pauses()).recheck_damage()
    assert found(services).keys() == {shards[2].shard_id}


def test_a_file_whose_manifest_may_be_on_its_way_is_no_damage(services: Services, shards: list[ShardManifest]) -> None:
    remove(services.store, names.shard_manifest_key(shards[0].stage, shards[0].shard_id))
    a_round(services)
    assert NO_MANIFEST not in found(services).values()


def test_it_reads_no_faster_than_the_settings_say(services: Services, shards: list[ShardManifest]) -> None:
    size = sum(manifest.size_bytes for manifest in shards)
    stop = Pauses()
    a_round(with_settings(services, integrity_scan_mb_per_s=size / 2**20 / 100), stop)
    assert stop.now > 99.0


def test_a_successor_goes_on_where_it_stopped(services: Services, shards: list[ShardManifest]) -> None:
    for manifest in shards:
        flip(services.store, manifest.key)
    ordered = sorted(names.shard_manifest_key(one.stage, one.shard_id) for one in shards)
    note = services.index.notes.scan_note()
    services.index.notes.set_scan_note(type(note)(started="2026-01-01T00:00:00.000Z", after=ordered[1]))
    a_round(services)
    assert {names.shard_manifest_key(shards[0].stage, shard) for shard in found(services)} == set(ordered[2:])


def test_a_small_store_is_not_read_over_and_over(services: Services, shards: list[ShardManifest]) -> None:
    a_round(services)
    flip(services.store, shards[0].key)
    scan = IntegrityScan(services, Pauses())
    assert not scan.advance()
    note = services.index.notes.scan_note()
    services.index.notes.set_scan_note(type(note)(**vars(note) | {"started": "2026-01-01T00:00:00.000Z"}))
    assert scan.advance()
    assert found(services).keys() == {shards[0].shard_id}


def test_it_makes_way_for_a_verify_and_goes_on_afterwards(services: Services, shards: list[ShardManifest]) -> None:
    stop = Pauses()
    scan = IntegrityScan(services, stop, clock=stop.clock)
    assert services.index.notes.pause_scan(15.0, begin=True)
    stop.now += 10.0
    with pytest.raises(ScanInterrupted):
        scan.advance()
    assert not services.index.notes.pause_scan(15.0, begin=True)
    assert services.index.notes.pause_scan(0.0)
    assert scan.advance()


def test_a_second_verify_is_refused(tmp_path: Path) -> None:
    other = open_services(Settings(data_dir=tmp_path))
    assert other.index.notes.pause_scan(15.0, begin=True)
    refused = CliRunner().invoke(app, ["store", "verify", "--data-dir", str(tmp_path)])
    other.close()
    assert refused.exit_code == 2 and "another `graspd admin store verify`" in refused.output


@pytest.mark.parametrize("rate", [100.0, 0.0])
def test_the_controller_scans_unless_it_is_off(services: Services, shards: list[ShardManifest], rate: float) -> None:
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
