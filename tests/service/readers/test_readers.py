"""Reading shards back: from files, jobs, snapshots and S3; how pictures and grasps belong together."""

import hashlib
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from obstore.store import MemoryStore

from graspd.service.model.errors import DamagedShard, InputError, NotFoundError
from graspd.service.model.transforms import compose, pose_from_matrix
from graspd.service.pipeline.backends import Services
from graspd.service.readers import Grasps, Pictures, ShardCache, Shards, open_shards
from graspd.service.readers.rows import RowTable
from graspd.service.settings import Settings
from graspd.service.store.columns import SCHEMAS
from graspd.service.store.shards import read_shard
from graspd.service.store.store import Store, open_store
from tests.damage import flipped, flipped_values
from tests.indexes import open_services
from tests.servers import S3Server
from tests.service.readers.conftest import GRASPS, job_in, put_snapshot


@pytest.fixture
def folder(services: Services, shards: Shards, tmp_path: Path) -> Path:
    out = tmp_path / "files"
    out.mkdir()
    for number, shard in enumerate(shards):
        (out / f"{number}.h5").write_bytes(services.store.get(shard.key))
    return out


def test_a_job_in_a_store_is_read_valid_or_whole(services: Services, shards: Shards) -> None:
    assert [file.kind for file in shards] == ["base", "scene", "views"] * 2
    assert len(Grasps(shards, valid=False)) == GRASPS
    bases = [read_shard(services.store.get(file.key), kind="base") for file in shards.of_kind("base")]
    valid = sum(int(np.count_nonzero(base["quality/valid"])) for base in bases)
    assert 0 < valid < GRASPS
    assert len(Grasps(shards)) == valid


def test_a_sample_is_a_row_and_arrays_hold_them_in_order(shards: Shards, folder: Path) -> None:
    grasps = Grasps(shards)
    sample = grasps[-1]
    base = read_shard(shards.path(shards.by_id(sample["shard_id"])), kind="base")
    np.testing.assert_array_equal(sample["grasp/hand_pose"], base["grasp/hand_pose"][sample["row"]])
    assert (sample["hand"], sample["object"]) == ("allegro", "mug")
    arrays = grasps.arrays("quality/epsilon")
    np.testing.assert_array_equal(arrays["quality/epsilon"], [sample["quality/epsilon"] for sample in grasps])
    assert len(arrays["hand"]) == len(grasps)
    local = Grasps(open_shards(folder)).arrays("quality/epsilon")
    np.testing.assert_array_equal(local["quality/epsilon"], arrays["quality/epsilon"])


def test_a_condition_keeps_the_grasps_it_holds_for(shards: Shards) -> None:
    good = Grasps(shards, where=lambda columns: columns["quality/penetration_depth_mm"] < 0.5)
    assert 0 < len(good) < len(Grasps(shards))
    assert all(sample["quality/penetration_depth_mm"] < 0.5 for sample in good)
    with pytest.raises(InputError, match="mask of shape"):
        Grasps(shards, where=lambda columns: np.ones(3, bool))


UNREADABLE: dict[str, Callable[[Shards], object]] = {
    "a job or a dataset": lambda shards: open_shards(shards.store),
    "no column 'grasp/colour'; docs": lambda shards: Grasps(shards, ["grasp/colour"]),
    "on mug has no column 'grasp/approach'": lambda shards: Grasps(shards, ["grasp/approach"])[0],
    "of mug has no column 'image/distance'": lambda shards: Pictures(shards, ["image/distance"]),
}


@pytest.mark.parametrize("words", UNREADABLE)
def test_what_is_not_there_is_told_by_name(shards: Shards, words: str) -> None:
    with pytest.raises(InputError, match=words):
        UNREADABLE[words](shards)


def test_pictures_of_unknown_scenes_are_to_be_rendered_again(box: Path, tmp_path: Path) -> None:
    shutil.copytree(box, tmp_path / "set")
    with h5py.File(tmp_path / "set" / "views.h5", "r+") as file:
        del file.attrs["base_shard"]
    with pytest.raises(InputError, match="graspd render"):
        Pictures(open_shards(tmp_path / "set"))


def test_a_picture_comes_with_its_grasps_in_the_camera_frame(folder: Path) -> None:
    shards = open_shards(folder)
    picture = next(sample for sample in Pictures(shards) if len(sample["grasp/hand_pose"]))
    views = read_shard(shards.path(shards.by_id(picture["shard_id"])), kind="views")
    scene = read_shard(shards.path(shards.by_id(str(views.attributes["scene_shard"]))), kind="scene")
    here = (scene["grasp/scene_index"] == picture["scene"]) & (scene["grasp/valid"] == 1)
    base = read_shard(shards.path(shards.by_id(str(scene.attributes["base_shard"]))), kind="base")
    valid = base["quality/valid"][scene["grasp/base_index"]] == 1
    assert (here & ~valid).any(), "some grasps that are clear must not be valid, or nothing is tested"
    here &= valid
    table = np.asarray(scene["grasp/hand_pose"], float)[here]
    expected = compose(pose_from_matrix(picture["camera/extrinsics"]), table)
    np.testing.assert_allclose(picture["grasp/hand_pose"], expected, atol=1e-12)  # rounding of float64
    np.testing.assert_array_equal(picture["grasp/base_row"], scene["grasp/base_index"][here])


def test_every_picture_is_there_once(folder: Path) -> None:
    shards = open_shards(folder)
    pictures = Pictures(shards)
    places = {(sample["shard_id"], sample["row"]) for sample in pictures}
    assert len(places) == len(pictures) == 2 * 2 * 2  # batches, scenes, views
    with pytest.raises(NotFoundError, match="not among"):
        Pictures(Shards(shards.of_kind("views")))


def test_the_newest_snapshot_of_a_dataset_is_read(services: Services, shards: Shards, tmp_path: Path) -> None:
    with pytest.raises(NotFoundError, match="graspd datasets snapshot kitchen"):
        open_shards(services.store, dataset="kitchen", cache=tmp_path / "cache")
    for number, some in enumerate((shards.files[:1], shards.files)):
        put_snapshot(services.store, "kitchen", some, created=f"2026-01-0{number + 1}T00:00:00Z")
    assert len(open_shards(services.store, dataset="kitchen", cache=tmp_path / "cache")) == len(shards)


def test_a_file_that_changed_is_refused_or_fetched_again(services: Services, shards: Shards, tmp_path: Path) -> None:
    shard = shards.files[0]
    with pytest.raises(DamagedShard, match=shard.id):
        ShardCache(tmp_path / "other").fetch(services.store, shard.key, "0" * 64)
    assert not list((tmp_path / "other").iterdir())
    path = shards.path(shard)
    data = path.read_bytes()
    path.write_bytes(flipped(data))
    assert shards.path(shard).read_bytes() == data


def test_a_wrong_value_in_a_file_is_refused_and_not_handed_out(folder: Path) -> None:
    file = open_shards(folder).of_kind("base")[0]
    assert file.path is not None
    data = file.path.read_bytes()
    file.path.write_bytes(flipped_values(data, read_shard(data)["grasp/hand_pose"]))
    with pytest.raises(DamagedShard, match=r"grasp/hand_pose"):
        Grasps(open_shards(folder))[0]


def test_a_full_cache_drops_what_was_unused_longest(services: Services, shards: Shards, tmp_path: Path) -> None:
    sizes = {shard.sha256: len(services.store.get(shard.key)) for shard in shards}
    cache = ShardCache(tmp_path / "small", limit_bytes=sum(sizes.values()) // 2)
    for shard in shards:
        cache.fetch(services.store, shard.key, shard.sha256)
    held = {path.stem for path in cache.folder.iterdir()}
    assert shards.files[-1].sha256 in held and shards.files[0].sha256 not in held
    assert sum(sizes[name] for name in held) <= cache.limit_bytes


@pytest.mark.s3
def test_what_was_read_once_from_s3_needs_the_server_no_more(s3_url: str, s3_server: S3Server, tmp_path: Path) -> None:
    remote = open_services(Settings(data_dir=tmp_path), open_store(s3_url))
    job = job_in(remote)
    shards = open_shards(s3_url, job=job, cache=tmp_path / "cache")
    assert [shards.path(file).read_bytes() for file in shards] == [remote.store.get(file.key) for file in shards]
    s3_server.kill()
    try:
        assert len(Grasps(shards, valid=False)) == GRASPS and len(Pictures(shards)) == 8
    finally:
        s3_server.start()
    remote.close()


def test_every_row_of_every_column_is_what_h5py_reads(box: Path) -> None:
    with h5py.File(box / "views.h5") as file:
        columns = [name for name in SCHEMAS["views"] if name in file]
        table = RowTable.from_file(file, columns, "views")
        assert {"image/rgb", "image/depth"} <= set(table.packed) and "camera/eye" in table.held
        for row in range(len(file["camera/eye"])):
            found = table.row(box / "views.h5", row, columns)
            for name in columns:
                expected = file[name][row]
                assert found[name].dtype == expected.dtype
                np.testing.assert_array_equal(found[name], expected)


def test_what_is_packed_in_another_way_is_read_by_the_library(tmp_path: Path) -> None:
    values = np.arange(2 * 6 * 5, dtype=np.float32).reshape(2, 6, 5)
    bare = {"chunks": (1, 6, 5)}
    plain = {**bare, "compression": "gzip"}
    ways = {"whole": {}, "two": plain | {"chunks": (2, 6, 5)}, "lzf": bare | {"compression": "lzf"}}
    ways |= {"bare": bare, "plain": plain, "summed": plain | {"fletcher32": True}}
    with h5py.File(tmp_path / "other.h5", "w") as file:
        for name, options in ways.items():
            file.create_dataset(name, data=values, **options)
        half = file.create_dataset("half", shape=values.shape, dtype="f4", **plain)
        half[1] = values[1]
    with h5py.File(tmp_path / "other.h5") as file:
        table = RowTable.from_file(file, [*ways, "half"], "other")
    assert set(table.packed) == {"plain"}
    found = table.row(tmp_path / "other.h5", 1, ways)
    for name in ways:
        np.testing.assert_array_equal(found[name], values[1])
    assert not table.row(tmp_path / "other.h5", 0, ["half"])["half"].any()


@pytest.mark.parametrize("harm", ["turned", "cut"])
def test_a_picture_whose_bytes_changed_is_refused_alone(box: Path, tmp_path: Path, harm: str) -> None:
    shutil.copytree(box, tmp_path / "set")
    pictures, path = Pictures(open_shards(tmp_path / "set"), ["image/depth"]), tmp_path / "set" / "views.h5"
    with h5py.File(path) as file:
        start, length = RowTable.from_file(file, ["image/depth"], "views").packed["image/depth"].places[2]
    data = bytearray(path.read_bytes())
    data[start + length // 2] ^= 0x10
    pictures[1]
    path.write_bytes(data if harm == "turned" else data[: start + length // 2])
    with pytest.raises(DamagedShard, match="row 2 of image/depth") as told:
        pictures[2]
    assert "\n" not in str(told.value)
    assert pictures[1]["image/depth"].any()


def test_a_sample_is_the_callers_own(box: Path) -> None:
    pictures = Pictures(open_shards(box), ["image/rgb", "image/depth", "camera/intrinsics"])
    first = pictures[0]
    for value in first.values():
        if isinstance(value, np.ndarray):
            value[...] = 0
    assert pictures[0]["image/rgb"].any() and pictures[0]["camera/intrinsics"].any()


def test_a_fork_is_told_to_start_anew(box: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    remote, files = Store(MemoryStore(), "s3://bucket/graspd"), []
    for file in open_shards(box):
        assert file.path is not None
        remote.put(key := f"shards/{file.kind}/{file.id}.h5", data := file.path.read_bytes())
        files.append(replace(file, path=None, key=key, sha256=hashlib.sha256(data).hexdigest()))
    pictures = Pictures(Shards(tuple(files), remote, ShardCache(tmp_path)))
    pictures[0]
    for path in tmp_path.iterdir():
        path.unlink()
    here = os.getpid()
    monkeypatch.setattr(os, "getpid", lambda: here + 1)
    with pytest.raises(InputError, match="spawn"):
        pictures[0]
