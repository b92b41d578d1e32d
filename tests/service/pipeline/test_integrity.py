"""`graspd admin store verify`: five kinds of damage are five findings, on files and on S3; most is made again."""

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from graspd.service.index.notes import Damage
from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.errors import DamagedShard
from graspd.service.model.states import State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.integrity import BAD_MANIFEST, FOREIGN, MISSING, NO_MANIFEST, repair, scan
from graspd.service.queue.port import EventKind
from graspd.service.run import commands, store_commands
from graspd.service.store.manifests import ShardManifest, load_manifest, load_shard
from tests.damage import cut, flip, overwrite, remove
from tests.fakes import request
from tests.service.conftest import service
from tests.service.pipeline.test_controller import Bench

SHARDS = 6


@pytest.fixture(params=["files", pytest.param("s3", marks=pytest.mark.s3)])
def services(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Services]:
    yield from service(tmp_path, store_url=request.getfixturevalue("s3_url") if request.param == "s3" else None)


def findings(services: Services) -> list[Damage]:
    return [wrong for _, wrong in scan(services.store) if wrong is not None]


@pytest.fixture
def shards(services: Services) -> list[ShardManifest]:
    """Finished shards, in the order of their batches."""
    job, _ = job_actions.submit(services, request(grasps=32 * SHARDS))
    Bench(services).work_off()
    assert services.index.jobs.get(job.id).state is State.SUCCEEDED
    listed = services.index.shards.page(job=job.id, limit=99).items
    found = [load_manifest(services.store, shard.stage, shard.id) for shard in listed]
    return sorted(found, key=lambda manifest: manifest.batch)


def harm(services: Services, shards: list[ShardManifest]) -> dict[str, str]:
    """Five kinds of damage: what each does to which shard."""
    flip(services.store, shards[0].key)
    cut(services.store, shards[1].key)
    remove(services.store, shards[2].key)
    overwrite(services.store, names.shard_manifest_key(shards[3].stage, shards[3].shard_id), b'{"x": 1}')
    remove(services.store, names.shard_manifest_key(shards[4].stage, shards[4].shard_id))
    told = ("SHA-256", "bytes, expected", MISSING, BAD_MANIFEST, NO_MANIFEST)
    return {shard.shard_id: what for shard, what in zip(shards, told, strict=False)}


def test_five_kinds_of_damage_are_five_findings(services: Services, shards: list[ShardManifest]) -> None:
    assert findings(services) == []
    done = harm(services, shards)
    found = {wrong.shard: wrong.what for wrong in findings(services)}
    assert found.keys() == done.keys()
    assert all(done[shard] in what for shard, what in found.items())


def test_what_is_made_again_has_the_checksum_it_had(services: Services, shards: list[ShardManifest]) -> None:
    harm(services, shards)
    repaired, left = repair(services, findings(services))
    # The worker of a file without a manifest may be about to put it.
    (one,) = left
    assert one.what == f"{NO_MANIFEST}; its manifest may follow soon; run the command again in a minute"
    assert len(repaired) == 4
    Bench(services).work_off()
    for manifest in (*shards[:4], shards[5]):
        load_shard(services.store, manifest.stage, manifest.shard_id)
        assert load_manifest(services.store, manifest.stage, manifest.shard_id).sha256 == manifest.sha256
    assert [wrong.what for wrong in findings(services)] == [NO_MANIFEST]


def test_what_comes_out_otherwise_is_not_put(services: Services, shards: list[ShardManifest]) -> None:
    remove(services.store, shards[0].key)
    repair(services, findings(services))
    assert Bench(services).work_off(device="cuda:0") == [EventKind.CANCELLED]
    with pytest.raises(DamagedShard):
        load_shard(services.store, shards[0].stage, shards[0].shard_id)
    assert differences(services.index, services.store) == []


def test_a_foreign_object_is_moved_a_bad_record_needs_a_copy(services: Services, shards: list[ShardManifest]) -> None:
    services.store.put("shards/base/notes.txt", b"mine")
    found = findings(services)
    assert [one.what for one in found] == [FOREIGN]
    repair(services, found)
    assert services.store.get("damaged/shards/base/notes.txt") == b"mine"
    assert findings(services) == []
    key = names.job_record_key(services.index.jobs.page().items[0].id)
    overwrite(services.store, key, b'{"x": 1}')
    found = findings(services)
    assert [one.key for one in found] == [key]
    repaired, left = repair(services, found)
    assert not repaired and "put a copy in its place" in left[0].what


def test_the_commands_tell_what_is_damaged_and_exit_with_1(
    services: Services, shards: list[ShardManifest], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("GRASPD_STORE_URL", services.store.url)
    folder = ["--data-dir", str(services.settings.data_dir)]
    verify, check = ["store", "verify", "--json", *folder], ["index", "rebuild", "--check", *folder]
    feasible = CliRunner().invoke(store_commands.app, verify)
    assert (feasible.exit_code, json.loads(feasible.stdout)["damaged"]) == (0, []), feasible.output
    assert CliRunner().invoke(commands.app, check).exit_code == 0
    done = harm(services, shards)
    told = CliRunner().invoke(store_commands.app, verify)
    assert told.exit_code == 1
    said = json.loads(told.stdout.splitlines()[-1])
    assert {one["shard"] for one in said["damaged"]} | set(said["missing"]) == done.keys()
    assert said["missing"] == [shards[2].shard_id]
    assert services.index.damage.summary()[0] == 5
    told = CliRunner().invoke(commands.app, check)
    assert told.exit_code == 1 and shards[0].key in told.output
