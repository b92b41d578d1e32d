"""Packs of graspd 0.2 are taken apart, wherever it breaks off; a service goes on with them and with their workers."""

import hashlib
import json
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import accumulate
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_bytes, digest_json
from graspd.service.model.errors import InputError, StoreUnavailable
from graspd.service.model.messages import TaskMessage
from graspd.service.model.states import Stage, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.integrity import repair
from graspd.service.readers import open_shards
from graspd.service.run import commands, store_commands
from graspd.service.store import packs
from graspd.service.store.integrity import read_checked
from graspd.service.store.manifests import ShardManifest, load_manifest, load_shard, publish_shard, shard_exists
from graspd.service.store.packs import convert_packs, has_packs
from graspd.service.store.store import Store, open_store
from tests.damage import flipped, overwrite
from tests.fakes import job_record, make_shard, record_of, request, tasks_of
from tests.service.conftest import service
from tests.service.pipeline.test_controller import Bench
from tests.service.pipeline.test_integrity import findings
from tests.service.readers.conftest import put_snapshot


def batches(count: int, **changes: object) -> list[TaskMessage]:
    return tasks_of(job_record(request(grasps=32 * count, **changes)))


def made_of(message: TaskMessage, *, worker: str = "w") -> tuple[ShardManifest, bytes]:
    """A shard that lies nowhere yet: manifest and file."""
    elsewhere = open_store("memory://")
    manifest = make_shard(elsewhere, message, worker=worker)
    return manifest, elsewhere.get(manifest.key)


def pack(store: Store, messages: Sequence[TaskMessage], *, dead: Sequence[TaskMessage] = (), worker: str = "w") -> str:
    """Do tasks and put what they make as one object, as a worker of 0.2 did; its key.

    Args:
        dead: those whose shards are gone since.
    """
    made = [made_of(message, worker=worker) for message in messages]
    manifests = [manifest.model_copy(update={"key": ""}).model_dump_json().encode() for manifest, _ in made]
    pieces = [*manifests, *(data for _, data in made)]
    starts = list(accumulate(map(len, pieces), initial=0))
    rows = []
    for row, (manifest, data) in enumerate(made):
        of_file = {"start": starts[len(made) + row], "length": len(data), "sha256": manifest.sha256}
        of_manifest = {"manifest_start": starts[row], "manifest_length": len(manifests[row])}
        of_manifest["manifest_sha256"] = hashlib.sha256(manifests[row]).hexdigest()
        rows.append({"id": manifest.shard_id, "stage": manifest.stage, **of_file, **of_manifest})
    directory = json.dumps({"version": 1, "shards": rows}, separators=(",", ":")).encode()
    folder = digest_json([messages[0].hand_digest, messages[0].object_digest])
    key = f"packs/{folder}/{digest_bytes(directory)}.pack"
    store.put(key, b"".join([struct.pack("<8sQ", b"graspd\x00\x01", len(directory)), directory, *pieces]))
    if dead:
        gone = json.dumps({"version": 1, "shards": [message.output for message in dead]})
        store.put(f"{key.removesuffix('.pack')}.dead/{'d' * 32}.json", gone.encode())
    return key


@pytest.fixture
def services(tmp_path: Path) -> Iterator[Services]:
    yield from service(tmp_path)


def submit(services: Services, batches: int) -> tuple[str, list[Any]]:
    """A job, and its first tasks."""
    job, _ = job_actions.submit(services, request(grasps=32 * batches))
    return job.id, tasks_of(record_of(services, job.id))


def is_whole(services: Services, job: str) -> bool:
    return services.index.jobs.get(job).state is State.SUCCEEDED and differences(services.index, services.store) == []


def test_a_controller_takes_packs_apart_when_it_starts(services: Services) -> None:
    job, tasks = submit(services, 3)
    pack(services.store, tasks)
    Bench(services).controller.run_round()
    assert not has_packs(services.store)
    assert is_whole(services, job)
    assert not services.index.jobs.attempts(job=job)


def test_what_a_worker_of_0_2_packs_meanwhile_is_found(services: Services) -> None:
    bench = Bench(services)
    bench.controller.run_round()
    job, tasks = submit(services, 3)
    in_hand = [bench.take() for _ in tasks]
    bench.pass_time(1)
    pack(services.store, tasks)  # what it tells of them, an event `packed`, nobody understands any more
    for delivery in in_hand:
        bench.queue.finish(delivery)
    bench.pass_time(6)
    assert not has_packs(services.store)
    assert is_whole(services, job)
    assert (services.index.jobs.attempts(job=job), services.queue.waiting_tasks()) == ([], set())


def test_what_is_harmed_in_a_pack_is_made_again(services: Services) -> None:
    job, tasks = submit(services, 2)
    key = pack(services.store, tasks)
    overwrite(services.store, key, flipped(services.store.get(key), len(services.store.get(key)) - 200))
    Bench(services).controller.run_round()
    found = findings(services)
    assert [wrong.shard for wrong in found] == [tasks[1].output]
    assert repair(services, found) == (found, [])
    Bench(services).work_off()
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
    place = f"packs/{'a' * 32}/{'b' * 32}.pack@{{}}+100"
    packed = [replace(file, key=place.format(row)) for row, file in enumerate(found)]
    put_snapshot(services.store, "d", packed, created=timestamp())
    of_snapshot = open_shards(services.store, dataset="d", cache=folder / "cache")
    assert [of_snapshot.path(file) for file in of_snapshot] == [found.path(file) for file in found]


def test_an_index_that_is_made_anew_has_what_was_in_packs(services: Services) -> None:
    job, tasks = submit(services, 2)
    pack(services.store, tasks)
    command = ["index", "rebuild", "--json", "--data-dir", str(services.settings.data_dir)]
    told = CliRunner().invoke(commands.app, command)
    assert told.exit_code == 0, told.output
    assert json.loads(told.stdout.splitlines()[-1])["shards"] == 2
    assert is_whole(services, job)
    assert [shard.stage for shard in services.index.shards.page(job=job).items] == [Stage.SYNTHESIZE] * 2


@pytest.fixture(params=["files", pytest.param("s3", marks=pytest.mark.s3)])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Store:
    url = request.getfixturevalue("s3_url") if request.param == "s3" else (tmp_path / "store").as_uri()
    return open_store(url)


def there(store: Store, messages: list[TaskMessage]) -> list[bool]:
    return [shard_exists(store, Stage.SYNTHESIZE, message.output) for message in messages]


def test_what_was_in_a_pack_has_a_file_of_its_own(store: Store) -> None:
    assert not has_packs(store)
    messages = batches(3)
    pack(store, messages)
    assert has_packs(store)
    found = list(convert_packs(store))
    assert not has_packs(store)
    assert [manifest.shard_id for manifest in found] == [message.output for message in messages]
    for message, manifest in zip(messages, found, strict=True):
        wanted, data = made_of(message)
        assert store.get(names.shard_file_key(Stage.SYNTHESIZE, message.output))[:8] == data[:8]
        assert load_shard(store, Stage.SYNTHESIZE, message.output).attributes["batch"] == message.batch
        assert load_manifest(store, Stage.SYNTHESIZE, message.output) == manifest
        assert (manifest.key, manifest.batches) == (wanted.key, 1)
    assert list(convert_packs(store)) == []


@pytest.mark.parametrize("breaks_at", range(1, 8))
def test_it_may_break_off_and_is_continued(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, breaks_at: int) -> None:
    store, messages, calls = open_store((tmp_path / "store").as_uri()), batches(3), 0
    pack(store, messages[:2], dead=messages[1:2])
    pack(store, messages[2:])

    def breaking(original: Callable[..., object]) -> Callable[..., object]:
        def call(self: Store, *args: object) -> object:
            nonlocal calls
            calls += 1
            if calls == breaks_at:
                raise StoreUnavailable("gone")
            return original(self, *args)

        return call

    with monkeypatch.context() as patch:
        for name in ("put", "delete"):
            patch.setattr(Store, name, breaking(getattr(Store, name)))
        with pytest.raises(StoreUnavailable):
            list(convert_packs(store))
    list(convert_packs(store))
    assert there(store, messages) == [True, False, True]
    assert not has_packs(store)
    for message in (messages[0], messages[2]):
        manifest = load_manifest(store, Stage.SYNTHESIZE, message.output)
        read_checked(store, manifest.key, manifest.sha256)


def test_a_file_of_its_own_counts_before_one_in_a_pack(store: Store) -> None:
    (message,) = batches(1)
    manifest, data = made_of(message, worker="first")
    publish_shard(store, manifest, data)
    pack(store, [message], worker="second")
    assert list(convert_packs(store)) == [manifest]
    assert load_manifest(store, Stage.SYNTHESIZE, message.output).worker == "first"


@pytest.mark.parametrize("place", ["directory", "manifest", "file", "end"])
def test_harm_moves_the_pack_aside_and_costs_no_more(store: Store, place: str) -> None:
    messages = batches(2)
    key = pack(store, messages)
    data = store.get(key)
    body, rows = packs._read_directory(key, data)
    at = {"directory": 40, "manifest": body + rows[0].manifest_start + 10, "file": body + rows[0].start + 50}
    overwrite(store, key, data[: body + rows[1].start - 1] if place == "end" else flipped(data, at[place]))
    list(convert_packs(store))
    assert store.exists(f"damaged/{key}")
    assert not has_packs(store)
    wanted = {"directory": [False, False], "manifest": [False, True], "file": [True, True], "end": [True, True]}[place]
    assert there(store, messages) == wanted
    files = [store.exists(names.shard_file_key(Stage.SYNTHESIZE, message.output)) for message in messages]
    intact = {"directory": [False, False], "manifest": [False, True], "file": [False, True], "end": [False, False]}
    assert files == intact[place]
    for message, is_intact in zip(messages, files, strict=True):
        if is_intact:
            manifest = load_manifest(store, Stage.SYNTHESIZE, message.output)
            assert hashlib.sha256(store.get(manifest.key)).hexdigest() == manifest.sha256
