"""Packs on their way through the keeper: indexed once, found again, taken away with what needed them, mended."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from service.index.rebuild import differences, rebuild
from service.index.sample import compare, draw
from service.model import names
from service.model.ability import need_of
from service.model.clock import timestamp
from service.model.errors import DamagedError, InputError
from service.model.records import JobRecord
from service.model.states import Stage, State
from service.pipeline import job_actions
from service.pipeline.backends import Parts
from service.pipeline.datasets import actions
from service.pipeline.datasets.spec import DatasetRequest
from service.pipeline.deletion import delete_job
from service.pipeline.keeper import Keeper
from service.pipeline.repair import repair
from service.pipeline.scrub import scan
from service.pipeline.sweeper import Sweeper
from service.queue.port import READS_PACKS, Event, EventKind
from service.readers import open_shards
from service.run.store_commands import app
from service.store import packs
from service.store.manifests import publish_shard
from service.store.packs import pack_at, read_manifests
from service.store.parts import part_of
from service.store.records import read_record
from tests.damage import flipped, overwrite
from tests.fakes import request
from tests.packing import made_of, pack, packed_job, tasks_of
from tests.service.pipeline.on_store import parts_on
from tests.service.pipeline.test_keeper import Bench, Clock
from tests.service.pipeline.test_scrub import work_off


@pytest.fixture
def parts(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Parts]:
    yield from parts_on(getattr(request, "param", "files"), request, tmp_path)


@pytest.fixture
def bench(parts: Parts) -> Bench:
    made = Bench(parts)
    made.keeper.round()
    return made


def take_all(parts: Parts) -> list[Any]:
    """What a joined worker has in hand."""
    queue: Any = parts.queue
    return list(iter(lambda: queue.take("w"), None))


def submit(parts: Parts, batches: int, **changes: Any) -> str:
    return job_actions.submit(parts, request(grasps=32 * batches, **changes))[0].id


def record_of(parts: Parts, job: str) -> JobRecord:
    return read_record(JobRecord, parts.store, names.job_record(job))


def end(parts: Parts, deliveries: list[Any]) -> None:
    for delivery in deliveries:
        parts.queue.finish(delivery)  # type: ignore[attr-defined]


def rows_are_of_the_store(parts: Parts) -> None:
    assert differences(parts.index, parts.store) == []
    assert compare(parts.index, parts.store, draw(parts.index, parts.store)) == []


def keys(parts: Parts, prefix: str) -> list[str]:
    return sorted(entry.key for entry in parts.store.list(prefix))


def packed(bench: Bench, batches: int = 3, **changes: Any) -> tuple[str, str]:
    """A finished job whose shards lie in one pack, with the pack's key."""
    job = submit(bench.parts, batches, **changes)
    in_hand = take_all(bench.parts)
    key = packed_job(bench.parts, job)
    end(bench.parts, in_hand)
    bench.pass_time(1)
    assert bench.parts.index.jobs.get(job).state is State.SUCCEEDED
    return job, key


ON_BOTH = pytest.mark.parametrize("parts", ["files", pytest.param("s3", marks=pytest.mark.s3)], indirect=True)


@ON_BOTH
def test_one_event_and_one_object_index_all_shards_of_a_pack(bench: Bench) -> None:
    job, key = packed(bench)
    assert bench.parts.index.jobs.get(job).grasps == 96
    assert all(shard.key.startswith(f"{key}@") for shard in bench.parts.index.shards.page(job=job).items)
    rows_are_of_the_store(bench.parts)
    if bench.parts.store.url.startswith("file:"):
        with pytest.raises(InputError, match="name the store"):
            open_shards(bench.parts.settings.data_dir / "store")
    assert rebuild(bench.parts.index, bench.parts.store)["shards"] == 3
    rows_are_of_the_store(bench.parts)


@pytest.mark.parametrize("ended", [True, False], ids=["the event is lost", "the worker is killed before the event"])
def test_what_is_in_a_pack_is_found_though_nobody_told(bench: Bench, ended: bool) -> None:
    parts = bench.parts
    job = submit(parts, 3)
    in_hand = take_all(parts)
    bench.pass_time(1)
    pack(parts.store, tasks_of(record_of(parts, job)))
    if ended:
        end(parts, in_hand)
    bench.pass_time(12)
    assert parts.index.jobs.get(job).state is State.SUCCEEDED
    assert not parts.index.jobs.attempts(job=job)
    assert parts.queue.waiting() == set()
    rows_are_of_the_store(parts)


@pytest.mark.parametrize("order", [(0, 1, 2), (2, 1, 0), (1, 2, 0)])
def test_a_shard_that_was_made_three_times_is_counted_once_whichever_is_told_first(
    bench: Bench, order: tuple[int, ...]
) -> None:
    parts = bench.parts
    job = submit(parts, 1)
    (message,) = tasks_of(record_of(parts, job))
    plain, data = made_of(message, worker="plain")
    publish_shard(parts.store, plain, data)
    made = [plain]
    for worker in ("v", "w"):
        found = read_manifests(parts.store, pack_at(parts.store, pack(parts.store, [message], worker=worker)))
        made += [one for one in found if not isinstance(one, DamagedError)]
    for number in order:
        parts.index.write.add_manifest(made[number])
    assert parts.index.shards.get(plain.shard_id).sha256 == plain.sha256
    assert parts.index.jobs.get(job).grasps == 32
    rows_are_of_the_store(parts)


def graceless(parts: Parts) -> Sweeper:
    return Sweeper(
        Parts(parts.settings.model_copy(update={"shard_grace_s": -1.0}), parts.store, parts.index, parts.queue)
    )


def verified(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> dict[str, int]:
    """What `graspd store verify` counts in a store without damage."""
    monkeypatch.setenv("GRASPD_STORE_URL", parts.store.url)
    told = CliRunner().invoke(app, ["store", "verify", "--json", "--data-dir", str(parts.settings.data_dir)])
    assert told.exit_code == 0, told.output
    said = json.loads(told.stdout.splitlines()[-1])
    return {name: said[name] for name in ("shards", "unused_bytes")}


def test_shards_go_from_a_pack_one_by_one_and_the_pack_with_the_last(
    bench: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = bench.parts
    jobs = [submit(parts, 2), submit(parts, 1, seed=7)]
    in_hand = take_all(parts)
    messages = [message for job in jobs for message in tasks_of(record_of(parts, job))]
    key = pack(parts.store, messages)
    parts.queue.publish(Event(kind=EventKind.PACKED, at=timestamp(), worker="w", pack=key))
    made = pack_at(parts.store, key).shards
    end(parts, in_hand)
    bench.pass_time(1)

    def delete(job: str) -> None:
        delete_job(parts, job)
        assert not Sweeper(parts).advance(60)
        assert not graceless(parts).collect(60)
        rows_are_of_the_store(parts)

    delete(jobs[0])
    assert verified(parts, monkeypatch) == {"shards": 1, "unused_bytes": sum(one.length for one in made[:2])}
    assert len(keys(parts, names.PACKS)) == 2, "the pack and what says which of it is gone"
    assert [one.id for one in pack_at(parts.store, key).living] == [messages[2].output]
    assert parts.index.overview.stats().grasps == 32
    again = submit(parts, 2)
    assert parts.index.jobs.get(again).state is State.QUEUED, "it is made anew"
    work_off(parts)
    assert parts.index.jobs.get(again).state is State.SUCCEEDED
    rows_are_of_the_store(parts)
    delete(jobs[1])
    assert keys(parts, names.PACKS) == []
    delete(again)
    assert [*keys(parts, names.SHARDS), *keys(parts, names.RELEASED)] == []


def test_a_removal_that_broke_off_is_carried_out_later(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = bench.parts
    job, _ = packed(bench)
    delete_job(parts, job)
    Sweeper(parts).advance(60)
    with monkeypatch.context() as patch:
        patch.setattr("service.pipeline.sweeper.remove_packed", lambda *_: False)
        assert graceless(parts).collect(60)
    assert not graceless(parts).collect(60)
    assert keys(parts, names.PACKS) == []
    rows_are_of_the_store(parts)


HARMS = {"directory": lambda p, at: 40, "manifest": lambda p, at: p.body + 10, "file": lambda p, at: at + 50}


@pytest.mark.parametrize("harm", HARMS)
def test_a_damaged_pack_is_found_taken_apart_and_made_whole_again(
    bench: Bench, harm: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    parts = bench.parts
    monkeypatch.setattr(packs, "_known", {})
    actions.create(parts, DatasetRequest(name="d", hands=("gripper",), objects=("ball",), grasps=64))
    bench.pass_time(2)
    (job,) = parts.index.jobs.page().items
    in_hand = take_all(parts)
    key = packed_job(parts, job.id)
    end(parts, in_hand)
    bench.pass_time(1)
    shards = parts.index.shards.page(job=job.id).items
    taken, _ = actions.snapshot(parts, "d")
    assert [wrong for _, wrong in scan(parts.store) if wrong is not None] == []
    part = part_of(shards[0].key)
    assert part is not None
    at = HARMS[harm](pack_at(parts.store, key), part.start)
    overwrite(parts.store, key, flipped(parts.store.get(key), at))
    found = [wrong for _, wrong in scan(parts.store) if wrong is not None]
    assert [wrong.key for wrong in found] == [key]
    repaired, left = repair(parts, found)
    assert (repaired, left) == (found, [])
    work_off(parts)
    assert [wrong for _, wrong in scan(parts.store) if wrong is not None] == []
    mended = {shard.id: shard.sha256 for shard in parts.index.shards.page(job=job.id).items}
    assert mended == {shard.id: shard.sha256 for shard in shards}, "made again as it was"
    assert parts.store.exists(f"damaged/{key}")
    rows_are_of_the_store(parts)
    of_snapshot = open_shards(parts.store, dataset="d", snapshot=taken.digest, cache=parts.settings.data_dir / "cache")
    assert len([of_snapshot.path(file) for file in of_snapshot]) == 2, "its places are those in the pack"


def test_a_task_that_reads_a_packed_shard_asks_for_a_worker_that_knows_packs(bench: Bench) -> None:
    parts = bench.parts
    job = submit(parts, 1, scenes=1)
    (first,) = take_all(parts)
    assert need_of(first.message).schema == 2
    packed_job(parts, job)
    end(parts, [first])
    bench.pass_time(2)
    (second,) = take_all(parts)
    assert (second.message.stage, need_of(second.message).schema) == (Stage.SCENE, 3)
    outcome = bench.do(second)
    assert outcome is not None and outcome.kind is EventKind.FINISHED
    bench.pass_time(1)
    assert parts.index.jobs.get(job).state is State.SUCCEEDED
    found = open_shards(parts.store, job=job, cache=parts.settings.data_dir / "cache")
    assert [file.kind for file in found] == ["base", "scene"]


def test_a_pack_that_is_told_and_gone_stops_nothing(bench: Bench) -> None:
    job = submit(bench.parts, 3)
    in_hand = take_all(bench.parts)
    key = packed_job(bench.parts, job)
    bench.parts.store.delete(key)
    end(bench.parts, in_hand)
    bench.pass_time(6)
    assert bench.parts.index.jobs.get(job).state is State.QUEUED
    work_off(bench.parts)
    assert bench.parts.index.jobs.get(job).state is State.SUCCEEDED


def test_a_keeper_says_that_it_reads_packs(parts: Parts) -> None:
    assert not parts.queue.announced(READS_PACKS)
    Keeper(parts, clock=Clock()).round()
    assert parts.queue.announced(READS_PACKS)
