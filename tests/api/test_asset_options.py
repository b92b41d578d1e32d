"""Uploads: what a user says about one reaches its check, and files go past memory."""

import json
import os
import tracemalloc
from pathlib import Path
from typing import Any

import pytest
import trimesh
from starlette.testclient import TestClient

from graspd.api.uploads import files_of_upload
from graspd.service.model.digests import digest_files
from graspd.service.model.errors import InputError
from graspd.service.model.messages import IngestMessage
from graspd.service.model.states import AssetKind
from graspd.service.pipeline.backends import Services
from graspd.service.store.asset_options import hand_options
from graspd.service.store.assets import builtin_files, pack
from graspd.service.store.library import load_asset, load_asset_files, load_check, publish_asset
from graspd.worker.stages import ingest
from graspd.worker.stages.context import TaskContext
from tests.api.factories import zipped


def check(
    http: TestClient, services: Services, kind: AssetKind, file: tuple[str, bytes], options: dict[str, Any]
) -> Any:
    """Upload over HTTP and let the worker's stage check what the store then holds."""
    answer = http.post(f"/v1/{kind.value}s", files={"file": file}, data={"options": json.dumps(options)})
    assert answer.status_code == 202, answer.text
    digest = answer.json()["digest"]
    message = IngestMessage(schema_=1, task_id="i", kind=kind, name=answer.json()["name"], digest=digest)
    ingest.run(message, TaskContext(services.store))
    return load_check(services.store, kind, digest)


def stl(*meshes: trimesh.Trimesh) -> bytes:
    return bytes(trimesh.util.concatenate(meshes).export(file_type="stl"))


def shell() -> bytes:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.04)
    ball.update_faces(ball.triangles_center[:, 2] < 0.01)
    return stl(ball)


def test_the_options_of_an_object_decide_its_check(http: TestClient, services: Services) -> None:
    brick = ("brick.stl", stl(trimesh.creation.box((60.0, 40.0, 30.0))))
    facts = check(http, services, AssetKind.OBJECT, brick, {"units": "mm", "density": 950.0})["facts"]
    # Simplified within 0.3 mm: a per cent of the volume.
    assert facts["volume_m3"] == pytest.approx(60e-3 * 40e-3 * 30e-3, rel=0.01)
    assert facts["mass_kg"] == pytest.approx(950.0 * facts["volume_m3"])


def test_the_options_of_a_hand_decide_its_check(http: TestClient, services: Services) -> None:
    urdf = builtin_files(AssetKind.HAND, "allegro")["allegro.urdf"]
    options = hand_options(
        palm="palm",
        approach="0,0,1",
        pre_shape=["index_proximal=0.5,middle_proximal=0.6"],
        fix=["thumb_rotation=1.0"],
        drop=["ring_proximal_link"],
    )
    facts = check(http, services, AssetKind.HAND, ("mine.urdf", urdf), options)["facts"]
    assert facts["palm_approach"] == [0.0, 0.0, 1.0]
    assert facts["preshape"]["index_proximal"] == 0.5 and facts["preshape"]["middle_proximal"] == 0.6
    assert "thumb_rotation" not in facts["dofs"]
    assert not [name for name in facts["dofs"] if name.startswith("ring_m")]
    assert "palm" not in facts["guessed"] and "closing" in facts["guessed"]


def test_what_was_refused_gets_in_under_its_name_with_the_mend(http: TestClient, services: Services) -> None:
    file = ("open_shell.stl", shell())
    first = http.post("/v1/objects", files={"file": file}).json()
    asset = load_asset(services.store, AssetKind.OBJECT, first["digest"])
    services.index.write.add_asset(asset, check(http, services, AssetKind.OBJECT, file, {}))
    second = http.post("/v1/objects", files={"file": file}, data={"options": '{"allow_open": true}'})
    assert second.status_code == 202, second.text
    assert http.get("/v1/objects/open_shell").json()["digest"] == second.json()["digest"] != first["digest"]


MIB = 1 << 20


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
