"""A service goes on with a store that graspd 0.2 left in packs, and beside workers that still put some."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import InputError
from graspd.service.model.records import Snapshot
from graspd.service.model.states import Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.repair import repair
from graspd.service.readers import open_shards
from graspd.service.run import commands, store_commands
from graspd.service.store.packs import has_packs
from graspd.service.store.records import put_record
from tests.damage import flipped, overwrite
from tests.fakes import record_of, request
from tests.packs import pack, tasks_of
from tests.service.pipeline.test_controller import Bench
from tests.service.pipeline.test_integrity import findings, service_on, work_off


@pytest.fixture
def services(tmp_path: Path) -> Iterator[Services]:
    yield from service_on(tmp_path, (tmp_path / "store").as_uri())


def submit(services: Services, batches: int) -> tuple[str, list[Any]]:
    """A job, and its first tasks."""
    job, _ = job_actions.submit(services, request(grasps=32 * batches))
    return job.id, tasks_of(record_of(services, job.id))


def is_whole(services: Services, job: str) -> bool:
    return services.index.jobs.get(job).state is State.SUCCEEDED and differences(services.index, services.store) == []


def test_a_controller_takes_packs_apart_when_it_starts(services: Services) -> None:
    job, tasks = submit(services, 3)
    pack(services.store, tasks)
    Bench(services).controller.round()
    assert not has_packs(services.store)
    assert is_whole(services, job)
    assert not services.index.jobs.attempts(job=job)


def test_what_a_worker_of_0_2_packs_meanwhile_is_found(services: Services) -> None:
    bench = Bench(services)
    bench.controller.round()
    job, tasks = submit(services, 3)
    in_hand = [bench.take() for _ in tasks]
    bench.pass_time(1)
    pack(services.store, tasks)  # what it tells of them, an event `packed`, nobody understands any more
    for delivery in in_hand:
        bench.queue.finish(delivery)
    bench.pass_time(6)
    assert not has_packs(services.store)
    assert is_whole(services, job)
    assert (services.index.jobs.attempts(job=job), services.queue.waiting()) == ([], set())


def test_what_is_harmed_in_a_pack_is_made_again(services: Services) -> None:
    job, tasks = submit(services, 2)
    key = pack(services.store, tasks)
    overwrite(services.store, key, flipped(services.store.get(key), len(services.store.get(key)) - 200))
    Bench(services).controller.round()
    found = findings(services)
    assert [wrong.shard for wrong in found] == [tasks[1].output]
    assert repair(services, found) == (found, [])
    work_off(services)
    assert findings(services) == []
    assert is_whole(services, job)


def test_readers_name_the_command_and_read_places_in_packs(services: Services) -> None:
    job, tasks = submit(services, 2)
    pack(services.store, tasks)
    folder = services.settings.data_dir
    for source in (services.store, folder / "store"):
        with pytest.raises(InputError, match="graspd admin store upgrade"):
            open_shards(source, job=job)
    told = CliRunner().invoke(store_commands.app, ["store", "upgrade", "--json", "--data-dir", str(folder)])
    assert json.loads(told.stdout.splitlines()[-1]) == {"shards": 2}
    found = open_shards(services.store, job=job, cache=folder / "cache")
    of_all = {"kind": "base", "size_bytes": 1, "count": 32, "valid": 1, "hand": "gripper", "object": "ball"}
    place = f"packs/{'a' * 32}/{'b' * 32}.pack@{{}}+100"
    shards = [
        of_all | {"id": file.id, "key": place.format(row), "sha256": file.sha256, "batch": row}
        for row, file in enumerate(found)
    ]
    sums = {"complete": True, "grasps": 64, "valid": 2, "size_bytes": 2, "dataset_digest": "d" * 32}
    taken = Snapshot(dataset="d", digest="c" * 32, created=timestamp(), shards=shards, **sums)
    put_record(services.store, f"{names.DATASETS}/d/snapshots/{taken.digest}.json", taken)
    of_snapshot = open_shards(services.store, dataset="d", snapshot=taken.digest, cache=folder / "cache")
    assert [of_snapshot.path(file) for file in of_snapshot] == [found.path(file) for file in found]


def test_an_index_that_is_made_anew_has_what_was_in_packs(services: Services) -> None:
    job, tasks = submit(services, 2)
    pack(services.store, tasks)
    told = CliRunner().invoke(
        commands.app, ["index", "rebuild", "--json", "--data-dir", str(services.settings.data_dir)]
    )
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout.splitlines()[-1])["shards"] == 2
    assert is_whole(services, job)
    assert [shard.stage for shard in services.index.shards.page(job=job).items] == [Stage.SYNTHESIZE] * 2
