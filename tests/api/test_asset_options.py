"""Uploads: what a user says about one reaches its check, and files go past memory."""

import json
import os
import tracemalloc
from pathlib import Path

import pytest
from starlette.testclient import TestClient

from graspd.api.uploads import files_of_upload
from graspd.service.model.digests import digest_files
from graspd.service.model.errors import InputError
from graspd.service.model.messages import IngestMessage
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.store.asset_options import hand_options
from graspd.service.store.assets import builtin_files, pack
from graspd.service.store.library import load_asset_files, load_check, publish_asset
from graspd.worker.stages import ingest
from graspd.worker.stages.context import TaskContext
from tests.api.factories import zipped

MIB = 1 << 20


def test_the_options_of_a_hand_decide_its_check(http: TestClient, services: Services) -> None:
    urdf = builtin_files(AssetKind.HAND, "allegro")["allegro.urdf"]
    joints = {"pre_shape": ["index_proximal=0.5,middle_proximal=0.6"], "fix": ["thumb_rotation=1.0"]}
    options = hand_options(palm="palm", approach="0,0,1", drop=["ring_proximal_link"], **joints)
    file, said = {"file": ("mine.urdf", urdf)}, {"options": json.dumps(options)}
    digest = http.post("/v1/hands", files=file, data=said).json()["digest"]
    message = IngestMessage(schema_=1, task_id="i", kind=AssetKind.HAND, name="mine", digest=digest)
    ingest.run(message, TaskContext(services.store))
    facts = (load_check(services.store, AssetKind.HAND, digest) or {})["facts"]
    assert facts["palm_approach"] == [0.0, 0.0, 1.0]
    assert facts["preshape"]["index_proximal"] == 0.5 and facts["preshape"]["middle_proximal"] == 0.6
    assert "thumb_rotation" not in facts["dofs"]
    assert not [name for name in facts["dofs"] if name.startswith("ring_m")]
    assert "palm" not in facts["guessed"] and "closing" in facts["guessed"]


def folder_of(count: int, size: int) -> bytes:
    """ZIP of a folder with a mesh and textures that do not compress."""
    textures = {f"thing/texture-{number}.png": os.urandom(size) for number in range(count)}
    return zipped({"thing/mesh.stl": b"solid x\nendsolid x\n", **textures})


def test_a_zip_is_kept_without_ever_being_whole_in_memory(services: Services, tmp_path: Path) -> None:
    with (tmp_path / "upload.zip").open("w+b") as file:
        file.write(folder_of(3, 4 * MIB))
        tracemalloc.start()
        files = files_of_upload(AssetKind.OBJECT, "thing.zip", file, limit_bytes=32 * MIB)
        asset = publish_asset(services.store, AssetKind.OBJECT, "thing", files)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
    # Two pieces of 1 MiB on their way into the store, of 12 MiB.
    assert peak < 3 * MIB
    assert len(load_asset_files(services.store, AssetKind.OBJECT, asset.digest)) == 5


def test_a_zip_on_disk_and_in_memory_are_the_same_asset() -> None:
    data = folder_of(2, 100_000)
    streamed = files_of_upload(AssetKind.OBJECT, "thing.zip", data, limit_bytes=MIB)
    held = dict(streamed)
    assert digest_files(AssetKind.OBJECT, streamed) == digest_files(AssetKind.OBJECT, held)
    assert pack(streamed) == pack(held)


def test_a_zip_whose_header_understates_its_files_is_refused() -> None:
    data = zipped({"mesh.stl": b"0" * 5000})
    true, false = (5000).to_bytes(4, "little"), (10).to_bytes(4, "little")
    assert data.count(true) == 2
    with pytest.raises(InputError, match="damaged"):
        files_of_upload(AssetKind.OBJECT, "thing.zip", data.replace(true, false), limit_bytes=1000)
