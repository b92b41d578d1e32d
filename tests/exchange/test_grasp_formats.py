"""Grasps and pictures in the formats of others and back; files that would run code, or are nested deep, are refused."""

import io
import json
import os
import tarfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from graspd.client.dataset_commands import read_spec
from graspd.commands.exchange import read_sets
from graspd.commands.studies import _read_record as read_study
from graspd.exchange import dexgraspbench, graspgen, published, replicator, webdataset
from graspd.exchange.bench_hand import _read_mapping as read_mapping
from graspd.exchange.bench_scene import object_of_scene, save_record
from graspd.exchange.imported import Origin, joints_by_name, load_npy, parse_verdicts, scaled_object
from graspd.exchange.inputs import expand_path, load_case
from graspd.exchange.published import stored_friction
from graspd.exchange.scoring import write_scored
from graspd.service.model.errors import InputError
from graspd.service.model.studies import parse_stability
from graspd.service.model.transforms import compose, quat_to_matrix
from graspd.service.readers import Pictures, Shards, open_shards
from graspd.service.readers.trajectories import scene_spec_of
from graspd.service.settings import Settings
from graspd.service.store.shards import Shard, read_shard, write_shard
from graspd.service.store.store import open_store
from graspd.studies.cards.contents import Contents, add_provenance
from graspd.worker.files.provenance import parse_options_attribute, scenes_of_shard
from graspd.worker.hands.load import hand_from_path
from graspd.worker.rendering.annotate import box_corners
from tests.api import factories
from tests.indexes import open_services
from tests.worker.commands_run import refused

TINY = 1e-9  # positions and quaternions are only re-ordered, not computed with
DEEP = "[" * 100_000 + "]" * 100_000


class Bomb:
    def __reduce__(self):
        return os.mkdir, ("bomb-went-off",)


def test_a_file_that_would_run_code_is_refused_and_does_not(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    np.save("bomb.npy", np.array([Bomb()], dtype=object), allow_pickle=True)
    with pytest.raises(InputError, match="cannot be read safely"):
        load_npy(Path("bomb.npy"))
    assert not Path("bomb-went-off").exists()
    for content in (b"", b"\x93NUMPY", b"no array at all"):
        Path("x.npy").write_bytes(content)
        with pytest.raises(InputError, match=r"x\.npy"):
            load_npy(Path("x.npy"))


def test_a_grasp_of_dexgraspbench_moves_with_its_object(hand, block, grasps, tmp_path) -> None:
    (path, *_) = dexgraspbench.BenchExport(tmp_path).write(hand, block, grasps, [0])
    row = load_npy(path)
    moved = np.array([0.3, -0.2, 0.7, *Rotation.from_euler("xyz", [0.3, 1.1, -2.0]).as_quat(scalar_first=True)])
    for name in dexgraspbench.POSTURES:
        row[f"{name}_qpos"][:7] = compose(moved, row[f"{name}_qpos"][:7])
    save_record(path, row | {"obj_pose": moved})
    (back,) = dexgraspbench.read(path, hand="barrett", obj="block")
    place, turn = back.grasps.grasp.hand_pose[0, :3], quat_to_matrix(back.grasps.grasp.hand_pose[0, 3:])
    np.testing.assert_allclose(place, grasps.grasp.hand_pose[0, :3], atol=TINY)
    np.testing.assert_allclose(turn, quat_to_matrix(grasps.grasp.hand_pose[0, 3:]), atol=TINY)


def test_dexgraspbench_scales_are_sets_and_another_hand_is_told(hand, block, grasps, tmp_path) -> None:
    paths = dexgraspbench.BenchExport(tmp_path).write(hand, block, grasps, range(2))
    save_record(paths[0], load_npy(paths[0]) | {"obj_scale": 0.5})
    sets = dexgraspbench.read(tmp_path, hand="barrett", obj="block")
    assert [one.scale for one in sets] == [0.5, 1.0]
    assert np.ptp(sets[0].obj.vertices, axis=0) == pytest.approx(np.ptp(block.vertices, axis=0) / 2, rel=1e-6)
    dexgraspbench.BenchExport(tmp_path).write(hand, block, grasps, [0])
    with pytest.raises(InputError, match="check --hand"):
        dexgraspbench.read(tmp_path, hand="allegro", obj="block")


def test_dexgraspnets_angles_turn_about_the_fixed_axes(tmp_path: Path) -> None:
    angles = np.array([0.4, -1.2, 2.2])
    qpos = dict(zip(("WRJRx", "WRJRy", "WRJRz"), angles, strict=True)) | {"WRJTx": 0.1, "WRJTy": 0.2, "WRJTz": -0.3}
    path = _dexgraspnet(tmp_path, qpos | {"robot0:FFJ2": 0.5}, scale=1.0)
    (found,) = read_sets("dexgraspnet", path, "shadow", "block")
    expected = Rotation.from_euler("xyz", angles).as_matrix()  # SciPy's lower-case letters are fixed axes too
    np.testing.assert_allclose(quat_to_matrix(found.grasps.grasp.hand_pose[0, 3:]), expected, atol=TINY)
    np.testing.assert_allclose(found.grasps.grasp.hand_pose[0, :3], [0.1, 0.2, -0.3])


def test_dexgraspnets_joints_are_one_number_more_its_scale_meshs(tmp_path: Path, block) -> None:
    qpos = dict.fromkeys(("WRJTx", "WRJTy", "WRJTz", "WRJRx", "WRJRy", "WRJRz"), 0.0)
    path = _dexgraspnet(tmp_path, qpos | {"robot0:THJ4": 0.37}, 1.0)
    (found,) = published.read_dexgraspnet(path, hand="shadow", obj="block")
    at = next(k for k, name in enumerate(found.hand.joint_names) if name.endswith("THJ5"))
    assert found.grasps.grasp.joint_positions[0, at] == 0.37
    (found,) = published.read_dexgraspnet(_dexgraspnet(tmp_path, qpos, 1.5), hand="shadow", obj="block")
    assert np.ptp(found.obj.vertices, axis=0) == pytest.approx(1.5 * np.ptp(block.vertices, axis=0), rel=1e-6)


def _dexgraspnet(folder: Path, qpos: dict[str, float], scale: float) -> Path:
    path = folder / "core-block.npy"
    np.save(path, np.array([{"qpos": qpos, "scale": scale}], dtype=object), allow_pickle=True)
    return path


def test_imported_grasps_are_scored_and_say_where_they_come_from(hand, block, grasps, tmp_path) -> None:
    dexgraspbench.BenchExport(tmp_path / "bench").write(hand, block, grasps, range(len(grasps)))
    (found,) = dexgraspbench.read(tmp_path / "bench", hand="barrett", obj="block")
    origin = Origin("dexgraspbench", "a test", "CC0-1.0")
    asked = {"validation": "fast", "friction": 1}
    shard = read_shard(write_scored(found, origin, tmp_path / "out", **asked), kind="base")
    assert (shard.attributes["source"], shard.attributes["licence"]) == ("a test", "CC0-1.0")
    assert len(shard["quality/epsilon"]) == len(grasps) and set(np.unique(shard["quality/success"])) <= {0, 1}
    with pytest.raises(InputError, match="give another folder as --output"):
        write_scored(found, origin, tmp_path / "out", **asked)


def test_published_reference_grasps_come_in_by_name(shared_data: Path) -> None:
    path = shared_data / "reference_grasps" / "frogger_allegro" / "061_foam_brick.json"
    (found,) = read_sets("reference", path, None, None)
    assert (len(found.grasps), found.name) == (28, "061_foam_brick")
    assert found.published.mean() == pytest.approx(0.64, abs=0.005)  # the rate that DATA.md states


def test_verdicts_are_known_or_not_and_two_scales_are_two_objects() -> None:
    assert parse_verdicts([1, 0, True, None, "yes", 300, float("nan")]).tolist() == [1, 0, 1, -1, -1, -1, -1]
    # What is kept of a pair between calls is found by digest.
    assert len({scaled_object("block", scale).digest for scale in (1.0, 0.5, 2.0)}) == 3


#: Files of the block's grasps, and how they are rounded: by text of 12 digits or matrices [m, rad].
@pytest.mark.parametrize(
    ("name", "files", "rounding"),
    [
        ("dexlearn", "assets/grasp/graspd_tabletop_graspd_barrett/succ_collect/*/block", 1e-8),
        ("graspgen", "grasps/barrett", 1e-9),
    ],
)
def test_grasps_of_a_training_format_come_back(name: str, files: str, rounding: float, exported, stored: Shard) -> None:
    found = []
    for file in sorted(exported(name).glob(files)):
        for back in read_sets(name, file, "barrett", "block", "block"):
            assert back.published is not None and (back.placed is None) == (name == "graspgen")
            for k, pose in enumerate(back.grasps.grasp.hand_pose):
                (row,) = np.flatnonzero(np.abs(stored["grasp/hand_pose"][:, :3] - pose[:3]).max(axis=1) < rounding)
                found.append(int(row))
                assert back.published[k] == stored["quality/valid"][row]
                for what in dexgraspbench.POSTURES:
                    given, ours = getattr(back.grasps, what), stored[f"{what}/hand_pose"][row]
                    np.testing.assert_allclose(given.hand_pose[k, :3], ours[:3], atol=rounding)
                    assert abs(given.hand_pose[k, 3:] @ ours[3:]) == pytest.approx(1, abs=1e-6)
                    joints = stored[f"{what}/joint_positions"][row]
                    np.testing.assert_allclose(given.joint_positions[k], joints, atol=rounding)
                if back.placed is not None:
                    rest = stored["scene/object_pose"][stored["grasp/scene_index"][row]]
                    there = back.placed.object_pose[back.placed.index[k]]
                    np.testing.assert_allclose(there, rest, atol=rounding)
    assert sorted(found) == np.flatnonzero(stored["quality/valid"]).tolist()


def kept(folder: Path, *contents) -> Path:
    for number, content in enumerate(contents):
        save_record(folder / f"{number}.npy", content)
    return folder


def listed(folder: Path, text: str = "[]") -> Path:
    (folder / "x.json").write_text(text)
    return folder / "x.json"


HAND, GIVEN = hand_from_path("barrett"), {"hand": "barrett", "obj": "block"}
QPOS = {f"{name}_qpos": np.zeros(15) for name in dexgraspbench.POSTURES}
SIX = {"task": {"obj_name": "x"}, "scene": {"x": {"pose": np.zeros(6), "scale": [1.0]}}}
NO_SCENE = Shard("base", {}, {"scene/object_pose": np.zeros((1, 7)), "grasp/scene_index": np.zeros(1)})
#: What readers and writers refuse, by their words.
REFUSED = {
    "no import format 'foo'": lambda at: read_sets("foo", at, "h", "o"),
    "give --hand and --object": lambda at: read_sets("graspgen", at, None, "o"),
    "no shards": expand_path,
    r"nothing\.h5 does not exist": lambda at: load_case(at / "nothing.h5"),
    "name both: --hand and --object": load_case,
    "no file of reference grasps: KeyError": lambda at: load_case(listed(at, "{}")),
    "cannot be read: No such file": lambda at: graspgen.read(at / "none.json", **GIVEN),
    "has no .npy files": lambda at: load_case(at, **GIVEN),
    "is no dictionary": lambda at: load_case(kept(at, np.zeros(3)), **GIVEN),
    "has no pregrasp_qpos": lambda at: load_case(kept(at, {}), **GIVEN),
    "numbers of pregrasps, .* differ": lambda at: load_case(
        kept(at, QPOS | {"grasp_qpos": np.zeros((2, 15))}), **GIVEN
    ),
    r"\(scale 0.5, scale 1\)": lambda at: load_case(kept(at, QPOS, QPOS | {"obj_scale": 0.5}), **GIVEN),
    "has a pose of 6 numbers": lambda at: object_of_scene(kept(at / "assets", SIX), "assets/0.npy"),
    "no list of grasps with `qpos`": lambda at: published.read_dexgraspnet(kept(at, np.zeros(3)) / "0.npy", **GIVEN),
    "no file of reference grasps: it .* object": lambda at: stored_friction(listed(at)),
    "no record of GraspGen: it .* object": lambda at: graspgen.read(listed(at), **GIVEN),
    "has no joint 'elbow'": lambda at: joints_by_name(HAND, ["elbow"], [[0.0]], what="x"),
    "1 joint values for 2 joints": lambda at: joints_by_name(HAND, ["elbow", "wrist"], [[0.0]], what="x"),
    "does not say which": lambda at: scenes_of_shard(NO_SCENE),
    "is not a valid scene": lambda at: scene_spec_of(Shard("base", {"scene": DEEP}, {})),
}


@pytest.mark.parametrize("words", REFUSED)
def test_what_cannot_be_read_or_written_is_refused(words: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=words):
        REFUSED[words](tmp_path)


def test_a_shard_with_the_joints_of_another_hand_is_refused(stored: Shard, tmp_path: Path) -> None:
    arrays = {path: column[..., :5] if path.endswith("positions") else column for path, column in stored.arrays.items()}
    (tmp_path / "x.h5").write_bytes(write_shard("base", arrays, stored.attributes))
    with pytest.raises(InputError, match=r"has 5 joints, .*plan again"):
        load_case(tmp_path / "x.h5")


#: What an export begins with.
BEGUN = {"dexlearn": "assets/object/graspd", "graspgen": "grasps", "huggingface": "grasps"}
BEGUN |= {"webdataset": "pictures-000000.tar"}


@pytest.mark.parametrize("format_", BEGUN)
def test_an_export_does_not_write_over_another(format_: str, on_tables: Path, tmp_path: Path) -> None:
    (tmp_path / BEGUN[format_]).mkdir(parents=True)
    assert "give another folder as --output" in refused(f"export --format {format_} -o", tmp_path, on_tables)


@pytest.mark.parametrize(
    ("name", "reader"),
    [
        ("spec.json", read_spec),
        ("spec.toml", read_spec),
        ("reference.json", stored_friction),
        ("hand_mapping.json", read_mapping),
        ("stability.json", lambda path: read_study(path, "stability", parse_stability)),
        ("provenance.json", lambda path: add_provenance(Contents.__new__(Contents), path)),
    ],
)
def test_a_file_that_is_nested_deep_is_refused_in_one_line(name: str, reader, tmp_path) -> None:
    file = tmp_path / name
    file.write_text(f"hands = {DEEP}" if name.endswith("toml") else f'{{"hands": {DEEP}}}')
    with pytest.raises(InputError, match=name) as refused:
        reader(file)
    assert "\n" not in str(refused.value)


def test_an_attribute_that_is_nested_deep_says_nothing() -> None:
    assert parse_options_attribute(DEEP) == {}


H, W = 24, 32
K = np.array([[30.0, 0, 17], [0, 28, 11], [0, 0, 1]])
#: World to camera: somewhere above, looking at the origin.
CAMERA = np.eye(4)
CAMERA[:3, :3] = Rotation.from_euler("xyz", [2.6, 0.2, 0.4]).as_matrix()
CAMERA[:3, 3] = [0.02, -0.01, 0.6]


@pytest.fixture
def views() -> Shard:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [0.3, -0.5, 1.0]).as_matrix()
    pose[:3, 3] = [0.05, 0.02, 0.04]
    local = box_corners(np.array([[-0.02, -0.03, -0.05], [0.04, 0.01, 0.02]]))
    world = local @ pose[:3, :3].T + pose[:3, 3]
    corners = world @ CAMERA[:3, :3].T + CAMERA[:3, 3]
    arrays = {
        "camera/intrinsics": K[None],
        "camera/extrinsics": CAMERA[None],
        "camera/scene_index": np.zeros(1, np.int32),
        "camera/eye": np.zeros(1, np.uint8),
        "camera/stereo_baseline_m": np.zeros(1),
        "image/rgb": np.zeros((1, H, W, 3), np.uint8),
        "image/depth": np.ones((1, H, W), np.float32),
        "image/segmentation": np.full((1, H, W), 2, np.uint8),
        "box/bounding_box_2d_tight": np.array([[3, 4, 20, 15]], np.float32),
        "box/bounding_box_2d_loose": np.array([[2.6, 4, 21, 15]], np.float32),
        "box/bounding_box_3d": corners[None].astype(np.float32),
        "box/occlusion_ratio": np.array([0.25], np.float32),
    }
    return Shard("views", {"object": "mug"}, arrays)


def test_replicators_layout_has_the_boxes_and_matrices_of_ours(views: Shard, tmp_path) -> None:
    replicator.write(views, tmp_path)
    (row,) = np.load(tmp_path / "bounding_box_3d_0000.npy")
    local = box_corners(np.array([[row[f"{axis}_{end}"] for axis in "xyz"] for end in ("min", "max")], float))
    world = np.concatenate([local, np.ones((8, 1))], axis=1) @ row["transform"].astype(float)  # row vectors
    corners = world[:, :3] @ CAMERA[:3, :3].T + CAMERA[:3, 3]
    np.testing.assert_allclose(corners, views["box/bounding_box_3d"][0], atol=1e-6)  # float32 of the file
    said = json.loads((tmp_path / "camera_params_0000.json").read_text())
    view, projection = (np.reshape(said[f"camera{name}"], (4, 4)) for name in ("ViewTransform", "Projection"))
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    clip = np.concatenate([points, np.ones((20, 1))], axis=1) @ view @ projection  # row vectors, as USD has them
    ndc = clip[:, :2] / clip[:, 3:]
    pixels = np.stack([(ndc[:, 0] + 1) / 2 * W, (1 - ndc[:, 1]) / 2 * H], axis=1)
    in_camera = (points @ CAMERA[:3, :3].T + CAMERA[:3, 3]) @ K.T
    np.testing.assert_allclose(pixels, in_camera[:, :2] / in_camera[:, 2:], atol=1e-9)
    (box,) = np.load(tmp_path / "bounding_box_2d_tight_0000.npy")
    assert [int(box[name]) for name in ("x_min", "y_min", "x_max", "y_max")] == [3, 4, 20, 15]
    assert float(box["occlusionRatio"]) == 0.25
    assert json.loads((tmp_path / "bounding_box_2d_tight_labels_0000.json").read_text()) == {"0": {"class": "mug"}}
    views.arrays["box/bounding_box_2d_tight"] = np.full((1, 4), np.nan, np.float32)
    replicator.write(views, tmp_path / "unseen")
    assert len(np.load(tmp_path / "unseen" / "bounding_box_2d_tight_0000.npy")) == 0


def test_every_picture_is_one_sample_with_its_grasps(tmp_path) -> None:
    services = open_services(Settings(data_dir=tmp_path), open_store("memory://"))
    factories.add_builtins(services)
    record = factories.add_job(services, scenes=2, views=2, width=W, height=H)
    factories.finish_all(services, record)
    shards = open_shards(services.store, job=record.id, cache=tmp_path / "cache")
    services.close()
    written = webdataset.write(shards, tmp_path / "tars", pictures_a_file=3)
    members: list[str] = []
    for path in written:
        with tarfile.open(path) as tar:
            members += tar.getnames()
    kinds = ("rgb.png", "depth.exr", "segmentation.png", "json")
    assert sorted(members) == sorted(f"{number:08}.{kind}" for number in range(4) for kind in kinds)
    assert len(written) == 2 and len(Pictures(shards)) == 4
    (path,) = webdataset.write(shards, tmp_path / "one")
    expected = Pictures(shards)[1]
    with tarfile.open(path) as tar:
        record = json.loads(tar.extractfile("00000001.json").read())  # type: ignore[union-attr]
        image = Image.open(io.BytesIO(tar.extractfile("00000001.rgb.png").read()))  # type: ignore[union-attr]
        np.testing.assert_array_equal(np.array(image), expected["image/rgb"])
    np.testing.assert_allclose(record["grasps"]["hand_pose"], expected["grasp/hand_pose"])
    assert record["grasp_frame"] == "camera"
    with pytest.raises(InputError, match="no picture"):
        webdataset.write(Shards(shards.of_kind("base")), tmp_path / "none")
