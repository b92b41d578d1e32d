"""Reading shards back: from files, jobs, snapshots and S3; pictures, trajectories and conditions on grasps."""

import hashlib
import os
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from obstore.store import MemoryStore

from graspd.service.model.errors import DamagedShard, InputError, NotFoundError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import compose, pose_from_matrix, quat_from_axis_angle
from graspd.service.model.where import LONGEST
from graspd.service.pipeline.backends import Services
from graspd.service.readers import Grasps, Pictures, ShardCache, Shards, open_shards, trajectories
from graspd.service.readers.rows import RowTable
from graspd.service.readers.where import compile_expression
from graspd.service.settings import Settings
from graspd.service.store.columns import SCHEMAS
from graspd.service.store.shards import Shard, json_attribute, read_shard
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


def test_every_picture_is_there_once_with_its_grasps_in_the_camera_frame(folder: Path) -> None:
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
    shards = open_shards(s3_url, job=job_in(remote), cache=tmp_path / "cache")
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


WAYPOINTS = 4


def shard(*, in_scene: bool) -> Shard:
    arrays: dict[str, np.ndarray] = {}
    for k, name in enumerate(("pregrasp", "grasp", "squeeze")):
        arrays[f"{name}/hand_pose"] = np.array([[0.1, 0, 0, 1, 0, 0, 0]], float)
        arrays[f"{name}/joint_positions"] = np.full((1, 2), 0.1 * k)
    if in_scene:
        coming = np.tile([0.1, 0, 0, 1, 0, 0, 0], (1, WAYPOINTS, 1)).astype(float)
        coming[0, :, 0] = np.linspace(0.2, 0.1, WAYPOINTS)
        arrays |= {
            "grasp/approach": coming,
            "grasp/approach_joint_positions": np.full((1, 2), -0.3),
            "grasp/lift": np.array([[0.1, 0, 0.1, 1, 0, 0, 0]]),
        }
    return Shard("base", {}, arrays)


def test_a_way_goes_from_standoff_or_pregrasp_to_lift_or_squeeze():
    free, way = (
        trajectories.trajectory_of(shard(in_scene=False), 0),
        trajectories.trajectory_of(shard(in_scene=True), 0),
    )
    assert [point.name for point in free] == ["pregrasp", "grasp", "squeeze"]
    assert [point.name for point in way if point.name] == ["standoff", "pregrasp", "grasp", "squeeze", "lift"]
    assert way[0].hand_pose[0] == 0.2
    assert all((point.joint_positions == -0.3).all() for point in way[:WAYPOINTS])
    assert way[-1].carried.tolist() == [0, 0, 0.1] and not any(point.carried.any() for point in way[:-1])
    np.testing.assert_allclose(trajectories.slider_positions(way), [0, 0.25, 0.5, 0.75, 1, 2, 3, 4])
    assert trajectories.waypoint_at(way, 3.5).carried == pytest.approx([0, 0, 0.05]), "half way up"


@pytest.mark.parametrize("at", [(-1, 0.2, -0.3), (0.375, 0.15, -0.3), (1.5, 0.1, 0.05), (9, 0.1, 0.2)])
def test_between_two_postures_positions_and_joints_go_straight(at: tuple[float, float, float]):
    place, x, joint = at
    point = trajectories.waypoint_at(trajectories.trajectory_of(shard(in_scene=True), 0), place)
    assert point.hand_pose[0] == pytest.approx(x) and point.joint_positions == pytest.approx([joint, joint])


def test_a_turn_is_divided_evenly():
    ends = quat_from_axis_angle(np.array([0, 0, 1.0]), np.array([0.0, 1.2]))
    first, last = (
        trajectories.Waypoint(name, np.concatenate([np.zeros(3), q]), np.zeros(0), np.zeros(3))
        for name, q in zip(("grasp", "squeeze"), ends, strict=True)
    )
    third = trajectories.waypoint_at([first, last], 1 / 3).hand_pose[3:]
    assert third == pytest.approx(quat_from_axis_angle(np.array([0, 0, 1.0]), np.array(0.4)))


def test_a_shard_says_its_scene_or_none_and_nonsense_is_refused():
    spec = SceneSpec(kind="bin")
    assert trajectories.scene_spec_of(Shard("base", {}, {})) is None
    assert (
        trajectories.scene_spec_of(Shard("base", {"scene": json_attribute(spec.model_dump(mode="json"))}, {})) == spec
    )
    with pytest.raises(InputError, match="is not a valid scene"):
        trajectories.scene_spec_of(Shard("base", {"scene": '{"kind": "moon"}'}, {}))


def test_wrists_are_those_of_the_rows_asked_for():
    one = shard(in_scene=True)
    assert trajectories.wrist_angles(one, np.array([0])) is None
    one.arrays["grasp/wrist_positions"] = np.array([[0.1, 0.2], [0.3, 0.4]])
    assert np.array_equal(trajectories.wrist_angles(one, np.array([1, 1])), [[0.3, 0.4]] * 2)


COLUMNS: dict[str, Any] = {
    "quality/thresholds_m": np.array([0.002, 0.005]),
    "quality/epsilon": np.array([[0.9, 0.1], [0.0, 0.4], [0.9, np.nan], [0.0, 0.3]]),
    "quality/penetration_depth_mm": np.array([0.5, 1.5, 0.5, 2.5]),
    "quality/valid": np.array([1, 1, 1, 0], np.uint8),
    "quality/success": np.array([1, 1, 1, 0], np.int8),
    "quality/lift_outcome": np.array([1, 5, 1, 1], np.uint8),
    "quality/grasp_type": np.array([1, 2, 3, 0], np.int32),
}
SAID = {"hand": "allegro", "object": "006_mustard_bottle"}


@pytest.mark.parametrize(
    ("text", "rows"),
    [
        ("epsilon > 0.3", [1]),  # the value at 5 mm, not the one at 2 mm
        ("epsilon>=.3", [1, 3]),
        ("not epsilon > 0.3", [0, 2, 3]),
        ("epsilon = 3e-1 or epsilon != 0.1 and valid", [1, 3]),
        ("(epsilon = 0.3 or epsilon != 0.1) and valid", [1]),
        ("valid and lift", [0, 2]),
        ("lift and not held", [3]),
        ("not validated", []),
        ("type = power or type = 'lateral'", [0, 2]),
        ("hand = allegro and object = 006_mustard_bottle and penetration_depth_mm < 1", [0, 2]),
        ("hand != allegro", []),
        ("clearance_m > -1", []),  # a shard that lacks a metric fails every comparison with it
        ("robust >= 0.75 or robust_share < 0.75", []),
    ],
)
def test_an_expression_chooses_what_it_says(text: str, rows: list[int]) -> None:
    assert np.flatnonzero(compile_expression(text)(COLUMNS, SAID)).tolist() == rows


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "ends where a name"),
        ("epsilon", "needs a comparison"),
        ("epsilon >", "ends where a value"),
        ("epsilon > big", "compared with a number"),
        ("epsilon > 1 valid", "follows a complete expression"),
        ("valid > 0", "is a flag"),
        ("(valid", "not closed"),
        ("and valid", "where a name is expected"),
        ("beauty > 1", "there is no 'beauty'; the names are epsilon"),
        ("type = pinch", "no type 'pinch'"),
        ("hand < allegro", "a word by = or !="),
        ("hand = 5", "a word, not with '5'"),
        ("epsilon > 1; import os", "cannot be read"),
        ("__import__('os').system('true')", "cannot be read"),
        ("(" * 200 + "valid" + ")" * 200, "nested"),
        ("not " * 200 + "valid", "nested"),
        ("valid and " * LONGEST, "characters long"),
    ],
)
def test_what_is_no_expression_is_refused_in_a_line(text: str, words: str) -> None:
    with pytest.raises(InputError, match=words) as refused:
        compile_expression(text)
    assert "\n" not in str(refused.value)
