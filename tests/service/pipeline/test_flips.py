"""One byte that turned, anywhere in anything that the store keeps: found, named, and not believed."""

from __future__ import annotations

import io
import random
import re
from typing import Final

import numpy as np
import pytest

from graspd.service.index.rebuild import rebuild
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import DamagedError
from graspd.service.model.records import AttemptRecord, JobRecord, ObjectSet, Tag
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.webhooks import Webhook
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.identity import ServiceRecord
from graspd.service.pipeline.integrity import FOLDERS, examine, scan
from graspd.service.pipeline.repair import repair
from graspd.service.store.assets import pack as pack_files
from graspd.service.store.integrity import put_document, put_sealed
from graspd.service.store.library import builtin_assets, load_check, publish_builtins, store_files
from graspd.service.store.manifests import load_manifest
from graspd.service.store.records import (
    DeletedJob,
    Deletion,
    add_job_event,
    latest,
    publish,
    put_record,
    read_record,
    removed_folder,
)
from tests.damage import flipped, overwrite
from tests.fakes import HAND_FILES, OBJECT_FILES, make_shard, request
from tests.packs import tasks_of

#: Flips of each object: with some thirty objects more than the 265 that were once tried by hand.
FLIPS: Final = 15
#: Kinds of keys: digests and numbers do not count.
_ID: Final = re.compile(r"[0-9a-f]{32}|[0-9]+|T[0-9]+Z")


@pytest.fixture
def full(services: Services) -> Services:
    """A store with an object of every kind."""
    store = services.store
    job, _ = job_actions.submit(services, request(grasps=96))
    record = read_record(JobRecord, store, names.job_record(job.id))
    lone, first, _ = tasks_of(record)
    manifest = make_shard(store, lone)
    services.index.write.add_manifests([manifest])
    add_job_event(store, job.id, "cancelled")
    attempt = {"task_id": first.task_id, "job_id": job.id, "stage": Stage.SYNTHESIZE, "number": 1, "kind": "Error"}
    failed = AttemptRecord(**attempt, reason="broke", worker="w", ended=timestamp(), last=False)
    put_record(store, names.attempt(first.task_id, 1), failed)
    actions.create(services, DatasetRequest(name="all", hands=["gripper"], objects=["ball"], grasps=96))
    services.index.write_dataset.set_progress("all", planned=True)
    actions.cancel(services, "all")
    actions.snapshot(services, "all")
    actions.add_object_set(services, "balls", ["ball"])
    put_record(store, f"{names.DELETIONS}/job/{'e' * 32}.json", Deletion(what="job", id="e" * 32, at=timestamp()))
    put_record(store, f"{names.RELEASED}/1-{job.id}.json", DeletedJob(at=timestamp(), job=record))
    gone = Deletion(what="job", id="b" * 32, at=timestamp())
    put_record(store, f"{removed_folder(gone)}/deletion.json", gone)
    put_record(store, f"{removed_folder(gone)}/{names.job_record(gone.id)}", record)
    put_record(store, names.service(1), ServiceRecord(id="c" * 32, at=timestamp()))
    put_document(store, names.mark("d" * 32), {"at": timestamp()})
    hand = services.index.assets.get(AssetKind.HAND, "gripper").digest
    put_document(store, names.hand_expanded(hand), {"urdf": "<robot name='claw'/>"})
    hook = Webhook(id="f" * 32, url="https://example.org/", states=("succeeded",), created=timestamp())
    put_record(store, names.webhook(hook.id), hook)
    tag = Tag(id="a" * 32, name="good", number=1, created=timestamp(), changed=timestamp())
    put_record(store, names.tag_version(tag.id, 1), tag)
    for kind in ("charts", "scene_charts/table", "stability"):
        publish(store, kind, {"created": timestamp(), "runs": [1.0, 2.0]})
    publish_builtins(store)
    ball = services.index.assets.get(AssetKind.OBJECT, "ball").digest
    file = io.BytesIO()
    np.savez(file, vertices=np.arange(30.0))
    put_sealed(store, names.object_prepared(ball, "1" * 32), file.getvalue())
    put_sealed(store, names.object_pieces(ball, "2" * 32), file.getvalue())
    return services


def keys_of_each_kind(services: Services) -> list[str]:
    """The longest-named of each kind of object, by key; every kind of hand's or object's file is there."""
    kinds = {_ID.sub("*", entry.key): entry.key for folder in FOLDERS for entry in services.store.list(folder)}
    return sorted(kinds.values())


def test_every_flipped_byte_is_found_and_named(full: Services) -> None:
    draw, missed, candidates = random.Random(45), [], 0
    keys = keys_of_each_kind(full)
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
    key, without = names.object_set(found.name, found.digest), list[str]()
    services.store.put(key, found.model_dump_json().encode())
    zipped = names.asset_files(AssetKind.OBJECT, services.index.assets.get(AssetKind.OBJECT, "ball").digest)
    overwrite(services.store, zipped, pack_files(OBJECT_FILES))
    assert read_record(ObjectSet, services.store, key) == found
    assert [wrong for _, wrong in scan(services.store, unsealed=without.append) if wrong is not None] == []
    assert {key, zipped} <= set(without)


def test_files_of_an_earlier_upload_are_held_against_their_name(services: Services) -> None:
    key = names.asset_files(AssetKind.HAND, services.index.assets.get(AssetKind.HAND, "gripper").digest)
    overwrite(services.store, key, pack_files(HAND_FILES | {"hand.urdf": b"<robot name='other'/>"}))
    wrong = examine(services.store, key)
    assert wrong is not None and "its files are not those of its name" in wrong.what


def test_a_damaged_upload_is_replaced_by_the_same_files(services: Services) -> None:
    key = names.asset_files(AssetKind.HAND, services.index.assets.get(AssetKind.HAND, "gripper").digest)
    overwrite(services.store, key, flipped(services.store.get(key)))
    store_files(services.store, AssetKind.HAND, "gripper", HAND_FILES)
    assert examine(services.store, key) is None


@pytest.mark.parametrize("file", ["model.glb", "check.json"])
def test_what_a_check_found_is_made_again(services: Services, file: str) -> None:
    ball = services.index.assets.get(AssetKind.OBJECT, "ball").digest
    folder = names.asset_check(AssetKind.OBJECT, ball).rpartition("/")[0]
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
    folder = names.asset_record(mug.kind, mug.digest).rpartition("/")[0]
    for file in ("asset.json", "files.zip", "model.glb"):
        overwrite(services.store, f"{folder}/{file}", flipped(services.store.get(f"{folder}/{file}")))
    _, left = repair(services, [wrong for _, wrong in scan(services.store) if wrong is not None])
    assert left == []
    assert [wrong for _, wrong in scan(services.store) if wrong is not None] == []


def test_charts_of_one_moment_are_all_kept(services: Services) -> None:
    at = timestamp()
    keys = [publish(services.store, "charts", {"created": at, "runs": [number]}) for number in range(12)]
    assert len(set(keys)) == 12
    found = latest(services.store, "charts")
    assert found is not None and found["runs"] == [11]
